"""Controllers against the paper's tables and their own defining equations."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import BPoly

from biped_mfpt_ros.control import hzd, smc
from biped_mfpt_ros.control.controller import Controller, controller, controller_names
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.closed_loop import closed_loop
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.trace import trace_swing
from biped_mfpt_ros.walker import dynamics
from biped_mfpt_ros.walker.robot import ABSOLUTE, WalkerModel, rabbit

HZD_NAMES = [n for n in controller_names() if n.startswith("hzd/")]
SMC_NAMES = [n for n in controller_names() if n.startswith("smc/")]
FREE = WalkerModel(torque_limit=math.inf)
RNG = np.random.default_rng(3)


def bezier(name):
    return controller(name).parameters[2:30].reshape(4, 7)


@pytest.mark.parametrize("name", HZD_NAMES)
def test_hybrid_invariance_gives_the_papers_coefficients(name):
    """Table 1's alpha_0 and alpha_1 from its alpha_5 and alpha_6: kinematics, D, impact at once."""
    table = bezier(name)
    alpha0, alpha1 = hzd.hybrid_invariant_start(table[:, 5], table[:, 6])
    # Four decimals are printed, of inputs and outputs: half a unit on either side.
    assert np.abs(alpha0 - table[:, 0]).max() <= 1e-4
    assert np.abs(alpha1 - table[:, 1]).max() <= 1e-4


def test_phase_of_the_base_gait():
    """theta+, theta- and the torso angle at impact that an independent prototype found."""
    table = bezier("hzd/base")
    assert hzd.phase_range(table, rabbit()) == pytest.approx((-3.3912, -2.8591), abs=5e-5)
    assert hzd.double_support(table[:, 6], rabbit())[4] == pytest.approx(-0.0158, abs=5e-5)


def outputs(name, parameters, q, dq, ddq):
    """h, dh, ddh of an HZD controller, the reference from scipy's Bernstein polynomials."""
    table = parameters[2:30].reshape(4, 7)
    start, end = hzd.phase_range(table, rabbit())
    c = np.array([-1.0, 0.0, -0.5, 0.0, -1.0])
    tau, rate, acceleration = (
        (c @ q - start) / (end - start),
        c @ dq / (end - start),
        c @ ddq / (end - start),
    )
    h, dh, ddh = np.empty((3, 4))
    for i in range(4):
        reference = BPoly(table[i][:, None], [0.0, 1.0])
        first, second = reference.derivative(), reference.derivative(2)
        h[i] = q[i] - reference(tau)
        dh[i] = dq[i] - first(tau) * rate
        ddh[i] = ddq[i] - second(tau) * rate**2 - first(tau) * acceleration
    return h, dh, ddh


def motion(control, state, switched=False, model=FREE):
    """Accelerations ddq and torques under a controller."""
    rate, work = np.empty(11), np.zeros((dynamics.WORKSPACE_ROWS, 5))
    y = np.append(dynamics.to_absolute(state), 0.0)
    closed_loop(control.code, switched, model.packed(), control.packed(model.robot), work, y, rate)
    return np.linalg.solve(ABSOLUTE, rate[5:10]), work[dynamics.TORQUE, :4].copy()


@pytest.mark.parametrize("name", HZD_NAMES)
def test_hzd_leaves_the_error_dynamics_of_the_paper(name):
    """ddh = -K_P h - K_D dh (eq. 9, 10), off the gait and beyond both ends of the step."""
    control = controller(name)
    kp, kd = control.parameters[:2]
    for state in find_limit_cycle(control).state + RNG.normal(0, 0.1, (50, 10)):
        ddq, torques = motion(control, state)
        h, dh, ddh = outputs(name, control.parameters, state[:5], state[5:], ddq)
        assert np.allclose(ddh, -kp * h - kd * dh, rtol=1e-9, atol=1e-9 * np.abs(ddq).max())
        again = dynamics.accelerations(state, torques, rabbit())
        assert np.allclose(again, ddq, rtol=1e-9, atol=1e-9 * np.abs(ddq).max())


@pytest.mark.parametrize("name", HZD_NAMES)
def test_tracking_error_on_the_flat_cycle(name):
    """Table 1 is rounded to 1e-4 rad, and hybrid invariance holds as well as that."""
    control = controller(name)
    cycle = find_limit_cycle(control)
    trace = trace_swing(control, cycle.state, 0.0, 0.0)
    errors = [outputs(name, control.parameters, x[:5], x[5:], np.zeros(5))[0] for x in trace.states]
    assert np.abs(errors).max() < 1e-4


@pytest.mark.parametrize("name", SMC_NAMES)
@pytest.mark.parametrize("switched", [False, True])
def test_sliding_mode_leaves_the_law_of_the_paper(name, switched):
    """ddh = -k |sigma|^(2 alpha - 1) sign(sigma) (eq. 17, 21), where sigma is not near zero."""
    control = controller(name)
    p = dict(zip(smc.PARAMETERS, control.parameters, strict=True))
    which = "2" if switched else "1"
    reference = np.array(
        [p[f"theta2_ref{which}"], p["q3_ref"], p[f"q4_ref{which}"], p["theta5_ref"]]
    )
    k, alpha, tau = (np.array([p[f"{n}{i}"] for i in range(1, 5)]) for n in ("k", "alpha", "tau"))
    select = np.array([[0, 1, 0, 0, 1], [0, 0, 1, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 1.0]])
    compared = 0
    for _ in range(100):
        state = np.concatenate([[2.9, 3.5, -0.2, -0.5, 0.0], np.zeros(5)]) + RNG.normal(0, 0.5, 10)
        ddq, _ = motion(control, state, switched)
        h, dh = select @ state[:5] - reference, select @ state[5:]
        sigma = dh + h / tau
        v = -k * np.abs(sigma) ** (2 * alpha - 1) * np.sign(sigma)
        far = np.abs(sigma) > 0.5
        found = select @ ddq
        assert np.allclose(found[far], v[far], rtol=1e-9, atol=1e-9 * np.abs(ddq).max())
        compared += far.sum()
    assert compared > 200


def test_sliding_mode_near_sigma_zero_rests_on_its_slow_manifold():
    """There v = -dh / tau, so that sigma stays; and the law is odd and finite everywhere."""
    k = 50.0
    for exponent in (0.4, 0.2, -0.03):
        width = (k / smc.STEEPEST) ** (1 / (1 - exponent))
        for rate in (0.0, 1e-3, 0.5, 5.0):
            slow = rate / smc.STEEPEST
            if slow > width:
                slow = (rate / k) ** (1 / exponent)
            assert smc._law(slow, rate, k, exponent, width) == pytest.approx(rate, abs=1e-9)
            for sigma in (0.0, 1e-12, 1e-6, 1e-3, 0.1, 3.0):
                value = smc._law(sigma, rate, k, exponent, width)
                assert math.isfinite(value)
                assert smc._law(-sigma, -rate, k, exponent, width) == -value


def test_torques_are_cut_off_joint_by_joint():
    control = controller("hzd/base")
    state = find_limit_cycle(control).state + 0.2
    _, wanted = motion(control, state)
    limited = replace(FREE, torque_limit=20.0)
    ddq, torques = motion(control, state, model=limited)
    assert (np.abs(wanted) > 20.0).any()
    assert np.array_equal(torques, np.clip(wanted, -20.0, 20.0))
    expected = dynamics.accelerations(state, torques, rabbit())
    assert np.allclose(ddq, expected, rtol=1e-9, atol=1e-9 * np.abs(ddq).max())


@pytest.mark.parametrize(
    ("build", "field"),
    [
        (lambda: controller("hzd/nobody"), "controller"),
        (lambda: Controller("x", "pid", np.zeros(3)), "scheme"),
        (lambda: Controller("x", "hzd", np.zeros(3)), "parameters"),
        (lambda: Controller("x", "smc", np.full(18, np.nan)), r"parameters\[0\]"),
        (lambda: Controller("x", "smc", np.zeros(18)).packed(rabbit()), r"parameters\[k1\]"),
        (lambda: Controller("x", "hzd", np.zeros(30)).packed(rabbit()), r"parameters\[kp\]"),
    ],
)
def test_parameters_that_are_not_allowed_are_named(build, field):
    with pytest.raises(InputError, match=rf"^{field}: "):
        build()
