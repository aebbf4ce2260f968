"""What functions that check arrays have in common."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from biped_mfpt_ros.errors import InputError


def numbers(value: ArrayLike, field: str, allowed: str) -> np.ndarray:
    """An array of real numbers, of the shape and type that they have.

    Text is none, even of digits, nor is None, nor are lists of different lengths.

    Parameters
    ----------
    value : array_like
        What was given.
    field, allowed : str
        For the error.

    Raises
    ------
    InputError
        If they are no numbers.
    """
    try:
        out = np.asarray(value)
    except ValueError:  # lists of different lengths
        raise InputError(field, value, allowed) from None
    if out.dtype.kind not in "biuf":
        raise InputError(field, value, allowed)
    return out
