"""Which walker model each controller is walked with: ``data/readings.json``.

The paper states neither torque limit nor friction. What is taken instead is a reading of its
numbers and claims, with the reason beside it.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.models import MODEL_FIELDS, model_values
from biped_mfpt_ros.walker.robot import WalkerModel


@dataclass(frozen=True)
class Reading:
    """How a controller's numbers in the paper are read.

    Attributes
    ----------
    controller : str
        Name in the catalogue.
    model : WalkerModel
        Torque limit, friction and so on.
    reason : str
        Why this model.
    source : str
        What in the paper speaks for it.
    """

    controller: str
    model: WalkerModel
    reason: str
    source: str

    @property
    def settings(self) -> dict[str, Any]:
        """The model's settings by name, SI units."""
        return model_values(self.model)


@cache
def readings() -> dict[str, Reading]:
    """Every reading by the controller's name.

    Raises
    ------
    InputError
        If the data names a setting that the model does not have, or a value out of its range.
    """
    data = json.loads(files("biped_mfpt_ros").joinpath("data/readings.json").read_text())
    out = {}
    for name, row in data["controllers"].items():
        settings: dict[str, Any] = {
            k: math.inf if v == "none" else v for k, v in row["model"].items()
        }
        unknown = [key for key in settings if key not in MODEL_FIELDS]
        if unknown:
            raise InputError(
                f"readings.json: {name}", unknown[0], "one of " + ", ".join(MODEL_FIELDS)
            )
        out[name] = Reading(name, WalkerModel(**settings), row["reason"], row["source"])
    return out
