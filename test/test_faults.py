"""`biped-mfpt run` under faults: full disks, signals in every phase, parents that are killed."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import time
from pathlib import Path

import pytest
from ros_graph import ros_graph, wait_for
from test_cli import LONG, Run, wait_until
from test_recorder import small_disk

from biped_mfpt_ros.cli.shared_memory import remove_left_segments


@pytest.mark.parametrize("on_error", ["stop", "go_on"])
def test_a_run_on_a_full_disk_stops_or_goes_on_as_told(tmp_path, on_error):
    # Enough for the logs and a few messages.
    with small_disk(tmp_path / "disk", 40_960) as disk:
        run = Run(
            disk, "--threshold", "0.02", "--workers", "1", "--walks", "0", "--json",
            "--output", "run", "--on-record-error", on_error,
        )  # fmt: skip
        code, out, err = run.end()
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


QUICK = ("--threshold", "0.3", "--workers", "1", "--output", "run")

PHASES = {
    # name: arguments, and whether the phase has been reached
    "starting": (LONG, lambda run: (run.directory / "run").exists()),
    "nodes come up": (LONG, lambda run: len(run.nodes()) == 4),
    "meshing": (LONG, lambda run: bag_size(run) > 10_000),
    "Monte Carlo": ((*QUICK, "--walks", "9000"), lambda run: is_alone_again(run)),
    "drawing": ((*QUICK, "--walks", "0"), lambda run: is_alone_again(run)),
}


def bag_size(run):
    return sum(path.stat().st_size for path in (run.directory / "run" / "bag").glob("*.mcap"))


def is_alone_again(run):
    """Whether the nodes have done their work and ended."""
    return bag_size(run) > 10_000 and not run.nodes()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
@pytest.mark.parametrize("phase", PHASES)
def test_a_signal_in_any_phase_ends_everything_within_5_s(tmp_path, phase, number):
    arguments, reached = PHASES[phase]
    run = Run(tmp_path, *arguments)
    wait_until(lambda: reached(run), run, phase)
    start = time.monotonic()
    run.process.send_signal(number)
    # All of its nodes, also where it was killed and could not stop them.
    while run.process.poll() is None or run.nodes():
        assert time.monotonic() - start < 5.0, (run.process.poll(), run.nodes())
        time.sleep(0.02)
    code, _, err = run.end()
    assert code == (-9 if number == signal.SIGKILL else 130), err
    assert "Traceback" not in err
    if bag_size(run):
        assert (tmp_path / "run" / "bag" / "metadata.yaml").exists()


def test_what_killed_processes_leave_in_shared_memory_is_removed(tmp_path):
    with ros_graph() as graph:
        process = graph.launch("recorder", "--ros-args", "-p", f"bag:={tmp_path / 'bag'}")
        wait_for((tmp_path / "bag" / "bag_0.mcap").exists, "the recorder")
        maps = Path("/proc", str(process.pid), "maps").read_text().split()
        mapped = {Path(word) for word in maps if re.fullmatch(r"/dev/shm/fastdds_[0-9a-f]+", word)}
        assert mapped
        for path in mapped:  # as if it had started a while ago
            os.utime(f"{path}_el", (0, 0))
        remove_left_segments()
        assert all(path.exists() for path in mapped)  # it lives
        process.kill()
        process.wait()
        assert all(path.exists() for path in mapped)
        assert remove_left_segments() >= 1
        left = {path for path in mapped if path.exists() or Path(f"{path}_el").exists()}
    # That of this process, which is mapped too, is still its own.
    assert len(left) <= len(mapped) - 1
