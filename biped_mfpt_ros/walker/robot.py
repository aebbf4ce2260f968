"""The five-link point-foot biped RABBIT: its links, and what a step of it is simulated with.

Angles and signs
----------------
Counter-clockwise is positive and the robot walks towards +x. A link at absolute angle ``a`` points
along ``e(a) = (-sin a, cos a)``. The joint angles ``q`` (rad) are

====  =====================================================================
q1    stance femur relative to the torso, hip to knee (near pi)
q2    swing femur relative to the torso, hip to knee (near pi)
q3    stance tibia relative to the stance femur, knee to foot (negative)
q4    swing tibia relative to the swing femur, knee to foot (negative)
q5    torso, absolute, hip to head, from the upward vertical
====  =====================================================================

The kernels work in the absolute angles ``a`` of the same links in the same order (stance femur,
swing femur, stance tibia, swing tibia, torso), where ``e(a_i)`` sums to every position. A state is
``[q1..q5, dq1..dq5]`` everywhere outside the kernels.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files

import numpy as np

from biped_mfpt_ros.errors import InputError

STATE_SIZE = 10

# a = ABSOLUTE @ q, and for the rates alike.
ABSOLUTE = np.array(
    [
        [1.0, 0.0, 0.0, 0.0, 1.0],
        [0.0, 1.0, 0.0, 0.0, 1.0],
        [1.0, 0.0, 1.0, 0.0, 1.0],
        [0.0, 1.0, 0.0, 1.0, 1.0],
        [0.0, 0.0, 0.0, 0.0, 1.0],
    ]
)

# Offsets into the packed model (WalkerModel.packed), as the kernels read it.
C = 0  # 25: C_ij, inertia matrix D_ij = C_ij cos(a_i - a_j) + I_i delta_ij
I_LINK = 25  # 5: I_i, about each link's own centre of mass
W = 30  # 5: w_i = sum_k m_k c_ki, centre of mass of the whole times the mass
MASS = 35  # total mass
GRAVITY = 36
FEMUR = 37  # length
TIBIA = 38  # length
TORSO = 39  # length
TORQUE_LIMIT = 40
FRICTION = 41
SLIP_DURATION = 42
TIME_LIMIT = 43
TOLERANCE = 44
VERTICAL_FRICTION = 45  # 1: friction at impact is judged against the vertical
PACKED_SIZE = 46

FRICTION_FRAMES = ("slope", "vertical")
"""Allowed values of `WalkerModel.friction_frame`."""

# Of a robot, SI units: positive is not enough, products of such values must neither overflow nor
# vanish.
_LEAST, _MOST = 1e-6, 1e6

_ABOVE_ZERO = math.ulp(0.0)


@dataclass(frozen=True)
class Robot:
    """Links of the planar five-link biped, with identical legs (SI units).

    Attributes
    ----------
    torso_mass, femur_mass, tibia_mass : float
        kg, of each link.
    torso_length, femur_length, tibia_length : float
        m.
    torso_com, femur_com : float
        m, centre of mass from the hip.
    tibia_com : float
        m, centre of mass from the knee.
    torso_inertia, femur_inertia, tibia_inertia : float
        kg m^2, about the link's own centre of mass.
    gravity : float
        m/s^2.

    Raises
    ------
    InputError
        If a value is no number from 1e-6 to 1e6, or for a centre of mass, which may lie anywhere
        along the line of its link, from -1e6 to 1e6.
    """

    torso_mass: float
    femur_mass: float
    tibia_mass: float
    torso_length: float
    femur_length: float
    tibia_length: float
    torso_com: float
    femur_com: float
    tibia_com: float
    torso_inertia: float
    femur_inertia: float
    tibia_inertia: float
    gravity: float

    def __post_init__(self) -> None:
        """Check every value, and make it a float."""
        for name, value in vars(self).items():
            low = -_MOST if name.endswith("_com") else _LEAST
            _check(name, value, low, _MOST, f"a number from {low:g} to {_MOST:g}")
            object.__setattr__(self, name, float(value))

    @property
    def mass(self) -> float:
        """Total mass, kg."""
        return self.torso_mass + 2.0 * (self.femur_mass + self.tibia_mass)

    @property
    def link_masses(self) -> np.ndarray:
        """Masses of the links, kg, shape (5,), in the order of the absolute angles."""
        return np.array(
            [self.femur_mass, self.femur_mass, self.tibia_mass, self.tibia_mass, self.torso_mass]
        )

    @property
    def link_inertias(self) -> np.ndarray:
        """Inertias of the links, kg m^2, shape (5,), in the order of the absolute angles."""
        return np.array(
            [
                self.femur_inertia,
                self.femur_inertia,
                self.tibia_inertia,
                self.tibia_inertia,
                self.torso_inertia,
            ]
        )

    @property
    def link_positions(self) -> np.ndarray:
        """Centres of mass from the stance foot: ``p_k = sum_j c_kj e(a_j)``, m, shape (5, 5)."""
        femur, tibia = self.femur_length, self.tibia_length
        hip = np.array([-femur, 0.0, -tibia, 0.0, 0.0])
        stance_knee = np.array([0.0, 0.0, -tibia, 0.0, 0.0])
        swing_knee = hip + np.array([0.0, femur, 0.0, 0.0, 0.0])
        unit = np.eye(5)
        return np.array(
            [
                hip + self.femur_com * unit[0],
                hip + self.femur_com * unit[1],
                stance_knee + self.tibia_com * unit[2],
                swing_knee + self.tibia_com * unit[3],
                hip + self.torso_com * unit[4],
            ]
        )

    @property
    def swing_foot_position(self) -> np.ndarray:
        """Swing foot from the stance foot: ``sum_j f_j e(a_j)``, m, shape (5,)."""
        femur, tibia = self.femur_length, self.tibia_length
        return np.array([-femur, femur, -tibia, tibia, 0.0])


def weighted_sum(weights: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """``sum_k weights[k] rows[k]``, in the same order of operations on every machine.

    BLAS and `numpy.einsum` choose the order, and whether to round products, by the processor. What
    the kernels read must not differ between the machines that share the steps of a mesh.

    Parameters
    ----------
    weights, rows : numpy.ndarray
        First axis alike; the others are broadcast.
    """
    total = weights[0] * rows[0]
    for weight, row in zip(weights[1:], rows[1:], strict=True):
        total = total + weight * row
    return total


@cache
def rabbit() -> Robot:
    """RABBIT, with the constants of ``data/rabbit.json``."""
    text = files("biped_mfpt_ros").joinpath("data/rabbit.json").read_text()
    data = json.loads(text)
    torso, femur, tibia = data["torso"], data["femur"], data["tibia"]
    return Robot(
        torso_mass=torso["mass"],
        femur_mass=femur["mass"],
        tibia_mass=tibia["mass"],
        torso_length=torso["length"],
        femur_length=femur["length"],
        tibia_length=tibia["length"],
        torso_com=torso["centre_of_mass_from_hip"],
        femur_com=femur["centre_of_mass_from_hip"],
        tibia_com=tibia["centre_of_mass_from_knee"],
        torso_inertia=torso["inertia"],
        femur_inertia=femur["inertia"],
        tibia_inertia=tibia["inertia"],
        gravity=data["gravity"],
    )


@dataclass(frozen=True)
class WalkerModel:
    """What a step is simulated with, apart from controller and terrain.

    Attributes
    ----------
    torque_limit : float
        N m, ``|u_i|`` on every joint; ``inf`` for none. The paper states no limit; 50 reproduces
        its Table 2 and its remark that the HZD base controller cannot walk down 1 degree.
    friction : float
        mu_s of eq. (4). The paper states none; 0.6 goes with the torque limit.
    slip_duration : float
        s, how long the stance foot must slip without a break before it counts as a fall.
    time_limit : float
        s, a swing that lasts longer is a fall. The slowest gait of the paper takes 0.83 s.
    tolerance : float
        Local error of the integrator, in every angle (rad) and rate (rad/s), relative to
        ``1 + |value|``. With the default the states after impact of the paper's HZD gaits on rough
        ground are right to 8e-7 (worst of 7342 states on 81 slopes).
    friction_frame : str
        Which way the ground's normal points when friction is judged at impact: "slope",
        perpendicular to the slope that the swing foot lands on, or "vertical". The paper does not
        say.
    robot : Robot
        The links.

    Raises
    ------
    InputError
        If a value is out of its range.
    """

    torque_limit: float = 50.0
    friction: float = 0.6
    slip_duration: float = 0.0
    time_limit: float = 3.0
    tolerance: float = 4e-8
    friction_frame: str = "slope"
    robot: Robot = field(default_factory=rabbit)

    def __post_init__(self) -> None:
        """Check every value."""
        _check("torque_limit", self.torque_limit, _ABOVE_ZERO, math.inf, "> 0 N m, inf for none")
        _check("friction", self.friction, _ABOVE_ZERO, math.inf, "> 0, inf for no slip")
        _check("slip_duration", self.slip_duration, 0.0, 1.0, "0 to 1 s")
        _check("time_limit", self.time_limit, _ABOVE_ZERO, 60.0, "above 0, to 60 s")
        _check("tolerance", self.tolerance, 1e-13, 1e-2, "1e-13 to 1e-2")
        if self.friction_frame not in FRICTION_FRAMES:
            raise InputError("friction_frame", self.friction_frame, " or ".join(FRICTION_FRAMES))

    def packed(self) -> np.ndarray:
        """All constants as the kernels read them: float64, shape (PACKED_SIZE,)."""
        robot = self.robot
        masses, position = robot.link_masses, robot.link_positions
        out = np.empty(PACKED_SIZE)
        coupling = weighted_sum(masses, position[:, :, None] * position[:, None, :])
        out[C : C + 25] = coupling.ravel()
        out[I_LINK : I_LINK + 5] = robot.link_inertias
        out[W : W + 5] = weighted_sum(masses, position)
        out[MASS] = robot.mass
        out[GRAVITY] = robot.gravity
        out[FEMUR] = robot.femur_length
        out[TIBIA] = robot.tibia_length
        out[TORSO] = robot.torso_length
        out[TORQUE_LIMIT] = self.torque_limit
        out[FRICTION] = min(self.friction, 1e12)  # keeps its product with a zero force finite
        out[SLIP_DURATION] = self.slip_duration
        out[TIME_LIMIT] = self.time_limit
        out[TOLERANCE] = self.tolerance
        out[VERTICAL_FRICTION] = float(self.friction_frame == "vertical")
        return out


def _check(name: str, value: float, low: float, high: float, allowed: str) -> None:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not low <= value <= high:
        raise InputError(name, value, allowed)
