"""Limit cycles: fixed points of the step map on a constant slope."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.step import Steps, check_state, simulate_steps
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import STATE_SIZE, Robot, WalkerModel
from biped_mfpt_ros.walker.terrain import SLOPE_LIMIT

# Rates at which the search starts, rad/s. The paper's cycles lie between 1 and 3.
_START_RATES = np.linspace(0.4, 4.0, 37)
_WALK_STEPS = 60  # plain steps of the search before it gives up
_NEWTON_STEPS = 25
_DIFFERENCE = 1e-5  # rad and rad/s, half the width of a central difference
_TOLERANCE = 1e-11  # of the integrator: a difference of _DIFFERENCE then keeps six digits
_MOST_EVALUATIONS = 20_000_000  # of a search, some 6 s; the paper's gaits take up to 4 million
_RESIDUAL = 1e-9  # rad and rad/s, of a cycle that has been found


class NoLimitCycle(ArithmeticError):
    """No limit cycle was found; the message says how the search ended."""


@dataclass(frozen=True)
class LimitCycle:
    """A limit cycle of one step on a constant slope.

    Attributes
    ----------
    controller : Controller
        What walks.
    slope : float
        rad.
    state : numpy.ndarray
        ``[q, dq]`` just after impact, rad and rad/s, shape (10,).
    period : float
        s.
    step_length : float
        m, from foot to foot.
    cost_of_transport : float
        Integral of ``sum |u_i dq_i|`` over ``m g step_length`` (eq. 36).
    eigenvalues : numpy.ndarray
        Of the step map's Jacobian at the cycle, complex, shape (10,), largest magnitude first. The
        cycle is stable if all lie inside the unit circle.
    residual : float
        rad and rad/s, largest difference between the state and the next one.
    """

    controller: Controller
    slope: float
    state: np.ndarray
    period: float
    step_length: float
    cost_of_transport: float
    eigenvalues: np.ndarray
    residual: float

    @property
    def speed(self) -> float:
        """m/s, along the slope."""
        return self.step_length / self.period

    @property
    def stable(self) -> bool:
        """Whether small deviations die out."""
        return bool(abs(self.eigenvalues[0]) < 1.0)


def limit_cycle_of(
    controller: Controller,
    slope: float,
    state: np.ndarray,
    steps: Steps,
    jacobian: np.ndarray,
    robot: Robot,
    residual: float,
) -> LimitCycle:
    """The limit cycle at a fixed point of the step map.

    Parameters
    ----------
    controller, slope, state, residual
        As in `LimitCycle`.
    steps : Steps
        The one step from the state, with its measures.
    jacobian : numpy.ndarray
        Of the step map at the state, shape (10, 10).
    robot : Robot
        The links.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the eigenvalues of the Jacobian are not found.
    """
    length = float(steps.step_lengths[0, 0])
    eigenvalues = np.linalg.eigvals(jacobian)
    return LimitCycle(
        controller=controller,
        slope=slope,
        state=state,
        period=float(steps.durations[0, 0]),
        step_length=length,
        cost_of_transport=float(steps.energies[0, 0]) / (robot.mass * robot.gravity * length),
        eigenvalues=eigenvalues[np.argsort(-np.abs(eigenvalues), kind="stable")],
        residual=residual,
    )


def find_limit_cycle(
    controller: Controller,
    slope: float = 0.0,
    model: WalkerModel | None = None,
    guess: ArrayLike | None = None,
) -> LimitCycle:
    """Find a limit cycle by Newton's method on the step map.

    Starts are states without tracking error over a range of speeds, or ``guess``. They walk on as
    long as they do not fall; from the most periodic ones Newton's method finishes, so that unstable
    cycles and those with a slow mode are found too. A stable cycle is preferred to an unstable one.

    Parameters
    ----------
    controller : Controller
        What walks.
    slope : float, optional
        rad, behind and ahead.
    model : WalkerModel, optional
        Torque limit, friction and so on. The integrator's tolerance is at most 1e-11 here, so that
        the Jacobian's differences keep six digits.
    guess : array_like, optional
        ``[q, dq]`` just after impact, shape (10,).

    Returns
    -------
    LimitCycle
        The cycle; see its ``stable``.

    Raises
    ------
    NoLimitCycle
        If none was found, or the swings cost too much to look for one.
    InputError
        If slope or guess is not allowed.
    """
    if not abs(slope) <= SLOPE_LIMIT:
        raise InputError("slope", slope, f"within {SLOPE_LIMIT:.4f} rad")
    model = model or WalkerModel()
    model = replace(model, tolerance=min(model.tolerance, _TOLERANCE))
    if guess is None:
        states = np.array([controller.reference_state(r, model.robot) for r in _START_RATES])
    else:
        states = check_state(guess, "guess")[np.newaxis]
    search = _Search(controller, slope, model)
    falls: np.ndarray = np.empty(0, dtype=np.uint8)
    unstable: LimitCycle | None = None
    behind = slope if guess is not None else 0.0  # the starts come from flat ground
    for walked in range(_WALK_STEPS):
        steps = search.steps(states, behind)
        behind = slope
        upright = steps.outcomes[:, 0] == Outcome.STEP
        falls = steps.outcomes[~upright, 0] if (~upright).any() else falls
        if not upright.any():
            break
        distance = np.abs(steps.next_states - states[upright]).max(axis=1)
        best = int(np.argmin(distance))
        # Newton from the start is cheap and catches unstable cycles; later only near a cycle.
        if walked in (0, 5, _WALK_STEPS - 1) or distance[best] < 1e-3:
            cycle = _newton(search, steps.next_states[best])
            if cycle is not None and cycle.stable:
                return cycle
            unstable = unstable or cycle
        states = steps.next_states
    if unstable is not None:
        return unstable
    reason = "walked on without becoming periodic"
    if falls.size:
        common = Outcome(int(np.bincount(falls).argmax()))
        reason = f"most falls: {common.label}"
    raise NoLimitCycle(
        f"no limit cycle of {controller.name} found on a slope of {np.degrees(slope):g} degrees "
        f"with torque limit {model.torque_limit:g} N m and friction {model.friction:g}: "
        f"{len(states)} starts, {walked + 1} step{'s' if walked else ''} at most, {reason}"
    )


class _Search:
    """The step map on a slope, with a bound on what all its swings may cost together."""

    def __init__(self, controller: Controller, slope: float, model: WalkerModel) -> None:
        self.controller, self.slope, self.model = controller, slope, model
        self._left = _MOST_EVALUATIONS

    def steps(self, states: np.ndarray, behind: float) -> Steps:
        """One step from each state; NoLimitCycle when that costs too much."""
        previous = np.full(len(states), behind)
        steps = simulate_steps(
            self.controller, states, previous, [self.slope], self.model, self._left
        )
        self._left -= steps.evaluations
        if self._left <= 0:
            raise NoLimitCycle(
                f"no limit cycle of {self.controller.name} found: the search was given up after "
                f"{_MOST_EVALUATIONS} evaluations of the closed loop, as its swings crawl"
            )
        return steps


def _newton(search: _Search, state: np.ndarray) -> LimitCycle | None:
    """Damped Newton iteration from a state; None where it does not converge."""
    slope, robot = search.slope, search.model.robot

    def residual(states: np.ndarray) -> tuple[np.ndarray, bool]:
        steps = search.steps(states, slope)
        if not (steps.outcomes == Outcome.STEP).all():
            return states, False
        return steps.next_states - states, True

    difference = _DIFFERENCE * np.concatenate([np.eye(STATE_SIZE), -np.eye(STATE_SIZE)])
    value, walks = residual(state[None])
    for _ in range(_NEWTON_STEPS):
        around, all_walk = residual(state + difference)
        if not (walks and all_walk):
            return None
        jacobian = (around[:STATE_SIZE] - around[STATE_SIZE:]).T / (2.0 * _DIFFERENCE)
        size = np.abs(value).max()
        if size < _RESIDUAL:
            steps = search.steps(state[None], slope)
            return limit_cycle_of(
                search.controller, slope, state, steps, jacobian + np.eye(STATE_SIZE), robot,
                float(size),
            )  # fmt: skip
        try:
            move = np.linalg.solve(jacobian, -value[0])
        except np.linalg.LinAlgError:
            return None
        for damping in (1.0, 0.5, 0.25, 0.125, 0.0625):
            trial, trial_walks = residual((state + damping * move)[None])
            if trial_walks and np.abs(trial).max() < size:
                state, value = state + damping * move, trial
                break
        else:
            return None
    return None
