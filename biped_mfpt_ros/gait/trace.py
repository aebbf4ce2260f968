"""What happens within a step: samples of the motion, torques and forces, for pictures and tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.gait.integrate import ROWS, SIZE
from biped_mfpt_ros.gait.step import SAMPLE_COLUMNS, _set_state, _swing, check_states
from biped_mfpt_ros.walker import dynamics
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import STATE_SIZE, WalkerModel
from biped_mfpt_ros.walker.terrain import check_slopes

_MOST_SAMPLES = 20_000


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
    start = check_states(np.asarray(state, dtype=np.float64)[None], "state")[0]
    previous = float(check_slopes([previous_slope], "previous_slope")[0])
    scratch = np.zeros((ROWS, SIZE))
    outcome = np.zeros(1, dtype=np.uint8)
    duration, length, energy = np.zeros((3, 1))
    after = np.zeros((1, STATE_SIZE))
    samples = np.zeros((_MOST_SAMPLES, SAMPLE_COLUMNS))
    _set_state(scratch, start)
    _, _, count = _swing(
        controller.code,
        model.packed(),
        controller.packed(model.robot),
        previous,
        check_slopes([slope], "slope"),
        scratch,
        np.zeros((dynamics.WORKSPACE_ROWS, 5)),
        outcome,
        duration,
        length,
        energy,
        after,
        samples,
    )
    samples = samples[:count]
    fell = outcome[0] != Outcome.STEP
    return Trace(
        times=samples[:, 0],
        states=dynamics.to_joint(samples[:, 1:11]),
        torques=samples[:, 11:15],
        forces=samples[:, 15:17],
        energies=samples[:, 17],
        outcome=Outcome(int(outcome[0])),
        next_state=None if fell else dynamics.to_joint(after[0]),
    )
