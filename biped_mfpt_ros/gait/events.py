"""Events within a step of the integrator, located on its dense output.

Times within the step are fractions of it, 0 to 1.
"""

from __future__ import annotations

import math

from biped_mfpt_ros.gait.closed_loop import closed_loop, margin, switch
from biped_mfpt_ros.gait.integrate import SPARE, Y_AT, interpolate
from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.walker import robot as r
from biped_mfpt_ros.walker.dynamics import swing_foot

TIME_RESOLUTION = 1e-12
"""s, to which events are located."""


@kernel
def foot_root(rob, s, nx, ny, offset, low, high, span):
    """Where ``nx x + ny y - offset`` of the swing foot falls through zero, by a guarded Newton.

    ``low`` and ``high`` are fractions of the step, of ``span`` seconds, with a positive value at
    ``low`` and one not above zero at ``high``.
    """
    at = 0.5 * (low + high)
    for _ in range(100):
        interpolate(s, at)
        x, y, dx, dy = swing_foot(rob, s[Y_AT])
        value = nx * x + ny * y - offset
        if value > 0.0:
            low = at
        else:
            high = at
        slope = (nx * dx + ny * dy) * span
        nearer = at - value / slope
        if not low < nearer < high:
            nearer = 0.5 * (low + high)
        if abs(nearer - at) * span < TIME_RESOLUTION:
            return nearer
        at = nearer
    return at


@kernel
def foot_lowest(rob, s, nx, ny, low, high):
    """Where ``nx x + ny y`` of the swing foot is least, given that it falls, then rises."""
    for _ in range(50):
        at = 0.5 * (low + high)
        interpolate(s, at)
        _, _, dx, dy = swing_foot(rob, s[Y_AT])
        if nx * dx + ny * dy < 0.0:
            low = at
        else:
            high = at
    return high


@kernel
def switch_root(scheme, par, s, switched, high, span):
    """Where the controller switches, as a fraction of the step: just on the far side."""
    low = 0.0
    while (high - low) * span > TIME_RESOLUTION:
        at = 0.5 * (low + high)
        if at <= low or at >= high:
            break
        interpolate(s, at)
        if (switch(scheme, par, s[Y_AT]) > 0.0) != switched:
            low = at
        else:
            high = at
    return high


@kernel
def body_point(rob, y, i):
    """Position of stance knee (0), hip (1), swing knee (2) or head (3), m."""
    x = rob[r.TIBIA] * math.sin(y[2])
    h = -rob[r.TIBIA] * math.cos(y[2])
    if i >= 1:
        x += rob[r.FEMUR] * math.sin(y[0])
        h -= rob[r.FEMUR] * math.cos(y[0])
    if i == 2:
        x -= rob[r.FEMUR] * math.sin(y[1])
        h += rob[r.FEMUR] * math.cos(y[1])
    elif i == 3:
        x -= rob[r.TORSO] * math.sin(y[4])
        h += rob[r.TORSO] * math.cos(y[4])
    return x, h


@kernel
def body_touches(rob, y, previous, slope):
    """Whether a knee, the hip or the head is below the ground."""
    for i in range(4):
        x, h = body_point(rob, y, i)
        ground = slope if x >= 0.0 else previous
        if h * math.cos(ground) - x * math.sin(ground) <= 0.0:
            return True
    return False


@kernel
def body_root(rob, s, previous, slope, low, high):
    """When a body point first goes below the ground, given that it does at ``high``."""
    for _ in range(50):
        at = 0.5 * (low + high)
        interpolate(s, at)
        if body_touches(rob, s[Y_AT], previous, slope):
            high = at
        else:
            low = at
    return high


@kernel
def forces_at(scheme, switched, rob, par, work, s, at):
    """Force on the stance foot at a fraction of the step: tangential, normal, N."""
    interpolate(s, at)
    return closed_loop(scheme, switched, rob, par, work, s[Y_AT], s[SPARE])


@kernel
def slip_root(scheme, switched, rob, par, work, s, low, high, span, slips_at_high):
    """When the stance foot begins (or ends) to slip, as a fraction of the step."""
    while (high - low) * span > 1e-10:
        at = 0.5 * (low + high)
        if at <= low or at >= high:
            break
        tangential, normal = forces_at(scheme, switched, rob, par, work, s, at)
        if (margin(rob, tangential, normal) > 0.0) == slips_at_high:
            low = at
        else:
            high = at
    return high
