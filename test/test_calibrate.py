"""The fit of what the paper leaves unsaid."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from biped_mfpt_ros.cli import main
from biped_mfpt_ros.report import paper
from biped_mfpt_ros.study.calibrate import (
    PARAMETERS,
    Fit,
    Grid,
    Judged,
    Sharing,
    fit,
    reading,
    reading_job,
    scatter,
    scatter_job,
    sharings,
)
from biped_mfpt_ros.walker.robot import WalkerModel


def result(name, walks=100, **settings):
    return reading(reading_job(name, WalkerModel(tolerance=1e-6, **settings), walks, 1))


class TestReading:
    def test_limit_and_friction_of_the_defaults_serve_table_2(self):
        found = result("hzd/base", 400)
        assert found["failed"] == ""
        assert found["mean_steps"] == pytest.approx(2.1511, abs=3 * found["standard_error"])
        # A mesh of some twenty states is good to some per cent.
        for chain in found["chain"].values():
            assert chain == pytest.approx(2.2085, rel=0.15)

    def test_without_torque_limit_base_walks_down_one_degree(self):
        """The remark of section 6.3 that speaks for a limit; an independent prototype agrees."""
        assert result("hzd/base", torque_limit=math.inf)["failed"] == "walks down 1 degree"

    def test_without_torque_limit_cot_walks_too_far(self):
        """An independent prototype's number, 2.62 instead of 2.2487."""
        found = result("hzd/cot", 400, torque_limit=math.inf)
        assert found["mean_steps"] == pytest.approx(2.62, abs=3.5 * found["standard_error"])

    def test_a_slip_of_some_milliseconds_decides_over_the_flat_gait_of_smc_base(self):
        assert result("smc/base", 2)["failed"] == "no gait on flat ground"

    def test_scatter_of_coarse_meshes(self):
        found = scatter(scatter_job("hzd/cot", WalkerModel(tolerance=1e-6)))
        assert len(found["mfpt"]) == 12
        logs = np.log(found["mfpt"])
        assert found["scatter"] == pytest.approx(math.sqrt(logs.var() * 12 / 11), rel=1e-12)
        assert 0.0 < found["scatter"] < 0.3


# Of a made-up walker: ln(mean / paper) is known as a function of the reading.

GRID = Grid(
    {
        "torque_limit": (40.0, 50.0, 60.0),
        "friction": (0.5, 0.6, 0.7),
        "slip_duration": (0.0,),
        "friction_frame": ("slope", "vertical"),
        "scale_refresh": ("generation", "addition"),
    },
    1e-6,
)
NAMES = ("hzd/base", "hzd/mfpt")


def made_up(name, off, *, failed=lambda model: "", chain=0.0):
    """Numbers off the paper's by exp(off(model)); a chain off by more with "addition"."""
    sigma = 2.0
    mean, mfpt = paper.monte_carlo(name, 0.0, sigma), paper.mfpt(name, 0.0, sigma)
    results = {}
    for index, model in GRID.models():
        ours = mean * math.exp(off(model))
        results[index] = {"failed": failed(model)} if failed(model) else {
            "failed": "", "walks": 10_000, "mean_steps": ours,
            # With the paper's own error as large, a residual may be 0.01 by chance.
            "standard_error": 0.01 / math.sqrt(2.0) * ours,
            "chain": {"generation": mfpt * math.exp(chain), "addition": mfpt * math.exp(2 * chain)},
        }  # fmt: skip
    return Judged(name, GRID, results, 0.1)


def slope_of(model):
    """Steps grow with the limit and with friction alike: only their sum is determined."""
    return 0.02 * (model.torque_limit - 50.0) / 10.0 + 0.02 * (model.friction - 0.6) / 0.1


def profile(found: Fit, parameter, group):
    return next(p for name, of, p in found.profiles if (name, of) == (parameter, group))


class TestFit:
    def test_residuals_count_in_units_of_chance(self):
        judged = made_up("hzd/base", slope_of, chain=0.05)
        chi = judged.chi_squared
        assert chi.shape == GRID.shape == (3, 3, 1, 2, 2)
        # 40 N m and 0.5: 4 % low, of 1 %; the chain 5 % high, of 10 %, or 10 % high.
        assert chi[0, 0, 0, 0] == pytest.approx([16.25, 17.0])
        assert chi[0, 2, 0, 1] == pytest.approx([0.25, 1.0])

    def test_numbers_determine_two_parameters_only_together(self):
        judged = {n: made_up(n, slope_of, chain=0.05) for n in NAMES}
        found = fit(judged, GRID, Sharing("one", (NAMES,)))
        assert found.chi_squared == pytest.approx(0.5)
        assert found.scale == 1.0
        along = profile(found, "torque_limit", NAMES)
        # Friction makes up for the limit, so every limit is as good.
        assert [v for v, _ in along] == [40.0, 50.0, 60.0]
        assert found.as_good(along) == [40.0, 50.0, 60.0]
        assert found.as_good(profile(found, "scale_refresh", NAMES)) == ["generation"]
        best = found.readings["hzd/base"]
        assert slope_of(WalkerModel(best["torque_limit"], best["friction"])) == pytest.approx(0.0)
        assert found.residuals["hzd/base"] == pytest.approx((0.0, 0.05), abs=1e-9)

    def test_what_no_reading_explains_widens_the_errors(self):
        """Two controllers that want different limits: none serves both, and errors say so."""
        judged = {
            "hzd/base": made_up("hzd/base", lambda m: 0.01 * (m.torque_limit - 60.0)),
            "hzd/mfpt": made_up("hzd/mfpt", lambda m: 0.01 * (m.torque_limit - 40.0)),
        }
        shared = fit(judged, GRID, Sharing("one", (NAMES,)))
        assert shared.readings["hzd/base"]["torque_limit"] == 50.0
        assert shared.chi_squared == pytest.approx(200.0)
        assert shared.numbers - shared.free == 2
        assert shared.scale == pytest.approx(100.0)
        alone = fit(judged, GRID, Sharing("own", tuple((n,) for n in NAMES)))
        assert alone.chi_squared == pytest.approx(0.0)
        assert [alone.readings[n]["torque_limit"] for n in NAMES] == [60.0, 40.0]
        assert alone.as_good(profile(alone, "torque_limit", ("hzd/mfpt",))) == [40.0]
        everything_else = tuple(p for p in PARAMETERS if p != "torque_limit")
        rest = fit(judged, GRID, Sharing("rest", tuple((n,) for n in NAMES), everything_else))
        assert [rest.readings[n]["torque_limit"] for n in NAMES] == [60.0, 40.0]
        assert len({rest.readings[n]["friction"] for n in NAMES}) == 1

    def test_every_profile_is_the_least_over_all_other_parameters(self):
        """Against going through all readings of both controllers one by one."""
        random = np.random.default_rng(1)
        table = {n: random.normal(0.0, 0.03, GRID.shape) for n in NAMES}
        judged = {n: made_up(n, lambda m: 0.0) for n in NAMES}
        for n in NAMES:
            judged[n].residuals[..., 0] = table[n]
        common = ("friction", "scale_refresh")
        found = fit(judged, GRID, Sharing("some", tuple((n,) for n in NAMES), common))
        indices = list(np.ndindex(*GRID.shape))
        chi = {n: judged[n].chi_squared for n in NAMES}
        pairs = [
            (i, j, chi[NAMES[0]][i] + chi[NAMES[1]][j])
            for i in indices
            for j in indices
            if (i[1], i[4]) == (j[1], j[4])
        ]
        assert found.chi_squared == pytest.approx(min(c for *_, c in pairs))
        for axis, name in enumerate(PARAMETERS):
            for which, group in enumerate((NAMES,) if name in common else [(n,) for n in NAMES]):
                for k, (_, value) in enumerate(profile(found, name, group)):
                    least = min(c for *pair, c in pairs if pair[which][axis] == k)
                    assert value == pytest.approx(least)

    def test_readings_that_break_a_claim_are_out(self):
        judged = {
            "hzd/base": made_up(
                "hzd/base", lambda m: 0.0, failed=lambda m: "falls" if m.friction < 0.65 else ""
            ),
            "hzd/mfpt": made_up("hzd/mfpt", slope_of),
        }
        assert judged["hzd/base"].failed == {"falls": 12}
        found = fit(judged, GRID, Sharing("one", (NAMES,)))
        assert found.readings["hzd/mfpt"]["friction"] == 0.7
        assert profile(found, "friction", NAMES)[0][1] == math.inf
        judged["hzd/mfpt"] = made_up(
            "hzd/mfpt", slope_of, failed=lambda m: "falls" if m.friction > 0.65 else ""
        )
        none = fit(judged, GRID, Sharing("one", (NAMES,)))
        assert none.readings == {}
        assert none.chi_squared == math.inf

    def test_sharings_of_few_controllers(self):
        assert [len(s.groups) for s in sharings(("hzd/base",))] == [1]
        assert [s.common for s in sharings(NAMES)][1:] == [
            tuple(p for p in PARAMETERS if p != "torque_limit"), (),
        ]  # fmt: skip
        assert [len(s.groups) for s in sharings((*NAMES, "smc/cot"))] == [1, 2, 3, 3]


class TestCommand:
    ARGUMENTS = (
        "--controllers", "hzd/base", "hzd/cot", "--torque-limit", "50", "none", "--friction", "0.6",
        "--slip-duration", "0", "--friction-frame", "slope", "--walks", "40", "--quiet",
    )  # fmt: skip

    def test_result_and_resumption(self, capsys, tmp_path):
        command = ["calibrate", *self.ARGUMENTS, "--workers", "2", "--output", str(tmp_path / "c")]
        assert main([*command, "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        one, *_, each = found["fits"]
        assert one["readings"]["hzd/cot"]["torque_limit"] == 50.0
        assert found["failed"]["hzd/base"] == {"walks down 1 degree": 1}
        limit = next(p for p in each["profiles"] if p["parameter"] == "torque_limit")
        assert [row["value"] for row in limit["profile"]] == [50.0, "inf"]
        kept = {f: f.stat().st_mtime_ns for f in (tmp_path / "c" / "results").iterdir()}
        assert len(kept) == 2 * 2 + 2
        next(iter(kept)).unlink()
        assert main([*command[:-3], "1", "--output", str(tmp_path / "c"), "--json"]) == 0
        # The same, from what was kept and one result computed again, by another number of workers.
        assert json.loads(capsys.readouterr().out) == found
        again = {f: f.stat().st_mtime_ns for f in (tmp_path / "c" / "results").iterdir()}
        assert sum(again[f] != kept[f] for f in kept) == 1
        assert main(command) == 0
        text = capsys.readouterr().out
        assert "ONE READING FOR ALL" in text
        assert "walks down 1 degree" in text

    @pytest.mark.parametrize(
        ("arguments", "problem"),
        [
            (["--controllers", "hzd/nobody"], "hzd/nobody"),
            (["--friction", "0"], "--friction: 0"),
            (["--walks", "1"], "--walks: 1"),
            (["--workers", "0"], "--workers: 0"),
            (["--friction-frame", "level"], "--friction-frame"),
        ],
    )
    def test_bad_input(self, capsys, tmp_path, arguments, problem):
        output = tmp_path / "never"
        assert main(["calibrate", *arguments, "--output", str(output)]) == 2
        assert problem in capsys.readouterr().err
        assert not output.exists()
