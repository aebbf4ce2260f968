"""What happens within a step: samples of the motion, torques and forces, for pictures and tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.gait.ground import slopes_ahead, to_joint
from biped_mfpt_ros.gait.scratch import (
    AHEAD,
    MODE,
    OUTCOME,
    SAMPLES,
    VARIABLES,
    WORKS,
    empty_scratch,
)
from biped_mfpt_ros.gait.step import check_state
from biped_mfpt_ros.gait.swing import SAMPLE_COLUMNS, advance, begin
from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.lanes import LANES
from biped_mfpt_ros.walker import dynamics
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import STATE_SIZE, WalkerModel
from biped_mfpt_ros.walker.terrain import check_slopes

_MOST_SAMPLES = 20_000


@kernel
def _traced(scheme, rob, par, state, previous, slope, next_state, samples):
    """Simulate one swing in lane 0; returns the outcome and how many samples were taken."""
    w, v = empty_scratch(), np.zeros((VARIABLES, LANES))
    w[MODE, WORKS] = 1.0
    active = np.zeros(LANES, np.bool_)
    ahead = np.zeros((LANES, AHEAD, 1 + LANES))
    slopes_ahead(np.array([slope]), ahead[0])
    begin(scheme, rob, par, w, v, 0, state, previous, ahead[0])
    active[0] = True
    while active[0]:
        advance(scheme, rob, par, w, v, active, ahead, samples)
    to_joint(ahead[0], 0, next_state)
    return int(ahead[0, OUTCOME, 0]), int(v[SAMPLES, 0])


@dataclass(frozen=True)
class Trace:
    """One swing, sampled from impact to impact or to the fall.

    Attributes
    ----------
    times : numpy.ndarray
        s since the impact, shape (k,); denser where the motion changes faster.
    states : numpy.ndarray
        ``[q, dq]``, rad and rad/s, shape (k, 10).
    torques : numpy.ndarray
        u1 to u4, N m, shape (k, 4).
    forces : numpy.ndarray
        Of the ground on the stance foot: tangential, normal, N, shape (k, 2).
    energies : numpy.ndarray
        J spent so far, integral of ``sum |u_i dq_i|``, shape (k,).
    outcome : Outcome
        How the step ended.
    next_state : numpy.ndarray or None
        ``[q, dq]`` just after the impact, shape (10,); None for a fall.
    """

    times: np.ndarray
    states: np.ndarray
    torques: np.ndarray
    forces: np.ndarray
    energies: np.ndarray
    outcome: Outcome
    next_state: np.ndarray | None


def trace_swing(
    controller: Controller,
    state: ArrayLike,
    previous_slope: float,
    slope: float,
    model: WalkerModel | None = None,
) -> Trace:
    """Simulate one step as `simulate_steps` does, and keep what happens on the way.

    Parameters
    ----------
    controller : Controller
        What walks.
    state : array_like
        ``[q, dq]`` just after impact, rad and rad/s, shape (10,).
    previous_slope, slope : float
        rad, behind and ahead.
    model : WalkerModel, optional
        Torque limit, friction and so on.

    Returns
    -------
    Trace
        The swing.

    Raises
    ------
    InputError
        As `simulate_steps`.
    """
    model = model or WalkerModel()
    start = check_state(state)
    previous = float(check_slopes([previous_slope], "previous_slope")[0])
    after = np.zeros(STATE_SIZE)
    samples = np.zeros((_MOST_SAMPLES, SAMPLE_COLUMNS))
    code, count = _traced(
        controller.code,
        model.packed(),
        controller.packed(model.robot),
        start,
        previous,
        float(check_slopes([slope], "slope")[0]),
        after,
        samples,
    )
    samples = samples[:count]
    outcome = Outcome(code)
    return Trace(
        times=samples[:, 0],
        states=dynamics.to_joint(samples[:, 1:11]),
        torques=samples[:, 11:15],
        forces=samples[:, 15:17],
        energies=samples[:, 17],
        outcome=outcome,
        next_state=after if outcome == Outcome.STEP else None,
    )
