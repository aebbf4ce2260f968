"""The study of the paper: its plan, what is kept, what is compared, and the report."""

from __future__ import annotations

import csv
import io
import json
import math
import re
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest

from biped_mfpt_ros.chain.markov import slope_probabilities
from biped_mfpt_ros.chain.mesh import grow_mesh
from biped_mfpt_ros.cli import CommandError, main
from biped_mfpt_ros.cli import reproduce as cli_reproduce
from biped_mfpt_ros.control.controller import controller, paper_controller_names
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.monte_carlo import monte_carlo
from biped_mfpt_ros.gait.step import simulate_steps
from biped_mfpt_ros.report import html
from biped_mfpt_ros.report.style import Picture
from biped_mfpt_ros.study import work
from biped_mfpt_ros.study.curves import curves
from biped_mfpt_ros.study.plan import CURVE_DEG, PAPER_MESH, SIGMA_DEG, Job, make_plan, scheme_of
from biped_mfpt_ros.study.readings import readings
from biped_mfpt_ros.study.results import Results, percent
from biped_mfpt_ros.study.store import Store
from biped_mfpt_ros.study.table import INTERVAL
from biped_mfpt_ros.study.tables import tables
from biped_mfpt_ros.study.verdicts import DIFFERS, HOLDS, UNKNOWN
from biped_mfpt_ros.walker.robot import WalkerModel
from biped_mfpt_ros.walker.terrain import slope_set

COMMAND = [sys.executable, "-m", "biped_mfpt_ros.cli", "reproduce"]


def made_up(plan, skip=(), mfpt=1.0, mean_steps=5.0):
    """Results for a plan, made up, of the shapes that the jobs give."""
    out = {}
    for job in plan.jobs:
        settings = job.settings
        if job.kind in skip:
            continue
        if job.kind == "cycle":
            result = {"found": True, "state": [0.1] * 10, "period": 0.5, "step_length": 0.4,
                      "speed": 0.8, "cost_of_transport": 0.19, "largest_eigenvalue": 0.7,
                      "stable": True}  # fmt: skip
        elif job.kind == "mesh":
            sigmas = settings["sigma_deg"]
            states = round(20 / settings["threshold"] / settings["slope_step_deg"])
            result = {"mesh_id": "m", "states": states, "generations": 4, "swings": states,
                      "swings_per_second": 100.0, "seconds": states / 100.0,
                      "step_map_seconds": 0.1, "bag": "bags/m",
                      "failure_shares": [{}] * len(sigmas),
                      "mfpt": [mfpt * math.exp(5.0 / s) for s in sigmas],
                      "failure_probability": [0.1] * len(sigmas)}  # fmt: skip
        elif job.kind == "walks":
            result = {"mean_steps": mean_steps, "standard_error": 0.1, "low": mean_steps - 0.2,
                      "high": mean_steps + 0.2, "counted_walks": 90, "falls": 90, "steps": 500,
                      "failure_shares": {"stance_slips": 1.0}, "seconds": 1.0}  # fmt: skip
        elif job.kind == "counted":
            result = {"mean_steps": [mean_steps for _ in settings["sigma_deg"]]}
        elif job.kind == "tolerance":
            result = {"rows": [{"tolerance": 1e-7, "same": 1.0, "mean_steps": 5.0,
                                "milliseconds": 0.3}], "cost_ratio": 7.5}  # fmt: skip
        else:
            cases = ((False, -1.0, "falls"), (True, 0.0, None), (True, -9.0, None))
            result = {
                "rows": [
                    {
                        "torques_off_late": off,
                        "torque_limit": 50.0,
                        "slope_deg": slope,
                        "steps": 3,
                        "fell": fell,
                    }
                    for off, slope, fell in cases
                ]
            }
        out[job.name] = result
    return Results(plan, out)


def table_of(results, name):
    return next(table for table in tables(results) if table.name == name)


class TestReadings:
    def test_every_controller_has_one_with_a_reason(self):
        assert tuple(readings()) == paper_controller_names()
        for reading in readings().values():
            assert len(reading.reason) > 20
            assert len(reading.source) > 5

    def test_hzd_walks_with_the_defaults(self):
        # Table 2 was reproduced with them, and the defaults are documented by that.
        for name in paper_controller_names():
            if name.startswith("hzd/"):
                assert readings()[name].model == WalkerModel()


class TestPlan:
    def test_all_that_the_paper_has_is_planned(self):
        plan = make_plan()
        assert plan.controllers == paper_controller_names()
        assert plan.walks == 10_000
        for name in plan.controllers:
            scheme = scheme_of(name)
            meshes = plan.of("mesh", name)
            settings = [(m.settings["slope_step_deg"], m.settings["threshold"]) for m in meshes]
            assert PAPER_MESH[scheme] in settings
            assert len(set(settings)) == len(settings) >= 5
            assert {d_s for d_s, _ in settings} == {
                PAPER_MESH[scheme][0],
                PAPER_MESH[scheme][0] / 2,
            }
            assert len(meshes[-1].settings["sigma_deg"]) >= 30
            for mesh in meshes:
                assert set(SIGMA_DEG[scheme]) <= set(mesh.settings["sigma_deg"])
            sigma = {"hzd": 2.0, "smc": 5.0}[scheme]
            (walks,) = (j for j in plan.of("walks", name) if j.settings["at_deg"] == sigma)
            assert walks.settings["walks"] == 10_000

    def test_curves_have_round_values(self):
        for scheme, values in CURVE_DEG.items():
            assert len(values) >= 30
            assert set(SIGMA_DEG[scheme]) <= set(values)
            assert list(values) == sorted(set(values))

    def test_names_are_unique_and_depend_on_settings(self):
        plan, other = make_plan(), make_plan(walks=5000)
        names = {job.name for job in plan.jobs}
        assert len(names) == len(plan.jobs)
        same = names & {job.name for job in other.jobs}
        assert {n.split("-")[0] for n in same} == {"cycle", "mesh", "counted", "slopes"}

    def test_name_depends_on_step_map_and_model(self, monkeypatch):
        job = make_plan(["smc/base"]).of("cycle")[0]
        before = job.name
        monkeypatch.setattr("biped_mfpt_ros.study.plan.STEP_MAP", "another")
        assert job.name != before
        monkeypatch.undo()
        assert job.name == before
        monkeypatch.setitem(readings(), "smc/base", readings()["hzd/base"])
        assert job.name != before

    def test_order_of_controllers_does_not_count(self):
        names = ["smc/cot", "hzd/base"]
        assert make_plan(names) == make_plan(names[::-1])

    def test_bad_input(self):
        with pytest.raises(InputError, match="hzd/worst"):
            make_plan(["hzd/worst"])
        with pytest.raises(InputError, match="walks"):
            make_plan(walks=1)


class TestStore:
    JOB = Job("walks", "hzd/cot", {"at_deg": 2.0})

    def test_keeps_floats_exactly(self, tmp_path):
        Store(tmp_path).put(self.JOB, {"x": 0.1 + 0.2, "y": None, "z": "inf"})
        assert Store(tmp_path).get(self.JOB) == {"x": 0.1 + 0.2, "y": None, "z": "inf"}
        assert [path.suffix for path in tmp_path.iterdir()] == [".json"]

    def test_other_inputs_are_another_result(self, tmp_path):
        store = Store(tmp_path)
        store.put(self.JOB, {"x": 1})
        assert store.get(Job("walks", "hzd/cot", {"at_deg": 1.0})) is None

    @pytest.mark.parametrize("text", ["", "{", "[]", '{"inputs": {}, "result": {}}'])
    def test_damaged_file_is_no_result(self, tmp_path, text):
        store = Store(tmp_path)
        store.path(self.JOB).write_text(text)
        assert store.get(self.JOB) is None

    def test_failed_write_leaves_what_was_there(self, tmp_path):
        store = Store(tmp_path)
        store.put(self.JOB, {"x": 1})
        with pytest.raises(ValueError, match="JSON"):
            store.put(self.JOB, {"x": math.inf})
        assert store.get(self.JOB) == {"x": 1}
        assert len(list(tmp_path.iterdir())) == 1


class TestComparison:
    def test_percent(self):
        assert percent(1.1, 1.0) == pytest.approx(10.0)
        assert percent(None, 1.0) is None
        assert percent(1.0, None) is None

    def test_verdicts(self):
        # A chain is judged by the finest mesh, here mfpt * exp(5) at 1 degree, and not by Monte
        # Carlo, which counts otherwise. Table 2 has 2.1511 for Monte Carlo.
        plan = make_plan(["hzd/base"])
        results = made_up(plan, mean_steps=5.9, mfpt=5.5 / math.exp(5.0))
        rows = {r["number"]: r for r in table_of(results, "holds").rows}
        assert rows["hzd/base: chain at 1°"]["here"] == pytest.approx(5.5)
        assert rows["hzd/base: chain at 1°"]["verdict"] == HOLDS
        assert rows["hzd/base: Monte Carlo at 2°"]["verdict"] == DIFFERS
        assert rows["hzd/base: Monte Carlo at 2°"]["difference"] == pytest.approx(
            100.0 * (5.9 / 2.1511 - 1.0)
        )
        assert rows["order of merit in Table 5"]["verdict"] == UNKNOWN
        claims = [row for row in rows.values() if row["by"] == "simulation"]
        assert [row["verdict"] for row in claims] == [HOLDS] * 3

    def test_without_walks_the_finest_mesh_judges(self):
        plan = make_plan(["hzd/base"])
        results = made_up(plan, skip=("walks",), mfpt=5.9 / math.exp(5.0))
        rows = {r["number"]: r for r in table_of(results, "holds").rows}
        assert rows["hzd/base: chain at 1°"]["by"] == "finest mesh"
        assert rows["hzd/base: chain at 1°"]["verdict"] == HOLDS

    def test_mesh_is_compared_with_monte_carlo_as_that_counts(self):
        plan = make_plan(["hzd/base"])
        results = made_up(plan, mean_steps=5.0)
        row = table_of(results, "convergence").rows[0]
        assert row["counted_2"] == 5.0
        assert row["bias_2"] == pytest.approx(0.0)
        assert row["mfpt_2"] == pytest.approx(math.exp(2.5))

    def test_no_result_at_all(self):
        plan = make_plan(["hzd/base"])
        found = {table.name for table in tables(Results(plan, {}))}
        assert "table1" in found
        assert found.isdisjoint({"table2", "table5", "convergence", "tolerance", "slopes"})
        assert curves(Results(plan, {})) == []

    def test_no_gait(self):
        plan = make_plan(["smc/cot"])
        cycle = plan.of("cycle")[0]
        results = Results(plan, {cycle.name: {"found": False, "reason": "no limit cycle of it"}})
        table = table_of(results, "table3_gaits")
        assert table.rows[0].get("speed") is None
        assert "no limit cycle of it" in table.notes

    def test_hybrid_invariance_beside_the_printed(self):
        rows = table_of(Results(make_plan(["hzd/base"]), {}), "table1").rows
        again = [row for row in rows if row["recomputed"] is not None]
        assert len(again) == 8
        # Four decimals are printed, of these and of what they are computed from.
        assert max(abs(row["difference"]) for row in again) < 2e-4

    def test_csv_and_json_have_the_same_cells(self):
        for table in tables(made_up(make_plan(quick=True))):
            lines = list(csv.DictReader(io.StringIO(table.csv())))
            rows = json.loads(json.dumps(table.to_dict()["rows"]))
            assert len(lines) == len(rows)
            for line, row in zip(lines, rows, strict=True):
                for column in table.columns:
                    value = row.get(column.key)
                    if column.kind == INTERVAL:
                        low, high = value or (None, None)
                        cells = {f"{column.key}_low": low, f"{column.key}_high": high}
                    else:
                        cells = {column.key: value}
                    for key, cell in cells.items():
                        if cell is None:
                            assert line[key] == ""
                        elif isinstance(cell, str):
                            assert line[key] == cell
                        else:
                            assert float(line[key]) == cell

    def test_missing_points_leave_gaps_in_a_curve(self):
        plan = make_plan(["hzd/base"])
        results = made_up(plan)
        mesh = plan.of("mesh")[-1]
        values = results.finest("hzd/base")["mfpt"]
        values[0], values[1] = None, "inf"
        (curve,) = curves(results)
        assert len(curve.mfpt) == len(curve.sigma_deg) == len(mesh.settings["sigma_deg"]) - 1
        assert curve.mfpt[0] == math.inf


@pytest.fixture(scope="module")
def page():
    results = made_up(make_plan(["hzd/base", "smc/mfpt"]))
    picture = Picture("A <title>", "What & why", b"GIF89a", "image/gif")
    return html.page(
        results, tables(results), curves(results), {"hzd/base": [picture]}, {"all": 1.0}
    )


class TestPage:
    def test_is_self_contained(self, page):
        assert_self_contained(page)

    def test_has_every_part(self, page):
        anchors = re.findall(r'<a href="#([^"]+)"', page)
        assert len(anchors) == len(set(anchors)) >= 8
        for anchor in anchors:
            assert f'<section id="{anchor}">' in page
        # Figures 2 and 3, two of convergence, and the one that was given.
        assert page.count("<figure>") == 5
        assert "data:image/gif;base64,R0lGODlh" in page
        assert "A &lt;title&gt;" in page
        assert "What &amp; why" in page
        assert "1.60·10<sup>14</sup>" in page

    def test_tags_are_closed(self, page):
        for tag in ("table", "tr", "td", "section", "div", "figure", "p", "details", "span"):
            assert len(re.findall(f"<{tag}[ >]", page)) == page.count(f"</{tag}>"), tag


def assert_self_contained(page):
    sources = re.findall(r'(?:src|srcset|data|poster)\s*=\s*["\']?([^"\'\s>]+)', page)
    assert sources
    assert all(source.startswith("data:image/") for source in sources)
    assert all(link.startswith("#") for link in re.findall(r'href\s*=\s*"([^"]*)"', page))
    assert not re.search(r"https?:|@import|url\(|<link|<script|<iframe", page)


@pytest.fixture(scope="module")
def state():
    found = work.cycle(make_plan(["hzd/base"]).of("cycle")[0])
    assert found["found"]
    return found["state"]


class TestWork:
    def test_walks_are_those_of_monte_carlo(self, state):
        settings = {"at_deg": 2.0, "walks": 100, "seed": 1, "tolerance": 1e-7}
        job = Job("walks", "hzd/base", settings)
        found = work.walks(job, state)
        model = WalkerModel(tolerance=1e-7)
        walked = monte_carlo(
            controller("hzd/base"), math.radians(2.0), 100, 1, model=model, state=state
        )
        assert found["mean_steps"] == walked.mean_steps
        assert (found["low"], found["high"]) == walked.confidence_interval
        assert found["steps"] == walked.steps.sum()

    def test_mesh_predicts_walks(self, state):
        """A chain counted as walks are: by adding up first steps and walks through the mesh."""
        slopes = slope_set(1.0)
        mesh = grow_mesh(
            lambda states, behind: simulate_steps(controller("hzd/base"), states, behind, slopes),
            state, slopes, 0.1,
        )  # fmt: skip
        probabilities = slope_probabilities(slopes, 0.0, math.radians(2.0))
        random = np.random.default_rng(1)
        counts = []
        for _ in range(20_000):
            at, steps = 1, 0
            while at:
                at = mesh.targets[at, random.choice(len(slopes), p=probabilities)]
                steps += 1
            if steps > 1:
                counts.append(steps - 1)
        error = np.std(counts) / math.sqrt(len(counts))
        assert work.mean_walk(mesh, math.radians(2.0)) == pytest.approx(
            np.mean(counts), abs=4.0 * error
        )

    def test_tolerances(self, state):
        settings = {"sigma_deg": 2.0, "walks": 50, "seed": 1, "tolerances": [1e-7, 1e-10]}
        found = work.tolerance(Job("tolerance", "hzd/base", settings), state)
        assert found["cost_ratio"] is None
        rows = found["rows"]
        assert [row["tolerance"] for row in rows] == [1e-10, 1e-7]
        assert rows[0]["same"] == 1.0
        # A step would have to pass a failure condition within 1e-7 rad to end otherwise.
        assert rows[1]["same"] >= 0.98

    def test_sliding_costs_at_most_ten_times_a_smooth_law(self):
        name = "smc/mfpt"
        cycle = work.cycle(Job("cycle", name))
        walking, model = controller(name), readings()[name].model
        # The sliding mode takes some work, or the law would not be what is integrated.
        assert 1.5 < work.cost_of_sliding(walking, model, cycle["state"]) <= 10.0

    def test_slopes(self, state):
        rows = work.slopes(Job("slopes", "hzd/base", {"steps": 20, "steepening_deg": 1.0}), state)[
            "rows"
        ]
        steps = {(r["torques_off_late"], r["torque_limit"], r["slope_deg"]): r for r in rows}
        assert steps[False, 50.0, 0.0]["steps"] == 20
        assert steps[False, 50.0, 0.0]["fell"] is None
        # Section 6.3: it cannot take more than several steps down 1 degree.
        assert steps[False, 50.0, -1.0]["steps"] < 10
        assert steps[False, 50.0, -1.0]["fell"]
        assert steps[True, 50.0, 0.0]["steps"] == 20
        assert steps[True, 50.0, -9.0]["fell"] is None


@pytest.mark.parametrize("deaf", [0, 1, cli_reproduce._MOST_TRIES])
def test_a_mesh_is_grown_again_if_its_recorder_misses_the_mfpt(tmp_path, monkeypatch, deaf):
    """A recorder that an analysis finds too late hears nothing of it, and never will."""
    from biped_mfpt_ros.cli.client import WaitedInVain

    (job,) = make_plan(["hzd/cot"], quick=True).of("mesh")[:1]
    recorders, solved = [], []

    def add(make, name, **parameters):
        Path(parameters["bag"].strip("'")).mkdir()  # a second recorder refuses what is there
        heard = 0 if len(recorders) < deaf else len(cli_reproduce.SIGMA_DEG["hzd"])
        recorders.append(Mock(failed=False, counts={"mfpt": heard}))
        return recorders[-1]

    def wait(condition, timeout, what):
        if not condition():
            raise WaitedInVain(what)

    client = MagicMock(add=add, wait=wait)
    client.__enter__.return_value = client
    monkeypatch.setattr("biped_mfpt_ros.cli.client.Client", lambda *_: client)
    monkeypatch.setattr(cli_reproduce, "_grow", lambda *_: {"mesh_id": "m"})
    monkeypatch.setattr(cli_reproduce, "_missing_in_bag", lambda *_: "")
    monkeypatch.setattr(cli_reproduce, "_solve", lambda *arguments: solved.append(arguments[2]))
    study = Mock(plan=Mock(controllers=["hzd/cot"]), seconds={})
    grow = partial(cli_reproduce._meshes, study, [job], Mock(), tmp_path)
    if deaf < cli_reproduce._MOST_TRIES:
        grow()
        assert [grown.job for grown in solved] == [job]
        assert len(recorders) == deaf + 1
    else:
        with pytest.raises(CommandError, match=f"{job.name}.*without its MFPT"):
            grow()
        assert len(recorders) == deaf
    assert all(recorder.close.called for recorder in recorders)


# With the nodes, of the controller whose meshes have a few dozen states.
ARGUMENTS = ("--quick", "--controllers", "hzd/cot", "--walks", "60", "--workers", "1")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Killed in the middle, then run to the end: directory, report, times of the results."""
    directory = tmp_path_factory.mktemp("study") / "it's here"
    command = [*COMMAND, *ARGUMENTS, "--no-pictures", "--output", str(directory)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 600.0
    while not list(directory.glob("results/mesh-*.json")):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.kill()
    process.wait()
    assert not (directory / "report.html").exists()
    before = modified(directory)
    done = subprocess.run(
        [*command, "--json"], capture_output=True, text=True, timeout=600.0, check=False
    )
    assert done.returncode == 0, done.stderr
    return directory, json.loads(done.stdout), before


class TestCommand:
    def test_what_was_done_is_not_done_again(self, finished):
        directory, report, before = finished
        after = modified(directory)
        assert before
        assert {name: after[name] for name in before} == before
        assert len(after) == len(report["results"]) > len(before)

    def test_again_takes_no_work(self, finished, capsys):
        directory, report, _ = finished
        before = modified(directory)
        arguments = ["reproduce", *ARGUMENTS, "--no-pictures", "--output", str(directory)]
        assert main([*arguments, "--json"]) == 0
        # It only writes the report anew.
        assert modified(directory) == before
        again = json.loads(capsys.readouterr().out)
        assert again["tables"] == report["tables"]
        assert again["results"] == report["results"]

    def test_files(self, finished):
        directory, report, _ = finished
        page = (directory / "report.html").read_text()
        assert_self_contained(page)
        written = json.loads((directory / "report.json").read_text())
        # Another test wrote it once more, which took another time.
        assert written | {"seconds": {}} == report | {"seconds": {}}
        for name, table in report["tables"].items():
            lines = list(csv.DictReader(io.StringIO((directory / f"{name}.csv").read_text())))
            assert len(lines) == len(table["rows"])
        points = list(csv.DictReader(io.StringIO((directory / "figure2.csv").read_text())))
        assert len(points) >= 30
        (curve,) = report["curves"]
        assert [float(p["sigma_s_deg"]) for p in points] == curve["sigma_deg"]
        assert [float(p["mfpt"]) for p in points] == [float(v) for v in curve["mfpt"]]

    def test_each_mesh_has_a_bag_of_its_own(self, finished):
        from biped_mfpt_ros.bag import inspect_bag

        directory, report, _ = finished
        meshes = [r for r in report["results"] if r["kind"] == "mesh"]
        assert len(meshes) == len(make_plan(["hzd/cot"], quick=True).of("mesh"))
        for mesh in meshes:
            found = inspect_bag(directory / mesh["result"]["bag"])
            assert not found.problems
            assert found.identical
            (recorded,) = found.meshes
            assert recorded.mesh_id == mesh["result"]["mesh_id"]
            assert recorded.states == mesh["result"]["states"]
            for estimate in recorded.estimates:
                at = mesh["settings"]["sigma_deg"].index(round(math.degrees(estimate.sigma_s), 9))
                assert mesh["result"]["mfpt"][at] == estimate.mfpt

    def test_bad_input(self, capsys, tmp_path):
        for arguments, problem in (
            (["--workers", "0"], "--workers: 0"),
            (["--controllers", "hzd/worst"], "hzd/worst"),
            (["--walks", "1"], "--walks: 1"),
        ):
            output = tmp_path / "never"
            assert main(["reproduce", "--output", str(output), *arguments]) == 2
            assert problem in capsys.readouterr().err
            assert not output.exists()


def modified(directory: Path):
    """Times of the results by their names, ns."""
    return {path.name: path.stat().st_mtime_ns for path in directory.glob("results/*.json")}
