"""Messages to arrays and objects of the core, and back. Bit-exact, and no rclpy in here.

Everything read from a message is checked. What is wrong is an `InputError` that names the field as
it stands in the message, such as ``controller.parameters[3]``.
"""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from biped_mfpt_msgs import msg
from biped_mfpt_msgs.srv import SimulateSteps
from builtin_interfaces.msg import Time

from biped_mfpt_ros.chain.mesh import DEFAULT_MAX_STATES, SCALE_REFRESHES, Mesh
from biped_mfpt_ros.control.controller import Controller, controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.step import Steps, check_states
from biped_mfpt_ros.models import ROBOT_FIELDS, robot_from
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import STATE_SIZE, Robot, WalkerModel, rabbit
from biped_mfpt_ros.walker.terrain import check_slopes, slope_set

if TYPE_CHECKING:  # a simulator needs no chain, and importing it takes a fifth of its start
    from biped_mfpt_ros.chain.markov import Metastability

DEFAULT_SLOPE_STEP_DEG = 0.25
"""Between the slopes of a mesh whose settings name none, as on the command line."""

MESSAGE_BYTES = 1_000_000
"""Size at which published arrays are split: larger messages cost more time a byte."""

# Plain numbers: with members of an enumeration NumPy compares in 64 bits, ten times slower.
_STEP, _LAST_OUTCOME = int(Outcome.STEP), int(max(Outcome))


def packed(values: np.ndarray, code: str) -> array[Any]:
    """Array of any shape as the field of a message, row-major.

    ``code`` is 'd' for float64[], 'I' for uint32[], 'B' for uint8[]. This is one copy of the bytes;
    assigning the numpy array itself converts number by number.
    """
    out = array(code)
    out.frombytes(np.ascontiguousarray(values, dtype=code).reshape(-1).view(np.uint8).data)
    return out


def unpacked(field: Sequence[Any] | np.ndarray, code: str) -> np.ndarray:
    """Field of a message as a flat numpy array, without a copy where the field is an array."""
    if isinstance(field, (array, np.ndarray, bytes)):
        # An empty buffer has no address, which frombuffer refuses.
        return np.frombuffer(field, dtype=code) if len(field) else np.empty(0, dtype=code)
    return np.array(field, dtype=code)


def unpacked_rows(
    field: Sequence[Any] | np.ndarray, code: str, columns: int, name: str
) -> np.ndarray:
    """Field of a message as a numpy array of shape (n, columns); InputError if it does not fit."""
    flat = unpacked(field, code)
    if flat.size % columns:
        raise InputError(name, f"length {flat.size}", f"a multiple of {columns}")
    return flat.reshape(-1, columns)


def stamp() -> Time:
    """The system's time now, as the stamp of a message."""
    seconds, nanoseconds = divmod(time.time_ns(), 1_000_000_000)
    return Time(sec=seconds, nanosec=nanoseconds)


@contextmanager
def _inside(name: str) -> Iterator[None]:
    """Put the name of the message in front of the fields of errors."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{name}.{error.field}", error.value, error.allowed) from None


def controller_message(walking: Controller) -> msg.Controller:
    """Controller as a message, its parameters spelled out."""
    return msg.Controller(
        name=walking.name, scheme=walking.scheme, parameters=packed(walking.parameters, "d")
    )


def controller_from(message: msg.Controller, robot: Robot, name: str = "controller") -> Controller:
    """Controller of a message, for a robot: one of the catalogue if it has no parameters.

    Raises
    ------
    InputError
        If the catalogue has none of that name, or scheme or parameters are not allowed.
    """
    if len(message.parameters) == 0:
        try:
            named = controller(message.name)
        except InputError as error:
            raise InputError(f"{name}.name", error.value, error.allowed) from None
        if message.scheme not in ("", named.scheme):
            raise InputError(f"{name}.scheme", message.scheme, f"{named.scheme} or empty")
        return named
    with _inside(name):
        parameters = unpacked(message.parameters, "d").tobytes()
        return _checked(message.name, message.scheme, parameters, robot)


@lru_cache(maxsize=8)
def _checked(name: str, scheme: str, parameters: bytes, robot: Robot) -> Controller:
    """A controller that can be used. A mesh asks for the same one again and again."""
    made = Controller(name, scheme, np.frombuffer(parameters))
    made.packed(robot)  # checks ranges
    return made


def model_message(model: WalkerModel) -> msg.WalkerModel:
    """Walker model as a message."""
    return msg.WalkerModel(
        torque_limit=float(model.torque_limit),
        friction=float(model.friction),
        slip_duration=float(model.slip_duration),
        time_limit=float(model.time_limit),
        tolerance=float(model.tolerance),
        friction_frame=model.friction_frame,
        robot=msg.Robot(**{name: float(getattr(model.robot, name)) for name in ROBOT_FIELDS}),
    )


def model_from(message: msg.WalkerModel, name: str = "model") -> WalkerModel:
    """Walker model of a message; raises InputError."""
    with _inside(name):
        return WalkerModel(
            torque_limit=message.torque_limit,
            friction=message.friction,
            slip_duration=message.slip_duration,
            time_limit=message.time_limit,
            tolerance=message.tolerance,
            friction_frame=message.friction_frame or "slope",
            robot=_robot_from(message.robot),
        )


def _robot_from(message: msg.Robot) -> Robot:
    values = {name: getattr(message, name) for name in ROBOT_FIELDS}
    return robot_from(values) if any(values.values()) else rabbit()


@dataclass(frozen=True, eq=False)
class MeshSettings:
    """All that determines a mesh (Algorithm 1).

    Attributes
    ----------
    controller : Controller
        What walks.
    model : WalkerModel
        What it walks with.
    slopes : numpy.ndarray
        rad, slope set S, shape (m,), strictly ascending.
    threshold : float
        d_thr, > 0.
    clustered : bool
        Whether the nearest state is sought among those of the same preceding slope.
    scale_refresh : str
        When r_i of eq. (25) is computed anew: "generation" or "addition", see `grow_mesh`.
    max_states : int
        States at which the mesh is given up, 2 to 2^32 - 1.
    initial_state : numpy.ndarray or None
        x_2, shape (10,); None: the limit cycle on flat ground.
    initial_slope : float
        rad, the slope that precedes x_2: one of ``slopes``.

    Raises
    ------
    InputError
        If a value is not allowed.
    """

    controller: Controller
    model: WalkerModel
    slopes: np.ndarray
    threshold: float
    clustered: bool = True
    max_states: int = DEFAULT_MAX_STATES
    initial_state: np.ndarray | None = None
    initial_slope: float = 0.0
    scale_refresh: str = "generation"

    def __post_init__(self) -> None:
        """Check every value."""
        slopes = check_slopes(self.slopes)
        object.__setattr__(self, "slopes", slopes)
        if not (math.isfinite(self.threshold) and self.threshold > 0.0):
            raise InputError("threshold", self.threshold, "finite, > 0")
        if self.scale_refresh not in SCALE_REFRESHES:
            raise InputError("scale_refresh", self.scale_refresh, " or ".join(SCALE_REFRESHES))
        if not 2 <= self.max_states < 2**32:
            raise InputError("max_states", self.max_states, f"2 to {2**32 - 1}")
        if self.initial_state is not None:
            state = np.ravel(self.initial_state)
            if state.size != STATE_SIZE:
                raise InputError(
                    "initial_state", f"length {state.size}", f"{STATE_SIZE} numbers, or none"
                )
            object.__setattr__(self, "initial_state", check_states([state], "initial_state")[0])
        # As close as `grow_mesh` wants it.
        if not np.abs(slopes - self.initial_slope).min() <= 1e-12:
            raise InputError("initial_slope", self.initial_slope, "one of slopes, in rad")


def settings_message(settings: MeshSettings) -> msg.MeshSettings:
    """Mesh settings as a message."""
    initial = np.empty(0) if settings.initial_state is None else settings.initial_state
    return msg.MeshSettings(
        controller=controller_message(settings.controller),
        model=model_message(settings.model),
        slopes=packed(settings.slopes, "d"),
        threshold=float(settings.threshold),
        clustered=bool(settings.clustered),
        scale_refresh=settings.scale_refresh,
        max_states=settings.max_states,
        initial_state=packed(initial, "d"),
        initial_slope=float(settings.initial_slope),
    )


def settings_from(message: msg.MeshSettings, name: str = "settings") -> MeshSettings:
    """Mesh settings of a message; raises InputError."""
    with _inside(name):
        initial = unpacked(message.initial_state, "d")
        slopes = unpacked(message.slopes, "d")
        model = model_from(message.model)
        return MeshSettings(
            controller=controller_from(message.controller, model.robot),
            model=model,
            slopes=slopes.copy() if slopes.size else slope_set(DEFAULT_SLOPE_STEP_DEG),
            threshold=message.threshold,
            clustered=message.clustered,
            scale_refresh=message.scale_refresh or "generation",
            max_states=message.max_states,
            initial_state=initial.copy() if initial.size else None,
            initial_slope=message.initial_slope,
        )


@dataclass(frozen=True, eq=False)
class StepsRequest:
    """Arguments of `simulate_steps`, as they came in a request."""

    controller: Controller
    model: WalkerModel
    states: np.ndarray
    previous_slopes: np.ndarray
    slopes: np.ndarray


def steps_request_from(
    request: SimulateSteps.Request, most_states: int, most_outcomes: int
) -> StepsRequest:
    """Arguments of a request, its size checked before anything of that size is made.

    States and slopes themselves are checked by `simulate_steps`, under the same names.

    Parameters
    ----------
    request : SimulateSteps.Request
        The request.
    most_states : int
        Most states in a request.
    most_outcomes : int
        Most outcomes, states times slopes.

    Raises
    ------
    InputError
        If it is too large, a length does not fit, or controller or model are not allowed.
    """
    states = unpacked_rows(request.states, "d", STATE_SIZE, "states")
    slopes = unpacked(request.slopes, "d")
    n = states.shape[0]
    if n > most_states:
        raise InputError("states", f"{n} states", f"at most {most_states} in a request")
    if n * slopes.size > most_outcomes:
        raise InputError(
            "states", f"{n} states times {slopes.size} slopes", f"at most {most_outcomes} outcomes"
        )
    model = model_from(request.model)
    return StepsRequest(
        controller_from(request.controller, model.robot),
        model,
        states,
        unpacked(request.previous_slopes, "d"),
        slopes,
    )


def fill_response(response: SimulateSteps.Response, steps: Steps) -> None:
    """Put steps into the answer to a request."""
    response.success = True
    response.outcomes = packed(steps.outcomes, "B")
    response.next_states = packed(steps.next_states, "d")
    response.durations = packed(steps.durations, "d")
    response.step_lengths = packed(steps.step_lengths, "d")
    response.energies = packed(steps.energies, "d")
    response.seconds = steps.seconds
    response.integrator_steps = steps.integrator_steps
    response.evaluations = steps.evaluations


def steps_from(response: SimulateSteps.Response, n: int, m: int) -> Steps:
    """Steps of an answer to a request of n states and m slopes, checked.

    Measures that were not asked for have shape (0, m).

    Raises
    ------
    InputError
        If a length does not fit, or a value cannot be a step's.
    """
    outcomes = unpacked(response.outcomes, "B")
    if outcomes.size != n * m:
        raise InputError("outcomes", f"length {outcomes.size}", f"{n} x {m}")
    if outcomes.size and outcomes.max() > _LAST_OUTCOME:
        raise InputError("outcomes", int(outcomes.max()), f"codes 0 to {_LAST_OUTCOME}")
    steps = int(np.count_nonzero(outcomes == _STEP))
    following = unpacked(response.next_states, "d")
    if following.size != steps * STATE_SIZE:
        raise InputError(
            "next_states", f"length {following.size}", f"{steps} successful steps x {STATE_SIZE}"
        )
    if not np.isfinite(following).all():
        raise InputError("next_states", "not finite", "finite rad and rad/s")
    if not (math.isfinite(response.seconds) and response.seconds >= 0.0):
        raise InputError("seconds", response.seconds, "finite, >= 0")
    measures = []
    for name in ("durations", "step_lengths", "energies"):
        values = unpacked(getattr(response, name), "d")
        if values.size not in (0, n * m):
            raise InputError(name, f"length {values.size}", f"{n} x {m}, or none")
        if not np.isfinite(values).all():
            raise InputError(name, "not finite", "finite numbers")
        measures.append(values.reshape(-1, m))
    durations, step_lengths, energies = measures
    return Steps(
        outcomes.reshape(n, m),
        following.reshape(steps, STATE_SIZE),
        durations,
        step_lengths,
        energies,
        seconds=response.seconds,
        integrator_steps=response.integrator_steps,
        evaluations=response.evaluations,
    )


def states_messages(
    mesh_id: str, generation: int, first_index: int, states: np.ndarray, preceding: np.ndarray
) -> Iterator[msg.MeshStates]:
    """States that a generation added, in messages of about `MESSAGE_BYTES`.

    Parameters
    ----------
    mesh_id : str
        The mesh they belong to.
    generation : int
        0 for the initial state.
    first_index : int
        Index of the first of them.
    states : numpy.ndarray
        rad and rad/s, shape (n, 10).
    preceding : numpy.ndarray
        uint32, shape (n,).
    """
    rows = MESSAGE_BYTES // (8 * STATE_SIZE + 4)
    for start in range(0, len(states), rows):
        yield msg.MeshStates(
            mesh_id=mesh_id,
            generation=generation,
            first_index=first_index + start,
            states=packed(states[start : start + rows], "d"),
            preceding=packed(preceding[start : start + rows], "I"),
        )


def all_states_messages(mesh_id: str, mesh: Mesh) -> list[msg.MeshStates]:
    """States of a whole mesh but x_1, generation by generation, as they are published."""
    out: list[msg.MeshStates] = []
    for generation in range(int(mesh.generation.max()) + 1):
        rows = np.flatnonzero(mesh.generation == generation)
        rows = rows[rows > 0]
        out += states_messages(
            mesh_id, generation, int(rows[0]), mesh.states[rows], mesh.preceding[rows]
        )
    return out


def transitions_messages(
    mesh_id: str, targets: np.ndarray, outcomes: np.ndarray
) -> Iterator[msg.MeshTransitions]:
    """Rows of the state-transition map but that of x_1, in messages of about `MESSAGE_BYTES`.

    Parameters
    ----------
    mesh_id : str
        The mesh they belong to.
    targets, outcomes : numpy.ndarray
        uint32 and uint8, shape (n, m), row 0 that of x_1.
    """
    rows = max(1, MESSAGE_BYTES // (5 * targets.shape[1]))
    for start in range(1, len(targets), rows):
        yield msg.MeshTransitions(
            mesh_id=mesh_id,
            first_index=start,
            targets=packed(targets[start : start + rows], "I"),
            outcomes=packed(outcomes[start : start + rows], "B"),
        )


def estimate_message(
    mesh_id: str,
    controller: str,
    mesh: Mesh,
    mu_s: float,
    sigma_s: float,
    correlation: float,
    result: Metastability,
    seconds: float,
) -> msg.MfptEstimate:
    """MFPT of a mesh as a message.

    Parameters
    ----------
    mesh_id : str
        The mesh that it comes from.
    controller : str
        Name of the controller.
    mesh : Mesh
        The mesh itself.
    mu_s, sigma_s : float
        rad, mean and standard deviation of the slope.
    correlation : float
        Of each slope with the one before.
    result : Metastability
        What came out.
    seconds : float
        s, time to build and solve the chain.
    """
    shares = {int(code): float(share) for code, share in result.failure_shares.items()}
    return msg.MfptEstimate(
        mesh_id=mesh_id,
        controller=controller,
        mu_s=mu_s,
        sigma_s=sigma_s,
        correlation=correlation,
        mfpt=float(result.mfpt),
        failure_probability=float(result.failure_probability),
        lambda_2=float(result.lambda_2),
        states=len(mesh.states),
        failure_codes=packed(np.array(list(shares)), "B"),
        failure_shares=packed(np.array(list(shares.values())), "d"),
        seconds=seconds,
    )
