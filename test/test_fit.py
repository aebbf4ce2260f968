"""B-spline references fitted to those of hybrid zero dynamics."""

from __future__ import annotations

import math

import pytest

from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.monte_carlo import monte_carlo
from biped_mfpt_ros.optimise.fit import as_spline
from biped_mfpt_ros.walker.robot import WalkerModel


@pytest.mark.parametrize("name", ["hzd/base", "hzd/mfpt", "hzd/robust"])
def test_walks_much_as_what_it_was_fitted_to(name):
    """Eight coefficients follow a polynomial of degree six to some hundredths of a radian."""
    source, model = controller(name), WalkerModel()
    fitted = as_spline(source, model.robot)
    assert (fitted.scheme, fitted.name) == ("spline", f"spline/from-{name[4:]}")
    cycle, before = find_limit_cycle(fitted), find_limit_cycle(source)
    assert cycle.stable
    assert cycle.speed == pytest.approx(before.speed, rel=0.3)


def test_of_the_robust_gait_is_robust():
    """Where a search starts: none of 50 walks at 5 degrees, where hzd/mfpt takes 2 steps, falls."""
    fitted = as_spline(controller("hzd/robust"), WalkerModel().robot)
    found = monte_carlo(fitted, math.radians(5.0), 50, seed=1, max_steps=200)
    assert found.falls <= 1


def test_other_schemes_are_refused():
    with pytest.raises(InputError, match="scheme: 'smc' is not allowed; allowed: hzd"):
        as_spline(controller("smc/base"), WalkerModel().robot)
