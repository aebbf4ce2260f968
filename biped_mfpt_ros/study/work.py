"""The jobs of a study that need no mesh."""

from __future__ import annotations

import base64
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from biped_mfpt_ros.chain.markov import ChainError, metastability, slope_probabilities
from biped_mfpt_ros.chain.mesh import Mesh
from biped_mfpt_ros.control.controller import SCHEMES, Controller, controller
from biped_mfpt_ros.gait.cycle import NoLimitCycle, find_limit_cycle
from biped_mfpt_ros.gait.monte_carlo import monte_carlo
from biped_mfpt_ros.gait.step import simulate_steps
from biped_mfpt_ros.study.plan import Job
from biped_mfpt_ros.study.readings import readings
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import WalkerModel

_PHASE_OFF = 0.95  # section 6.3: no torque above this phase
_MOST_STEPS = 20_000  # of a walk
_COST_TOLERANCE = 1e-7  # as sliding-mode controllers are walked with
_COST_SLOPES = np.radians(np.linspace(-3.0, 3.0, 13))


def cycle(job: Job) -> dict[str, Any]:
    """Limit cycle on flat ground, or why there is none."""
    try:
        found = find_limit_cycle(controller(job.controller), 0.0, readings()[job.controller].model)
    except NoLimitCycle as error:
        return {"found": False, "reason": str(error)}
    return {
        "found": True,
        "state": found.state.tolist(),
        "period": found.period,
        "step_length": found.step_length,
        "speed": found.speed,
        "cost_of_transport": found.cost_of_transport,
        "largest_eigenvalue": float(abs(found.eigenvalues[0])),
        "stable": found.stable,
    }


def walks(job: Job, state: list[float]) -> dict[str, Any]:
    """Monte Carlo from the limit cycle, the first step dropped; on one core."""
    settings = job.settings
    start = time.perf_counter()
    found = monte_carlo(
        controller(job.controller),
        math.radians(settings["at_deg"]),
        settings["walks"],
        settings["seed"],
        model=replace(readings()[job.controller].model, tolerance=settings["tolerance"]),
        state=state,
        max_steps=_MOST_STEPS,
        threads=1,
    )
    low, high = found.confidence_interval
    shares = sorted(found.failure_shares.items(), key=lambda item: -item[1])
    return {
        "mean_steps": found.mean_steps,
        "standard_error": found.standard_error,
        "low": low,
        "high": high,
        "counted_walks": int(found.counted.size),
        "falls": found.falls,
        "failure_shares": {code.name.lower(): share for code, share in shares},
        "steps": int(found.steps.sum()),
        "seconds": time.perf_counter() - start,
    }


def counted(job: Job, state: list[float], bag: Path, mesh_id: str) -> dict[str, Any]:
    """Mean steps that the mesh of a bag predicts for `walks`; None where there is no telling."""
    from biped_mfpt_ros.bag import read_meshes

    mesh = read_meshes(bag)[mesh_id].mesh
    assert mesh is not None
    means: list[float | None] = []
    for sigma_deg in job.settings["sigma_deg"]:
        try:
            means.append(mean_walk(mesh, math.radians(sigma_deg)))
        except ChainError:
            means.append(None)
    return {"mean_steps": means}


def mean_walk(mesh: Mesh, sigma_s: float) -> float:
    """Mean steps of walks from x_2 of a mesh, counted as the paper's Monte Carlo counts.

    Eq. (34) is about a walker that has not fallen for long. Walks start on the limit cycle, their
    first step is dropped, and those that fall in it are not counted: where falls are frequent,
    that makes a difference of some per cent.
    """
    times = metastability(mesh, 0.0, sigma_s).mfpt_from_state
    probabilities = slope_probabilities(mesh.slopes, 0.0, sigma_s)
    second = mesh.targets[1]  # where the first step leads
    return float((probabilities * times[second]).sum() / probabilities[second > 0].sum())


def tolerance(job: Job, state: list[float]) -> dict[str, Any]:
    """Whether the same walks end alike, whatever the tolerance of the integrator; on one core.

    Of a sliding-mode controller also ``cost_ratio``, see `cost_of_sliding`.
    """
    settings = job.settings
    rows, reference = [], None
    for value in sorted(settings["tolerances"]):
        start = time.process_time()
        found = monte_carlo(
            controller(job.controller),
            math.radians(settings["sigma_deg"]),
            settings["walks"],
            settings["seed"],
            model=replace(readings()[job.controller].model, tolerance=value),
            state=state,
            threads=1,
        )
        seconds = time.process_time() - start
        reference = reference or found
        same = (found.steps == reference.steps) & (found.outcomes == reference.outcomes)
        rows.append(
            {
                "tolerance": value,
                "same": float(same.mean()),
                "mean_steps": found.mean_steps,
                "milliseconds": 1e3 * seconds / int(found.steps.sum()),
            }
        )
    walking, model = controller(job.controller), readings()[job.controller].model
    cost = cost_of_sliding(walking, model, state) if walking.scheme == "smc" else None
    return {"rows": rows, "cost_ratio": cost}


def cost_of_sliding(walking: Controller, model: WalkerModel, state: list[float]) -> float:
    """How many times the work of a smooth law the law of a sliding-mode controller costs.

    The smooth one is the same controller with alpha_i = 1, of which the paper says that it would
    be a PD controller. Work is evaluations of the closed loop for each simulated second, over
    single steps from a state onto slopes of -3 to 3 degrees.
    """
    smooth = walking.parameters.copy()
    for i, name in enumerate(SCHEMES[walking.scheme].parameters):
        if name.startswith("alpha"):
            smooth[i] = 1.0
    model = replace(model, tolerance=_COST_TOLERANCE)

    def work(by: Controller) -> float:
        swings = [simulate_steps(by, [state], [0.0], [slope], model) for slope in _COST_SLOPES]
        return sum(s.evaluations for s in swings) / sum(float(s.durations[0, 0]) for s in swings)

    return work(walking) / work(Controller(f"{walking.name}/smooth", walking.scheme, smooth))


def slopes(job: Job, state: list[float]) -> dict[str, Any]:
    """Section 6.3 on hzd/base: steps down 1 degree, and down 9 with torques off late in a step."""
    model = readings()[job.controller].model
    most, steepening_deg = job.settings["steps"], job.settings["steepening_deg"]
    limitless = replace(model, torque_limit=math.inf)
    cases = (
        (False, 0.0, model), (False, -1.0, model), (False, -1.0, limitless),
        (True, 0.0, model), (True, -1.0, model), (True, -9.0, model),
    )  # fmt: skip
    return {
        "rows": [
            {
                "torques_off_late": off,
                "torque_limit": limits.torque_limit,
                "slope_deg": degrees,
                **steps_on(off, degrees, limits, state, most, steepening_deg),
            }
            for off, degrees, limits in cases
        ]
    }


def steps_on(
    off: bool,
    slope_deg: float,
    model: WalkerModel,
    state: list[float],
    most: int,
    steepening_deg: float,
) -> dict[str, Any]:
    """Steps of hzd/base where flat ground gets steeper, step by step, to a constant slope.

    Parameters
    ----------
    off : bool
        Whether there is no torque late in a step (section 6.3).
    slope_deg, steepening_deg : float
        Degrees, the slope in the end and how much steeper it gets from step to step.
    model : WalkerModel
    state : list of float
        Where it starts, ``[q, dq]``, rad and rad/s.
    most : int
        Steps after which it is taken to walk on.

    Returns
    -------
    dict
        ``steps`` before the fall, and how it ``fell``: None if it walks on.
    """
    walking = controller("hzd/base")
    if off:
        late = np.append(walking.parameters, _PHASE_OFF)
        walking = Controller(f"{walking.name}/off", walking.scheme, late)
    slope, steepening = math.radians(slope_deg), math.radians(steepening_deg)
    at, behind = np.array([state]), 0.0
    for taken in range(most):
        ahead = math.copysign(min(abs(slope), (taken + 1) * steepening), slope)
        steps = simulate_steps(walking, at, [behind], [ahead], model)
        outcome = Outcome(int(steps.outcomes[0, 0]))
        if outcome is not Outcome.STEP:
            return {"steps": taken, "fell": outcome.label}
        at, behind = steps.next_states, ahead
    return {"steps": most, "fell": None}


def pictures(job: Job, state: list[float], bag: Path | None, mesh_id: str) -> dict[str, Any]:
    """Draw a controller's gait, and its mesh as a bag has it; without one if that is None."""
    # What draws takes a second to import, and not every worker draws.
    from biped_mfpt_ros.bag import read_meshes
    from biped_mfpt_ros.report.gallery import gallery

    drawn = gallery(
        controller(job.controller),
        readings()[job.controller].model,
        state,
        job.settings["sigma_deg"],
        None if bag is None else read_meshes(bag)[mesh_id].mesh,
        animated=job.settings["animated"],
    )
    return {
        "pictures": [
            {
                "title": picture.title,
                "caption": picture.caption,
                "mime": picture.mime,
                "data": base64.b64encode(picture.data).decode(),
            }
            for picture in drawn
        ]
    }
