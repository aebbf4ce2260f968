"""Slopes: the set of eq. (24), what slopes are allowed, and random ground."""

from __future__ import annotations

import math
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike

from biped_mfpt_ros.arrays import numbers
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
    allowed = "numbers: a list of at least one slope, shape (m,)"
    out = np.ascontiguousarray(numbers(slopes, field, allowed), dtype=np.float64)
    if out.ndim != 1 or out.size == 0:
        raise InputError(field, out.shape, allowed)
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


def check_correlation(correlation: float) -> float:
    """Check the correlation of successive slopes, above -1 and below 1.

    Raises
    ------
    InputError
        If it is not.
    """
    if not (isinstance(correlation, Real) and -1.0 < correlation < 1.0):
        raise InputError("correlation", correlation, "a number above -1 and below 1")
    return float(correlation)


def check_distribution(mu_s: float, sigma_s: float, correlation: float) -> None:
    """Check the distribution of slopes that walks draw from.

    Parameters
    ----------
    mu_s : float
        rad, mean, within `SLOPE_LIMIT`.
    sigma_s : float
        rad, standard deviation, > 0.
    correlation : float
        As for `check_correlation`.

    Raises
    ------
    InputError
        If one of these does not hold.
    """
    if not (math.isfinite(sigma_s) and sigma_s > 0.0):
        raise InputError("sigma_s", sigma_s, "finite, > 0 rad")
    if not abs(mu_s) <= SLOPE_LIMIT:
        raise InputError("mu_s", mu_s, f"within {SLOPE_LIMIT:.4f} rad")
    check_correlation(correlation)


def spread_given_last(sigma_s: float, correlation: float) -> float:
    """Standard deviation of the slope when the one before is known, rad; of all slopes sigma_s."""
    return sigma_s * math.sqrt((1.0 - correlation) * (1.0 + correlation))


def deviations(
    draws: np.ndarray, before: ArrayLike, sigma_s: float, correlation: float
) -> np.ndarray:
    r"""Deviations of successive slopes from their mean: a first-order autoregressive process.

    .. math:: d_k = \rho d_{k-1} + \sigma \sqrt{1 - \rho^2} e_k

    whose marginal distribution is N(0, sigma^2) for any correlation.

    Parameters
    ----------
    draws : numpy.ndarray
        e_k, standard normal, shape (..., k).
    before : array_like
        rad, deviation of the slope before the first of these, shape (...).
    sigma_s : float
        rad, standard deviation of the slope.
    correlation : float
        rho, of each slope with the one before, -1 < rho < 1.

    Returns
    -------
    numpy.ndarray
        rad, shape (..., k).
    """
    out = spread_given_last(sigma_s, correlation) * draws
    if correlation != 0.0:
        for k in range(out.shape[-1]):
            out[..., k] += correlation * np.asarray(before)
            before = out[..., k]
    return out
