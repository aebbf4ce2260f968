"""Dynamics and impact against conservation laws and a second formulation of the equations."""

from __future__ import annotations

import math

import numpy as np
import pytest

from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.walker import dynamics
from biped_mfpt_ros.walker.impact import impact_map
from biped_mfpt_ros.walker.robot import ABSOLUTE, WalkerModel, rabbit
from biped_mfpt_ros.walker.terrain import check_slopes, slope_set

ROBOT = rabbit()
RNG = np.random.default_rng(20)
# Any posture and rates twice those of a walking robot.
STATES = np.concatenate([RNG.uniform(-np.pi, np.pi, (200, 5)), RNG.normal(0, 6, (200, 5))], axis=1)


def links():
    """Ends and masses of the links: (index of q's in the absolute angle, parent end, length, ...).

    Written from the description of the robot alone, link by link, as the second formulation
    below needs it: absolute angle, distance of the upper joint and of the lower joint from the
    centre of mass along e(a), mass, inertia.
    """
    femur, tibia = ROBOT.femur_length, ROBOT.tibia_length
    return [
        # stance femur and swing femur: hip to knee
        (ROBOT.femur_mass, ROBOT.femur_inertia, -ROBOT.femur_com, femur - ROBOT.femur_com),
        (ROBOT.femur_mass, ROBOT.femur_inertia, -ROBOT.femur_com, femur - ROBOT.femur_com),
        # tibiae: knee to foot
        (ROBOT.tibia_mass, ROBOT.tibia_inertia, -ROBOT.tibia_com, tibia - ROBOT.tibia_com),
        (ROBOT.tibia_mass, ROBOT.tibia_inertia, -ROBOT.tibia_com, tibia - ROBOT.tibia_com),
        # torso: from the hip
        (ROBOT.torso_mass, ROBOT.torso_inertia, -ROBOT.torso_com, 0.0),
    ]


# Which ends meet: (link, 0 upper or 1 lower end, link, end).
JOINTS = [(0, 0, 4, 0), (1, 0, 4, 0), (0, 1, 2, 0), (1, 1, 3, 0)]


def maximal_coordinates(a, da, pinned):
    """Newton-Euler in maximal coordinates: every link free, held by joints and a pinned foot.

    Returns the mass matrix (15, 15), the constraints' Jacobian (10, 15) and its rate times the
    velocities (10,). Coordinates: x, y, angle of each link. ``pinned`` is the tibia whose foot
    stands on the ground.
    """
    e = np.stack([-np.sin(a), np.cos(a)], axis=1)
    de = np.stack([-np.cos(a), -np.sin(a)], axis=1)
    mass = np.diag(np.concatenate([[m, m, inertia] for m, inertia, *_ in links()]))
    jacobian, bias = np.zeros((10, 15)), np.zeros(10)

    def end(row, link, which, sign):
        arm = links()[link][2 + which]
        jacobian[row : row + 2, 3 * link : 3 * link + 2] += sign * np.eye(2)
        jacobian[row : row + 2, 3 * link + 2] += sign * arm * de[link]
        bias[row : row + 2] += sign * arm * -e[link] * da[link] ** 2

    for k, (first, first_end, second, second_end) in enumerate(JOINTS):
        end(2 * k, first, first_end, 1.0)
        end(2 * k, second, second_end, -1.0)
    end(8, pinned, 1, 1.0)
    return mass, jacobian, bias


def velocities(a, da):
    """Velocities (15,) of the links for absolute rates, the stance foot (tibia 2) at rest."""
    _, jacobian, _ = maximal_coordinates(a, da, 2)
    out = np.zeros(15)
    out[2::3] = da
    free = np.setdiff1d(np.arange(15), np.arange(2, 15, 3))
    out[free] = np.linalg.solve(jacobian[:, free], -jacobian[:, 2::3] @ da)
    return out


def test_accelerations_and_ground_force_agree_with_newton_euler():
    """Generalised coordinates against free links with constraint forces, to rounding."""
    packed = WalkerModel().packed()
    torques = RNG.normal(0, 50, (len(STATES), 4))
    for state, u in zip(STATES, torques, strict=True):
        a, da = ABSOLUTE @ state[:5], ABSOLUTE @ state[5:]
        mass, jacobian, bias = maximal_coordinates(a, da, 2)
        force = np.zeros(15)
        force[1::3] = -ROBOT.gravity * np.diag(mass)[1::3]
        force[2::3] = [u[0] - u[2], u[1] - u[3], u[2], u[3], -u[0] - u[1]]
        kkt = np.block([[mass, jacobian.T], [jacobian, np.zeros((10, 10))]])
        solution = np.linalg.solve(kkt, np.concatenate([force, -bias]))
        expected = np.linalg.solve(ABSOLUTE, solution[2:15:3])
        found = dynamics.accelerations(state, u, ROBOT)
        scale = np.abs(expected).max()
        assert np.abs(found - expected).max() <= 1e-9 * max(1.0, scale)

        s, c = dynamics.sines(tuple(a))
        dda = tuple(ABSOLUTE @ found)
        links = dynamics.link_accelerations(s, c, tuple(da), dda)
        ground = dynamics.ground_force(packed, *links)
        # The multiplier is the force on the ground.
        assert np.allclose(ground, -solution[23:25], rtol=1e-9, atol=1e-8)
        required = dynamics.required_torques(packed, s, c, dda, *links)
        assert np.allclose(required, u, rtol=1e-9, atol=1e-8)


def test_prescribed_motion_fulfils_the_equations_of_motion():
    """Four prescribed accelerations: the torques found reproduce them in the full equations."""
    packed = WalkerModel().packed()
    for state in STATES:
        y = dynamics.to_absolute(state)
        s, c = dynamics.sines(tuple(y[:5]))
        da = tuple(y[5:])
        alpha = tuple(RNG.normal(0, 30, 5))
        beta = (1.0, 0.0, 1.0, 0.0, 0.0)  # sliding mode
        inertia = ABSOLUTE.T @ np.linalg.inv(
            ABSOLUTE @ np.linalg.inv(dynamics.inertia_matrix(state[:5], ROBOT)) @ ABSOLUTE.T
        )
        if abs(inertia[4] @ beta) < 0.1:  # kg m^2: next to singular, rounding is magnified
            continue
        acceleration = np.array(dynamics.prescribed_motion(packed, s, c, da, alpha, beta))
        links = dynamics.link_accelerations(s, c, da, tuple(acceleration))
        torques = dynamics.required_torques(packed, s, c, tuple(acceleration), *links)
        found = ABSOLUTE @ dynamics.accelerations(state, np.array(torques), ROBOT)
        assert np.allclose(found, acceleration, rtol=1e-9, atol=1e-9 * np.abs(acceleration).max())


def test_inertia_matrix_is_symmetric_positive_definite():
    for state in STATES:
        inertia = dynamics.inertia_matrix(state[:5], ROBOT)
        assert np.array_equal(inertia, inertia.T) or np.allclose(inertia, inertia.T, atol=1e-14)
        assert np.linalg.eigvalsh(inertia).min() > 0.0


def test_impact_agrees_with_impulses_on_free_links():
    for state in STATES:
        a, da = ABSOLUTE @ state[:5], ABSOLUTE @ state[5:]
        before = velocities(a, da)
        mass, jacobian, _ = maximal_coordinates(a, da, 3)  # the swing foot is held, the other free
        kkt = np.block([[mass, jacobian.T], [jacobian, np.zeros((10, 10))]])
        solution = np.linalg.solve(kkt, np.concatenate([mass @ before, np.zeros(10)]))
        after = solution[2:15:3][[1, 0, 3, 2, 4]]
        found, impulse = impact_map(state, ROBOT)
        expected = np.linalg.solve(ABSOLUTE, after)
        assert np.allclose(found[5:], expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
        # To rounding: angles go through sums with the torso's.
        assert np.allclose(found[:5], state[[1, 0, 3, 2, 4]], rtol=0, atol=1e-14)
        assert np.allclose(impulse, -solution[23:25], rtol=1e-9, atol=1e-8)


def angular_momentum(a, v, about):
    """Angular momentum (kg m^2/s) of links with velocities v about a point."""
    position = ROBOT.link_positions @ np.stack([-np.sin(a), np.cos(a)], axis=1) - about
    velocity = v.reshape(5, 3)[:, :2]
    cross = position[:, 0] * velocity[:, 1] - position[:, 1] * velocity[:, 0]
    return float(ROBOT.link_masses @ cross + ROBOT.link_inertias @ v[2::3])


def test_impact_conserves_angular_momentum_and_never_adds_energy():
    for state in STATES:
        a, da = ABSOLUTE @ state[:5], ABSOLUTE @ state[5:]
        foot = ROBOT.swing_foot_position @ np.stack([-np.sin(a), np.cos(a)], axis=1)
        after, _ = impact_map(state, ROBOT)
        new_a, new_da = ABSOLUTE @ after[:5], ABSOLUTE @ after[5:]
        momentum = angular_momentum(a, velocities(a, da), foot)
        new_momentum = angular_momentum(new_a, velocities(new_a, new_da), np.zeros(2))
        kinetic, new_kinetic = dynamics.energy(state, ROBOT)[0], dynamics.energy(after, ROBOT)[0]
        # Rounding of sums whose terms are of the size of the kinetic energy over the rates.
        assert new_momentum == pytest.approx(momentum, rel=1e-11, abs=1e-11 * kinetic)
        assert new_kinetic <= kinetic * (1 + 1e-12)


def test_sine_and_cosine_to_3e_15():
    for reach in (1.0, 10.0, 1e3, 1e5):
        angles = RNG.uniform(-reach, reach, 5000)
        found = np.array([dynamics.sine_cosine(angle) for angle in angles])
        # The C library's are right to less than a unit; numpy's, in some versions, are not.
        expected = np.array([(math.sin(angle), math.cos(angle)) for angle in angles])
        # The polynomial of the cosine is good to 2.1e-15, and rounding adds a few units of 1.1e-16.
        assert np.abs(found - expected).max() <= 3e-15
    assert np.isnan(dynamics.sine_cosine(math.nan)).all()


def test_direction_is_that_of_the_c_library():
    angles = np.linspace(-math.pi, math.pi, 721)
    for length in (1e-3, 1.0, 1e3):
        x, y = length * np.cos(angles), length * np.sin(angles)
        found = np.array([dynamics.direction(*point) for point in zip(x, y, strict=True)])
        wanted = [math.atan2(*point) for point in zip(y, x, strict=True)]
        # What sines are good for, and a rounding of numbers up to 3.2.
        assert np.abs(found - wanted).max() <= 4e-15


def test_slope_set_of_the_paper():
    slopes = slope_set(0.5)
    assert slopes.size == 81
    assert slopes[40] == 0.0
    assert np.array_equal(slopes, -slopes[::-1])
    assert np.allclose(np.degrees(slopes), np.arange(-40, 41) / 2, rtol=1e-15, atol=1e-14)


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: slope_set(0.3), "slope_step_deg"),
        (lambda: slope_set(-1.0), "slope_step_deg"),
        (lambda: slope_set(math.nan), "slope_step_deg"),
        (lambda: slope_set(1.0, 90.0), "slope_limit_deg"),
        (lambda: check_slopes([0.0, 0.0]), r"slopes\[1\]"),
        (lambda: check_slopes([0.1, -0.1]), r"slopes\[1\]"),
        (lambda: check_slopes([math.nan]), r"slopes\[0\]"),
        (lambda: check_slopes([]), "slopes"),
        (lambda: check_slopes([2.0]), r"slopes\[0\]"),
        (lambda: WalkerModel(torque_limit=0.0), "torque_limit"),
        (lambda: WalkerModel(friction=math.nan), "friction"),
        (lambda: WalkerModel(slip_duration=-1.0), "slip_duration"),
        (lambda: WalkerModel(time_limit=0.0), "time_limit"),
        (lambda: WalkerModel(tolerance=1.0), "tolerance"),
        (lambda: WalkerModel(friction_frame="level"), "friction_frame"),
    ],
)
def test_values_that_are_not_allowed_are_named(call, field):
    with pytest.raises(InputError, match=rf"^{field}: .* is not allowed; allowed: "):
        call()
