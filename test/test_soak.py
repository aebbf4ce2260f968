"""The soak runs in short: what they break holds, and they do notice what does not."""

from __future__ import annotations

import json
import mmap
import time
from contextlib import nullcontext

import numpy as np
import pytest

from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.report.progress import Progress
from biped_mfpt_ros.soak import __main__ as soak
from biped_mfpt_ros.soak import fuzz, live, meshes, simulators, targets

QUIET = Progress(quiet=True)


@pytest.mark.parametrize("target", targets.TARGETS, ids=lambda target: target.name)
def test_bad_input_is_taken_or_refused_clearly(target):
    fuzz.warm_up()
    share = target.share / sum(other.share for other in targets.TARGETS)
    inputs = round(fuzz.SHORT_INPUTS * share)
    row = fuzz.run_target(target, max(1, inputs), 1, QUIET)
    assert row.failures == 0, "\n".join(row.examples)
    assert row.count >= inputs


def test_the_fuzzer_notices_what_is_wrong(monkeypatch):
    def give(random):
        kind = random.randrange(4)
        if kind == 0:
            raise KeyError("a bug")
        if kind == 1:
            raise InputError("field", 1, "")
        if kind == 2:
            raise InputError("field", 1, "2")

    row = fuzz.fuzz("target", give, 100, 1, QUIET)
    assert 25 < row.failures < 75
    assert 0 < row.facts["refused"] < 100
    assert any("a bug" in example for example in row.examples)
    assert any("without what is allowed" in example for example in row.examples)
    again = fuzz.fuzz("target", give, 100, 1, QUIET)
    assert again.examples == row.examples
    assert fuzz.fuzz("target", give, 100, 2, QUIET).examples != row.examples

    def slow(random):
        end = time.process_time() + 0.1
        while time.process_time() < end:
            pass

    with monkeypatch.context() as patch:
        patch.setattr(fuzz, "MOST_SECONDS", 0.05)
        assert fuzz.fuzz("slow", slow, 3, 1, QUIET).failures == 3

    # Pages of their own: what the allocator has kept of earlier tests would take the rest in.
    kept = []

    def leak(random):
        kept.append(mmap.mmap(-1, 10**6))
        kept[-1].write(b"x" * 10**6)

    leaking = fuzz.fuzz("leaking", leak, 100, 1, QUIET)
    assert leaking.failures == 1
    assert "grew by" in leaking.examples[0]


def test_soak_prints_a_table_or_json_and_fails_with_what_failed(capsys, monkeypatch):
    def bug(random):
        raise KeyError("a bug")

    entry = targets.TargetEntry("buggy", 1.0, lambda: nullcontext(bug))
    monkeypatch.setattr(targets, "TARGETS", (entry,))
    monkeypatch.setattr(fuzz, "warm_up", lambda: None)
    monkeypatch.setattr(fuzz, "SHORT_INPUTS", 7)
    monkeypatch.setattr(fuzz, "run_live", lambda *_: [])  # another test's
    assert soak.main(["--short", "--only", "fuzz", "--json"]) == 1
    result = json.loads(capsys.readouterr().out)
    assert result["failures"] == 7
    assert result["rows"][0]["count"] == 7
    assert soak.main(["--short", "--only", "fuzz"]) == 1
    assert "FAILED fuzz, buggy: input 0" in capsys.readouterr().out


@pytest.mark.slow
def test_meshes_among_faults_are_those_without():
    (row,) = simulators.run(True, 1, QUIET)
    assert row.count >= 8
    assert row.failures == 0, row.examples
    assert row.facts["meshes"] > 0


def looks(meshes, **changes):
    """What the nodes held after each mesh; ``changes`` are per mesh, of the mesher."""
    usual = {"kilobytes": 100_000, "files": 10, "threads": 5}
    return [
        {
            "mesher": {key: value + int(i * changes.get(key, 0)) for key, value in usual.items()},
            "analysis": dict(usual),
        }
        for i in range(meshes)
    ]


@pytest.mark.parametrize(
    ("case", "said"),
    [
        ({}, None),
        ({"looks": looks(100, kilobytes=50)}, None),  # 3 % after the warm-up
        ({"looks": looks(100, kilobytes=100)}, "mesher grew by 5.7 % after the warm-up"),
        ({"looks": looks(100, files=0.1)}, "mesher: 14 files became 19"),
        ({"looks": looks(100, threads=0.1)}, "mesher: 9 threads became 14"),
        ({"seconds": np.linspace(0.1, 0.2, 100)}, "a mesh took 150 ms, and 190 ms at the end"),
        ({"estimates": {5.0, 6.0}}, "2 different MFPT"),
        ({"whole": False}, "the bag is not whole"),
        ({"left": {"/dev/shm/fastdds_1"}}, "1 files were left"),
    ],
)
def test_many_meshes_are_judged(case, said):
    usual = {"looks": looks(100), "seconds": np.full(100, 0.1), "estimates": {5.0}}
    given = {**usual, "whole": True, "left": set(), **case}
    row = meshes._judged(
        100,
        given["seconds"],
        given["looks"],
        given["estimates"],
        given["whole"],
        given["left"],
        1.0,
    )
    assert row.failures == (said is not None)
    assert said is None or said in row.examples[0]


def test_bad_input_over_ros_is_taken_or_refused_clearly():
    rows = fuzz.run_live(live.SHORT_INPUTS, 1, QUIET)
    for row in rows:
        assert row.failures == 0, (row.what, *row.examples)
    refused = sum(row.facts.get("refused", 0) for row in rows)
    assert 0.1 * live.SHORT_INPUTS < refused < 0.9 * live.SHORT_INPUTS
