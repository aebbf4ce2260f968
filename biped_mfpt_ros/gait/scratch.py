"""What the kernels keep in memory: an array of shape (ROWS, SIZE, LANES), a swing a lane.

A row is a state, or its derivative: five absolute angles (rad), five rates (rad/s), and the work of
each joint since the last step of the integrator (J). Some rows hold other numbers, named below.
"""

from __future__ import annotations

import numpy as np

from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.lanes import LANES

SIZE = 14
STATES = 10
"""Angles and rates, without the works."""
WORK = 10
"""Column of the first joint's work."""

(
    Y,  # where the step of the integrator starts
    Y_NEW,  # where it ends
    SPARE,
    MODE,  # columns below
    COMMAND,  # what a controller commands: alpha (5), beta (5)
    END,  # where the step ends, columns below
    ESTIMATE,  # of the error, and what else was seen in the stages, columns below
    FEET,  # swing foot within the step: x, y (m), dx, dy (m/s), some places in the lanes
    PLACES,  # of one lane, at as many fractions of the step as there are lanes: columns below
    SLIDING,  # how far four outputs are from sliding at the end of the step: not at 0 and below
    START,  # torques wanted where the step starts (4, N m)
) = range(11)
LOBE = 11
"""Row of the first of four joints: up to four fractions of the step where the joint's power changes
its sign, 2 after the last, then its work up to each of them (J)."""
STAGE = LOBE + 4
"""Row of the derivative at the start of a step; those of the integrator's stages follow."""
DENSE = STAGE + 16
"""Row of the first of seven coefficients of the dense output."""
ROWS = DENSE + 7

# Columns of MODE: signs of the torques cut off (4), the piece of the control law that holds, length
# of the step (s), which outputs are in sliding mode (4, 0 or 1), whether the step just tried
# is good (0 or 1); and whether works are integrated for the energy (0 or 1, the same in all lanes).
CUT, PIECE, H, SLIDES, GOOD, WORKS = 0, 4, 5, 6, 10, 11
# Columns of END: sines (5) and cosines (5) of the angles, torques that are wanted (4, N m).
SINES, COSINES, WANTED = 0, 5, 10
# Columns of ESTIMATE: error over the tolerance and its eighth root, least and greatest margin
# against slipping and least normal force over the stages (N), whether a torque may reach or leave
# its limit (0 or 1), and at the end of the step: force (N), and how far a torque is beyond its
# limit, at most (N m); of four joints, the product of the least and the greatest power over some
# stages (W^2): below zero where it changes its sign.
ERROR, ERROR_ROOT, LEAST, MOST, LEAST_NORMAL, MAY_CUT, TANGENTIAL, NORMAL, BEYOND = range(9)
TURNS = 9


@kernel
def empty_scratch():
    """Scratch of a kernel, zeros."""
    return np.zeros((ROWS, SIZE, LANES))


# Columns of PLACES: fraction, a value and the normal force there; while a crossing is sought,
# fraction, value and the torques wanted (4); how far each torque is beyond its limit (4, N m).
AT, VALUE, LOAD, TRIED, TRIED_VALUE, TRIED_TORQUES = range(6)
EACH = 9

# Rows of the ground ahead of a lane, of shape (AHEAD, m + LANES), one column for a slope.
(
    SINE,
    COSINE,
    OUTCOME,  # code
    DURATION,  # s, to the impact or to the fall
    LENGTH,  # m, from foot to foot at impact; 0 for a fall
    SPENT,  # J
) = range(6)
ANGLES, RATES, TRIG = 6, 11, 16
"""Absolute angles (rad), their rates (rad/s), and their sines and cosines (5 each): just before the
impact while the swing lasts, angles and rates after the impact then."""
AHEAD = 26

# Rows of a swing's variables, of shape (VARIABLES, LANES).
(
    TIME,  # s since the impact
    ENERGY,  # J, at the start of the integrator's step
    SINCE,  # s, when the present slip of the stance foot began; -1: it does not slip
    MARGIN,  # N, against slipping, at the start of the step
    FOOT_X,  # swing foot at the start of the step: m, m, m/s, m/s
    FOOT_Y,
    FOOT_DX,
    FOOT_DY,
    BACK_SIN,  # of the slope behind
    BACK_COS,
    LOWEST,  # m, above the slope behind: below it the foot scuffs
    PASSED,  # 1 as soon as the swing foot has passed the stance foot
    TODO,  # slopes not yet decided: 0 .. TODO - 1
    STEPS,  # of the integrator
    EVALUATIONS,
    SAMPLES,  # in the trace
    FAILURE,  # outcome of the slopes not yet decided, once known; -1 before
    CHANGES,  # 1 if the set of torques cut off changes in it
    SWITCHES,  # 1 if the control law goes on to another piece in it
    SLIPS,  # 1 if the stance foot may slip or lift in it
    NEAR,  # 1 if the swing foot may meet the ground in it
    END_X,  # swing foot at the end of the step
    END_Y,
    END_DX,
    END_DY,
    SLIDE,  # 1 if an output begins to slide in it
    LAST_H,  # length of the step before, 0 if the motion was not smooth since then
    LAST_ROOT,  # eighth root of its error
    RESTARTS,  # 1: the motion is evaluated anew, 2: also which torques are cut off
) = range(29)
VARIABLES = 29
