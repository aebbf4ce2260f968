"""JSON for scripts and text for readers, on stdout."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np


def plain(value: Any) -> Any:
    """Make a value of what JSON has.

    Arrays become lists, complex numbers ``[re, im]``, infinities the strings ``"inf"`` and
    ``"-inf"`` (which ``float()`` reads back), NaN null.
    """
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, complex):
        return [plain(value.real), plain(value.imag)]
    if isinstance(value, float) and math.isnan(value):
        return None
    if isinstance(value, float) and math.isinf(value):
        return "inf" if value > 0.0 else "-inf"
    return value


def json_text(value: Any) -> str:
    """A value as JSON, with floats that read back exactly."""
    return json.dumps(plain(value), indent=2, allow_nan=False)
