"""`biped-mfpt run` under faults: full disks, signals in every phase, parents that are killed."""

from __future__ import annotations

import json
import shutil

import pytest
from test_cli import Run
from test_recorder import small_disk


@pytest.mark.parametrize("on_error", ["stop", "go_on"])
def test_a_run_on_a_full_disk_stops_or_goes_on_as_told(tmp_path, on_error):
    # Enough for the logs and a few messages.
    with small_disk(tmp_path / "disk", 40_960) as disk:
        run = Run(
            disk, "--threshold", "0.02", "--workers", "1", "--walks", "0", "--json",
            "--output", "run", "--on-record-error", on_error,
        )  # fmt: skip
        code, out, err = run.end(300.0)
        assert run.nodes() == {}
        assert not (disk / "run" / "bag" / "metadata.yaml").exists()
        assert code == 1
        if on_error == "stop":
            assert "the end of run/logs/recorder.log" in err, err
            assert "No space left on device; it is not whole" in err
            assert out == ""
        else:
            # The result is told, although it cannot be kept; what is kept is whole.
            assert json.loads(out)["bag_whole"] is False
            assert json.loads(out)["estimates"][0]["mfpt"] > 1.0
            assert "bag is not whole" in err
        kept = [path.name for path in (disk / "run").iterdir()]
        assert not [name for name in kept if name.endswith(".partial")]
        if "mfpt.png" in kept:
            assert (disk / "run" / "mfpt.png").read_bytes().endswith(b"IEND\xaeB`\x82")
        shutil.rmtree(disk / "run")
