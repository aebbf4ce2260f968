"""Slopes: the set of eq. (24), and what slopes are allowed."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from biped_mfpt_ros.errors import InputError

SLOPE_LIMIT_DEG = 45.0
"""Steepest slope that a step is simulated on, degrees."""

SLOPE_LIMIT = math.radians(SLOPE_LIMIT_DEG)
"""Steepest slope that a step is simulated on, rad."""


def slope_set(step_deg: float, limit_deg: float = 20.0) -> np.ndarray:
    """Slope set S of eq. (24).

    Parameters
    ----------
    step_deg : float
        d_s, degrees between slopes. It must divide ``limit_deg``.
    limit_deg : float, optional
        Steepest slope of the set, degrees.

    Returns
    -------
    numpy.ndarray
        rad, shape (m,), ascending, exactly antisymmetric, with 0.0 in the middle.

    Raises
    ------
    InputError
        If the step does not divide the limit, or either is out of range.
    """
    if not 0.0 < limit_deg <= SLOPE_LIMIT_DEG:
        raise InputError("slope_limit_deg", limit_deg, f"above 0, to {SLOPE_LIMIT_DEG:g} degrees")
    if not 0.01 <= step_deg <= limit_deg:
        raise InputError("slope_step_deg", step_deg, f"0.01 to {limit_deg:g} degrees")
    half = round(limit_deg / step_deg)
    if abs(half * step_deg - limit_deg) > 1e-9 * limit_deg:
        raise InputError("slope_step_deg", step_deg, f"a divisor of {limit_deg:g} degrees")
    uphill = np.radians(np.arange(1, half + 1) * limit_deg / half)
    return np.concatenate([-uphill[::-1], [0.0], uphill])


def check_slopes(slopes: ArrayLike, field: str = "slopes") -> np.ndarray:
    """Check slopes ahead: shape (m,), m >= 1, finite, within the limit, strictly ascending.

    Returns
    -------
    numpy.ndarray
        rad, float64, contiguous, shape (m,).

    Raises
    ------
    InputError
        If one of these does not hold.
    """
    out = np.ascontiguousarray(slopes, dtype=np.float64)
    if out.ndim != 1 or out.size == 0:
        raise InputError(field, out.shape, "a list of at least one slope, shape (m,)")
    outside = ~(np.abs(out) <= SLOPE_LIMIT)
    if outside.any():
        raise InputError(
            f"{field}[{int(np.argmax(outside))}]",
            float(out[outside][0]),
            f"finite, -{SLOPE_LIMIT:.4f} to {SLOPE_LIMIT:.4f} rad ({SLOPE_LIMIT_DEG:g} degrees)",
        )
    descends = np.diff(out) <= 0.0
    if descends.any():
        raise InputError(
            f"{field}[{int(np.argmax(descends)) + 1}]",
            float(out[1:][descends][0]),
            "strictly ascending slopes",
        )
    return out
