"""Controllers against the paper's tables and their own defining equations."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from processors import printed_on_two
from scipy.integrate import solve_ivp
from scipy.interpolate import BPoly, BSpline

from biped_mfpt_ros.control import hzd, smc, spline
from biped_mfpt_ros.control.controller import (
    Controller,
    controller,
    controller_names,
    paper_controller_names,
)
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.closed_loop import closed_loop
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.scratch import empty_scratch
from biped_mfpt_ros.gait.trace import trace_swing
from biped_mfpt_ros.walker import dynamics
from biped_mfpt_ros.walker.robot import ABSOLUTE, WalkerModel, rabbit

HZD_NAMES = [n for n in paper_controller_names() if n.startswith("hzd/")]
SMC_NAMES = [n for n in paper_controller_names() if n.startswith("smc/")]
SPLINE_NAMES = [n for n in controller_names() if n.startswith("spline/")]
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
    rate, torques = np.empty(11), np.empty(4)
    y = np.append(dynamics.to_absolute(state), 0.0)
    packed = control.packed(model.robot)
    work = empty_scratch()
    piece = float(switched)
    if control.scheme == "spline":
        piece = spline.piece_of(packed, y)
    closed_loop(control.code, piece, model.packed(), packed, work, y, rate, torques)
    return np.linalg.solve(ABSOLUTE, rate[5:10]), torques


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


def one_law(k, exponent, tau=0.1):
    """Packed parameters with the same law for every output, of which the first is looked at."""
    values = [0.0] * 6 + [k] * 4 + [0.5 * (exponent + 1.0)] * 4 + [tau] * 4
    return smc.packed(np.array(values), rabbit())


def law(par, sigma, rate):
    return smc._law(par, 0, sigma, rate, smc._slow(par, 0, rate))


def test_sliding_mode_near_sigma_zero_rests_on_its_slow_manifold():
    """There v = -dh / tau, so that sigma stays; and the law is odd and finite everywhere."""
    k = 50.0
    for exponent in (0.4, 0.2, -0.03):
        par = one_law(k, exponent)
        for rate in (0.0, 1e-3, 0.5, 5.0):
            slow = (rate / k) ** (1 / exponent) if exponent > 0 else rate / smc.STEEPEST
            assert law(par, slow, rate) == pytest.approx(rate, abs=1e-9)
            for sigma in (0.0, 1e-12, 1e-6, 1e-3, 0.1, 3.0):
                value = law(par, sigma, rate)
                assert math.isfinite(value)
                assert law(par, -sigma, -rate) == -value


@pytest.mark.parametrize("exponent", [0.4, 0.2])
def test_an_output_that_slides_settles_as_the_law_of_the_paper_has_it(exponent):
    """One output by eq. (21) to the letter and a stiff integrator, against the two modes.

    To 3e-6 rad and 3e-5 rad/s: what the bounds on the law's slope may change while it is reached.
    """
    k, tau = 50.0, 0.1
    par = one_law(k, exponent, tau)
    start, end = np.array([0.15, 0.0]), 0.4

    def literal(t, y):
        sigma = y[1] + y[0] / tau
        return [y[1], -k * abs(sigma) ** exponent * np.sign(sigma)]

    def reaching(t, y):
        return [y[1], -law(par, y[1] + y[0] / tau, y[1] / tau)]

    def sliding(t, y):
        rate = y[1] / tau
        slow = smc._slow(par, 0, rate)
        return [y[1], -smc._sliding(par, 0, y[1] + y[0] / tau, rate, slow)]

    def arrived(t, y):
        rate = y[1] / tau
        slope = smc._slope(par, 0, rate, smc._slow(par, 0, rate))
        off = abs(reaching(t, y)[1] + rate) / smc.SLIDING_RATE
        return max(off / smc.ENTRY, slope * smc.STIFF) - 1.0

    arrived.terminal = True
    tight = {"rtol": 1e-10, "atol": 1e-12}
    expected = solve_ivp(literal, (0, end), start, "Radau", **tight).y[:, -1]
    first = solve_ivp(reaching, (0, end), start, "LSODA", events=arrived, **tight)
    assert first.status == 1
    assert first.t[-1] < 0.5 * end  # it slides for most of the time
    found = solve_ivp(sliding, (first.t[-1], end), first.y[:, -1], "LSODA", **tight).y[:, -1]
    assert abs(expected[0]) > 1e-3
    assert np.abs(found - expected)[0] < 3e-6
    assert np.abs(found - expected)[1] < 3e-5


@pytest.mark.parametrize("p", [-0.7, -0.03, 0.2, 0.4, 1.0, 5.0])
def test_power_agrees_with_the_c_librarys(p):
    for x in np.exp(RNG.uniform(-30, 30, 200)):
        assert smc.power(x, p) == pytest.approx(x**p, rel=2e-14 * (1 + abs(p)))


def spline_reference(parameters):
    """References by scipy: the outer coefficients go on for 100 spacings beyond both ends."""
    first, last = parameters[8:10]
    table = parameters[10:].reshape(4, spline.COEFFICIENTS)
    more = 100
    coefficients = np.pad(table, ((0, 0), (more, more)), mode="edge").T
    spacing = (last - first) / (spline.COEFFICIENTS - 1)
    # The bump of coefficient k spans the knots k to k + 4, with its top at the third of them.
    knots = first + spacing * (np.arange(len(coefficients) + 4) - more - 2)
    return BSpline(knots, coefficients, 3, extrapolate=False)


@pytest.mark.parametrize("name", SPLINE_NAMES)
def test_spline_references_are_scipys_and_bounded_beyond_the_step(name):
    parameters = controller(name).parameters
    reference = spline_reference(parameters)
    first, last = parameters[8:10]
    table = parameters[10:].reshape(4, spline.COEFFICIENTS)
    span = last - first
    spacing = span / (spline.COEFFICIENTS - 1)
    for theta in np.linspace(first - 2 * span, last + 2 * span, 501):
        expected = np.array([reference.derivative(n)(theta) for n in range(3)])
        found = spline.references(parameters, theta)
        # Values up to 4 rad are rounded at 1e-15; the n-th derivative divides by spacing^n. The
        # phase is rounded, too, by which a derivative changes as the next one says, which is at
        # most 2^(n+1) times the largest coefficient over spacing^(n+1).
        rounded = np.spacing(abs(theta) + span)
        for n in range(3):
            steepest = (2.0 / spacing) ** (n + 1) * abs(table).max()
            bound = 1e-14 / spacing**n + steepest * rounded
            assert found[n] == pytest.approx(expected[n], abs=bound)
        assert (table.min(axis=1) - 1e-12 <= found[0]).all()
        assert (found[0] <= table.max(axis=1) + 1e-12).all()
    for theta, end in ((first - span, 0), (last + span, -1), (-1e9, 0), (1e9, -1)):
        value, slope, curvature = spline.references(parameters, theta)
        assert value == pytest.approx(table[:, end], abs=1e-14)
        assert not slope.any()
        assert not curvature.any()


@pytest.mark.parametrize("name", SPLINE_NAMES)
def test_spline_leaves_linear_error_dynamics(name):
    """ddh_i = -kp_i h_i - kd_i dh_i, off the gait and beyond both ends, references by scipy."""
    control = controller(name)
    # Each output with gains of its own.
    values = control.parameters.copy()
    values[:8] *= np.linspace(0.5, 2.0, 8)
    control = Controller("mine", "spline", values)
    kp, kd = values[:4], values[4:8]
    reference = spline_reference(values)
    select = np.array([[0, 1, 0, 0, 1], [0, 0, 1, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 1.0]])
    c = np.array([-1.0, 0.0, -0.5, 0.0, -1.0])
    outside = 0
    for state in find_limit_cycle(controller(name)).state + RNG.normal(0, 0.3, (100, 10)):
        ddq, torques = motion(control, state)
        q, dq = state[:5], state[5:]
        theta, rate, acceleration = c @ q, c @ dq, c @ ddq
        value, first, second = (reference.derivative(n)(theta) for n in range(3))
        h = select @ q - value
        dh = select @ dq - first * rate
        ddh = select @ ddq - second * rate**2 - first * acceleration
        assert np.allclose(ddh, -kp * h - kd * dh, rtol=1e-9, atol=1e-9 * np.abs(ddq).max())
        again = dynamics.accelerations(state, torques, rabbit())
        assert np.allclose(again, ddq, rtol=1e-9, atol=1e-9 * np.abs(ddq).max())
        outside += not values[8] <= theta <= values[9]
    assert outside > 20


@pytest.mark.parametrize("name", SPLINE_NAMES)
def test_spline_walks_on_the_flat(name):
    cycle = find_limit_cycle(controller(name))
    assert cycle.stable
    assert cycle.speed > 0.1


@pytest.mark.parametrize("rate", [1.0, 2.0])
def test_spline_reference_state_has_both_feet_on_the_ground_and_no_error(rate):
    """The legs are swapped back; what the impact does to rates is tested with the walker."""
    parameters = controller("spline/base").parameters
    state = spline.reference_state(parameters, rate, rabbit())
    q = hzd.swapped(state[:5])
    value, _, _ = spline.references(parameters, hzd.phase(q))
    assert np.array([q[1] + q[4], q[2], q[3], q[4]]) == pytest.approx(value, abs=1e-9)
    foot = rabbit().swing_foot_position
    assert foot @ np.cos(ABSOLUTE @ q) == pytest.approx(0.0, abs=1e-9)
    assert -foot @ np.sin(ABSOLUTE @ q) > 0.2  # ahead, by about a step of this gait


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
        (lambda: Controller("x", "spline", np.zeros(42)).packed(rabbit()), r"parameters\[kp_1\]"),
        (
            lambda: Controller("x", "spline", np.ones(42)).packed(rabbit()),
            r"parameters\[theta_last\]",
        ),
    ],
)
def test_parameters_that_are_not_allowed_are_named(build, field):
    with pytest.raises(InputError, match=rf"^{field}: "):
        build()


_PACKED = """
from biped_mfpt_ros.control.controller import controller, controller_names
from biped_mfpt_ros.walker.robot import WalkerModel
model = WalkerModel()
print(model.packed().tobytes().hex())
for name in controller_names():
    print(controller(name).packed(model.robot).tobytes().hex())
"""


def test_kernels_read_the_same_bits_on_other_processors():
    """Simulators of one mesh may run on several; BLAS, numpy and the C library look which."""
    here, there = printed_on_two(_PACKED)
    assert len(here.splitlines()) == 1 + len(controller_names())
    assert here == there
