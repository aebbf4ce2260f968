"""`biped-mfpt optimise` and `biped-mfpt study`."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from ros_graph import PATIENCE

from biped_mfpt_ros.cli import main
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.optimise.settings import StudySettings
from biped_mfpt_ros.optimise.store import Store
from biped_mfpt_ros.optimise.study import Study

# A coarse mesh without a check: some milliseconds for a trial.
QUICK = ("--controller", "hzd/mfpt", "--mesh", "1:1", "--check-walks", "0", "--seed", "2",
         "--step", "0.5", "--population", "4", "--local", "--quiet")  # fmt: skip


def outline(path, name="s"):
    store = Store(Path(path))
    found = [
        (t.number, t.vector.tobytes(), t.found.stage, t.found.score, t.found.values)
        for t in Study(store, name).trials()
        if t.found is not None
    ]
    store.close()
    return found


def optimise(path, *more, name="s"):
    return main(["optimise", *QUICK, "--store", str(path), "--study", name, *more])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    path = tmp_path_factory.mktemp("store") / "studies.sqlite"
    assert optimise(path, "--trials", "20", "--workers", "2") == 0
    more = ("--objective", "mfpt", "cot=20", "--searcher", "nsga2", "--population", "8")
    assert optimise(path, "--trials", "20", *more, name="front") == 0
    return path


def result_of(capsys, *arguments):
    assert main([*arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_result_is_told(finished, capsys):
    # The study is done, so that nothing is left to do but to tell.
    assert optimise(finished, "--trials", "20", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["ended"], result["trials"]) == ("trials", 20)
    best = max(t[3] for t in outline(finished))
    assert result["best"]["score"] == best
    assert result["best"]["stage"] == "confirmed"
    assert [row["trials"] for row in result["runs"]] == [8, 4, 4, 4]
    assert max(row["score"] for row in result["runs"]) == best
    assert optimise(finished, "--trials", "20") == 0
    text = capsys.readouterr().out
    assert "study s: 20 trials" in text
    assert f"run 1: 8 trials, best score {result['runs'][0]['score']:.3g}\n" in text
    assert "4 runs share the trials until one is left" in text
    assert "outside of the step map" in text


def test_list_and_show(finished, capsys):
    rows = result_of(capsys, "study", "list", "--store", str(finished))["studies"]
    assert [(row["study"], row["trials"]) for row in rows] == [("s", 20), ("front", 20)]
    shown = result_of(capsys, "study", "show", "s", "--store", str(finished))
    assert [c["name"] for c in shown["space"]][:3] == ["kp", "kd", "alpha_2^1"]
    assert [t["score"] for t in shown["trials"][:20]] == [t[3] for t in outline(finished)]
    assert main(["study", "show", "s", "--store", str(finished)]) == 0
    assert "parameters of trial" in capsys.readouterr().out


def test_the_list_tells_the_ground(tmp_path, capsys):
    path = tmp_path / "s.sqlite"
    settings = StudySettings(
        controller("hzd/mfpt"), mu_s=math.radians(-1.5), sigma_s=math.radians(2.5), correlation=0.75
    )
    Store(path).create("rolling", settings)
    (row,) = result_of(capsys, "study", "list", "--store", str(path))["studies"]
    assert {key: row[key] for key in ("mu_s", "sigma_s", "correlation")} == {
        "mu_s": settings.mu_s, "sigma_s": settings.sigma_s, "correlation": 0.75
    }  # fmt: skip
    assert main(["study", "list", "--store", str(path)]) == 0
    shown = capsys.readouterr().out
    assert all(text in shown for text in ("-1.5 deg", "2.5 deg", "0.75"))


def test_what_is_exported_walks(finished, capsys, tmp_path):
    file = tmp_path / "best.json"
    store = ("--store", str(finished))
    assert main(["study", "export", "s", *store, "--output", str(file)]) == 0
    capsys.readouterr()
    exported = json.loads(file.read_text())
    assert exported["scheme"] == "hzd"
    assert exported["catalogue"]["kp"] == exported["parameters"][0]
    assert len(exported["catalogue"]["bezier"]) == 4
    cycle = result_of(capsys, "cycle", "--controller-file", str(file), "--quiet")
    assert cycle["controller"] == exported["name"]
    assert cycle["cost_of_transport"] == pytest.approx(exported["found"]["values"]["cot"], rel=1e-4)
    first = result_of(capsys, "study", "export", "s", *store, "--trial", "0")
    assert first["trial"] == 0
    file.write_text("{}")
    assert main(["cycle", "--controller-file", str(file)]) == 2
    assert f"{file}: name: missing" in capsys.readouterr().err


def test_a_front_is_confirmed_on_a_finer_mesh(finished, capsys):
    store = ("--store", str(finished))
    finer = ("--confirm", "front", *store, "--mesh", "1:0.3:inf:2000", "--check-walks", "20",
             "--seed", "9", "--tolerance", "1e-7", "--local", "--quiet")  # fmt: skip
    result = result_of(capsys, "optimise", *finer)
    assert (result["study"], result["ended"]) == ("front-confirmed", "converged")
    before = result_of(capsys, "study", "show", "front", *store)
    after = result_of(capsys, "study", "show", "front-confirmed", *store)
    # All but how trials are scored is as it was.
    changed = {k for k, v in before["settings"].items() if after["settings"][k] != v}
    assert changed == {"searcher", "stages", "seed", "check_walks", "check_sigmas", "model"}
    assert after["settings"]["start"] == before["settings"]["start"]
    same = before["settings"]["model"] | {"tolerance": 1e-7}
    assert after["settings"]["model"] == same != before["settings"]["model"]
    found = {tuple(t["vector"]): t for t in before["trials"]}
    assert 0 < len(after["trials"]) < 20
    for trial in after["trials"]:
        coarse = found[tuple(trial["vector"])]
        assert coarse["stage"] == "confirmed"
        assert coarse["controller"]["parameters"] == trial["controller"]["parameters"]
        # Tolerances of 1e-7 and 4e-8 a step.
        assert trial["values"]["cot"] == pytest.approx(coarse["values"]["cot"], rel=1e-5)
        assert (trial["states"], trial["values"]) != (coarse["states"], coarse["values"])
    # The same command again has nothing left to do; the study of one objective works as well.
    assert result_of(capsys, "optimise", *finer)["trials"] == len(after["trials"])
    assert result_of(capsys, "optimise", "--confirm", "s", *finer[2:])["trials"] > 0
    assert main(["optimise", "--confirm", "none", *store, "--local"]) == 2
    assert "one of those in" in capsys.readouterr().err


@pytest.mark.parametrize("what", ["plot", "front"])
def test_pictures(finished, capsys, tmp_path, what, monkeypatch):
    from biped_mfpt_ros.report import studies

    monkeypatch.setattr(studies, "paper_points", lambda settings: {"hzd/base": (5.8, 0.19)})
    file = tmp_path / "picture.png"
    command = ["study", what, "front", "--store", str(finished), "--output", str(file)]
    assert main(command) == 0
    assert file.read_bytes().startswith(b"\x89PNG")
    assert "confirmed" in capsys.readouterr().out
    assert main(command) == 2  # a file that is there is not written over


@pytest.mark.slow
def test_the_papers_controllers_are_where_the_paper_has_them(finished):
    from biped_mfpt_ros.control.controller import controller
    from biped_mfpt_ros.optimise.settings import StudySettings
    from biped_mfpt_ros.report.studies import paper_points

    points = paper_points(StudySettings(controller("hzd/mfpt")))
    assert set(points) >= {"hzd/base", "hzd/cot", "hzd/mfpt", "smc/base", "smc/mfpt"}
    assert points["hzd/base"][1] == pytest.approx(0.1865, rel=2e-3)
    assert points["hzd/mfpt"][0] == pytest.approx(136.0, rel=0.05)


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["--searcher", "luck"], "--searcher: invalid choice: 'luck' (choose from"),
        (["--confirm", "nothing"], "--confirm: 'nothing'"),
        (["--objective", "mfpt", "beauty"], "--objective: 'beauty'"),
        (["--limit", "speed_min=x"], "'speed_min=x' is not allowed"),
        (["--limit", "weight_max=3"], "--limit: 'weight_max'"),
        (["--fix", "omega"], "--fix: 'omega'"),
        (["--sigma", "0"], "--sigma: 0.0"),
        (["--runs", "-1"], "runs: -1 is not allowed; allowed: 0 to"),
        (["--runs", "2", "--searcher", "pattern"], "runs: 2 is not allowed"),
        (["--mesh", "1"], "'1' is not allowed"),
        (["--mesh", "0.3:1"], "0.3"),
        (["--trials", "0"], "--trials: 0"),
        (["--workers", "0"], "--workers: 0"),
        (["--check-walks", "-1"], "--check-walks: -1"),
    ],
)
def test_bad_options_are_refused(tmp_path, capsys, arguments, problem):
    assert optimise(tmp_path / "s.sqlite", *arguments) == 2
    assert problem in capsys.readouterr().err


def test_what_is_not_there_is_told(finished, tmp_path, capsys):
    assert main(["study", "list", "--store", str(tmp_path / "none")]) == 2
    assert main(["study", "show", "none", "--store", str(finished)]) == 2
    assert "one of those in" in capsys.readouterr().err
    assert main(["study", "show", "--store", str(finished)]) == 2
    assert optimise(finished, "--trials", "20", "--fix", "kp") == 2
    assert "now different: fixed" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_study_that_was_killed_goes_on(tmp_path, number):
    path = tmp_path / "killed.sqlite"
    # Without an end, so that it is not done before it is stopped.
    command = [sys.executable, "-m", "biped_mfpt_ros.cli", "optimise", *QUICK,
               "--store", str(path), "--study", "s"]  # fmt: skip
    command.remove("--quiet")
    process = subprocess.Popen(
        command, env=dict(os.environ), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + PATIENCE
    while not path.exists() or len(outline_so_far(path)) < 8:
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(number)
    _, told = process.communicate()
    assert ("the same command goes on with study s" in told) == (number == signal.SIGTERM)
    before = outline(path)
    trials = ("--trials", str(max(60, len(before) + 20)))
    assert optimise(path, *trials) == 0
    after = outline(path)
    assert set(map(str, before)) < set(map(str, after))
    assert optimise(tmp_path / "whole.sqlite", *trials, "--workers", "1") == 0
    assert after == outline(tmp_path / "whole.sqlite")


def outline_so_far(path):
    store = Store(path)
    try:
        return outline(path) if store.names() else []
    finally:
        store.close()
