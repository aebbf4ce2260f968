"""What the paper leaves unsaid, fitted to the numbers that it prints.

The paper states neither torque limit nor friction, nor whether a slip of a millisecond is a fall.
A *reading* is one choice of these. Each is judged by the Monte Carlo means of Tables 2 and 4 and by
the remark that all six controllers walk on flat ground.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.gait.cycle import NoLimitCycle, find_limit_cycle
from biped_mfpt_ros.gait.monte_carlo import MonteCarlo, monte_carlo
from biped_mfpt_ros.walker.robot import WalkerModel

FREE_PARAMETERS = ("torque_limit", "friction", "slip_duration")
"""Fields of `WalkerModel` that the paper leaves open."""

# Where the flat gait breaks a condition, walks start from the gait that a laxer ground allows.
_LAX_FRICTION = (0.8, 1.5, 100.0)
_LAX_TORQUE = (200.0, math.inf)


@dataclass(frozen=True)
class Target:
    """A controller and what the paper says of it.

    Attributes
    ----------
    controller : Controller
        What walks.
    sigma_s : float
        rad, standard deviation of the slope.
    mean_steps : float
        The paper's Monte Carlo mean, the first step dropped.
    """

    controller: Controller
    sigma_s: float
    mean_steps: float


@dataclass(frozen=True)
class Fit:
    """A reading, and how well it serves the targets.

    Attributes
    ----------
    model : WalkerModel
        The reading.
    walks : dict of str to MonteCarlo
        By the controller's name.
    flat : dict of str to bool
        Whether the controller has a limit cycle on flat ground, by its name.
    residuals : dict of str to float
        ``ln(mean / paper)``; ``-inf`` where no walk takes more than a step.
    """

    model: WalkerModel
    walks: Mapping[str, MonteCarlo]
    flat: Mapping[str, bool]
    residuals: Mapping[str, float]

    @property
    def misfit(self) -> float:
        """Root mean square of the residuals; inf where a controller does not walk at all."""
        return math.sqrt(sum(r * r for r in self.residuals.values()) / len(self.residuals))

    @property
    def noise(self) -> float:
        """Root mean square of the residuals' standard errors, ours alone."""
        errors = [w.standard_error / w.mean_steps for w in self.walks.values()]
        return math.sqrt(sum(e * e for e in errors) / len(errors))


def start_state(controller: Controller, model: WalkerModel) -> tuple[np.ndarray, bool]:
    """State where walks begin, and whether it is on a flat limit cycle under the model itself.

    Raises
    ------
    NoLimitCycle
        If there is no cycle under laxer limits either.
    """
    try:
        return find_limit_cycle(controller, model=model).state, True
    except NoLimitCycle as error:
        for torque_limit in (model.torque_limit, *_LAX_TORQUE):
            for friction in _LAX_FRICTION:
                lax = replace(model, torque_limit=torque_limit, friction=friction)
                try:
                    return find_limit_cycle(controller, model=lax).state, False
                except NoLimitCycle:
                    continue
        raise error


def judge(
    model: WalkerModel, targets: Sequence[Target], walks: int, seed: int, max_steps: int = 2000
) -> Fit:
    """Walk every target under one reading.

    Parameters
    ----------
    model : WalkerModel
        The reading.
    targets : sequence of Target
        What is compared.
    walks, seed : int
        As `monte_carlo`; the same slopes for every reading, so that differences are sharp.
    max_steps : int, optional
        Walks are stopped there.

    Returns
    -------
    Fit
        Means and residuals.
    """
    results, flat, residuals = {}, {}, {}
    for target in targets:
        name = target.controller.name
        state, flat[name] = start_state(target.controller, model)
        walked = monte_carlo(
            target.controller,
            target.sigma_s,
            walks,
            seed,
            model=model,
            state=state,
            max_steps=max_steps,
        )
        mean = walked.mean_steps
        results[name] = walked
        residuals[name] = -math.inf if math.isnan(mean) else math.log(mean / target.mean_steps)
    return Fit(model, results, flat, residuals)


def calibrate(
    models: Sequence[WalkerModel],
    targets: Sequence[Target],
    walks: int,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> list[Fit]:
    """Judge every reading; the best comes first.

    Readings under which a target has no flat limit cycle come after those under which all have
    one: the paper says that all of them walk on the flat.
    """
    fits = []
    for done, model in enumerate(models, 1):
        fits.append(judge(model, targets, walks, seed))
        if progress is not None:
            progress(done, len(models))
    return sorted(fits, key=lambda fit: (not all(fit.flat.values()), fit.misfit))


def determined(fits: Sequence[Fit]) -> dict[str, tuple[float, float]]:
    """Range of each open parameter among the readings that are as good as the best, within noise.

    A reading counts as good if its misfit exceeds the best one's by no more than twice the noise of
    the means. A range as wide as the grid says that the numbers do not determine the parameter.
    """
    best = fits[0]
    good = [
        fit.model
        for fit in fits
        if fit.misfit <= best.misfit + 2.0 * best.noise
        and all(fit.flat.values()) == all(best.flat.values())
    ]
    return {
        name: (
            min(getattr(model, name) for model in good),
            max(getattr(model, name) for model in good),
        )
        for name in FREE_PARAMETERS
    }
