"""The benchmarks run and check what they time; their times are never judged here."""

from __future__ import annotations

import json

import numpy as np
import pytest

from biped_mfpt_ros.bench import __main__ as bench
from biped_mfpt_ros.bench import chain, step_map
from biped_mfpt_ros.bench.measure import BenchError


def test_short_benchmarks(capsys):
    assert bench.main(["--short", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert all(0 < row["low"] <= row["median"] <= row["high"] for row in result["rows"])
    for swings in ("hzd/base", "hzd/base, flat cycle"):
        assert result["ratios"][f"scipy_over_step_map: {swings}"] > 0


def test_a_wrong_result_is_an_error(capsys, monkeypatch):
    true = step_map.simulate_steps

    def wrong(*arguments, **named):
        steps = true(*arguments, **named)
        tight = len(arguments) == 5 and arguments[4] is not None and arguments[4].tolerance < 1e-11
        steps.next_states[:] += 1e-3 * tight
        return steps

    monkeypatch.setattr(step_map, "simulate_steps", wrong)
    assert bench.main(["--short", "--only", "step map"]) == 1
    assert "error" in capsys.readouterr().err


def test_another_swing_for_scipy_is_an_error(monkeypatch):
    *swings, durations = step_map.swings_of("hzd/base")
    assert durations.min() < 0.1 < 0.6 < durations.max()  # early falls, and last impacts
    monkeypatch.setattr(step_map, "swings_of", lambda *_: (*swings, durations + 1e-3))
    with pytest.raises(BenchError, match="hzd/base: scipy ends"):
        step_map.scipy_swings("hzd/base", 1, False)


def test_chains_of_the_benchmark_settle_and_are_exact():
    # 10000 states once made a chain that takes thousands of steps, which only the full run saw.
    for states in (1, 2_000, 10_000):
        mesh = chain.chain_mesh(states)
        assert mesh.targets[1, len(mesh.slopes) // 2] == 1  # x_2, on flat ground
        sigmas = chain._SIGMAS[[0, 1, 25, 49]]
        assert chain.check_chain(chain._solved(mesh, sigmas), sigmas) < 1e-10


def test_correlated_chains_of_the_benchmark_settle_and_are_exact():
    sigmas = chain._SIGMAS[[0, 7]]
    for states in (chain._WITH_SLOPES, 10_000, 20_000):
        mesh = chain.chain_mesh(states)
        _, slopes = np.nonzero(mesh.targets)
        assert (mesh.preceding[mesh.targets[mesh.targets > 0]] == slopes).all()
        found = chain._solved(mesh, sigmas, correlation=0.5)
        assert chain.check_chain(found, sigmas, 0.5) < 1e-10
        assert found[0].mfpt < 0.9 * chain._solved(mesh, sigmas[:1])[0].mfpt
