"""Walker models as plain values: what files of a robot, JSON, the store and messages hold."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.walker.robot import Robot, WalkerModel, rabbit

ROBOT_FIELDS = tuple(field.name for field in dataclasses.fields(Robot))
"""Names of the values of a robot, in order."""

MODEL_FIELDS = tuple(f.name for f in dataclasses.fields(WalkerModel) if f.name != "robot")
"""Names of the values of a walker model, but for its robot."""


def in_order(values: Mapping[str, Any], names: Sequence[str], field: str) -> list[Any]:
    """Values in the order of their names; raises InputError unless they have just these names."""
    if not isinstance(values, Mapping):
        raise InputError(field, values, "an object with " + ", ".join(names))
    if wrong := sorted(set(values) ^ set(names)):
        # The value of one that is unknown, None of one that is missing.
        raise InputError(f"{field}.{wrong[0]}", values.get(wrong[0]), "exactly " + ", ".join(names))
    return [values[name] for name in names]


def robot_from(values: Mapping[str, Any], name: str = "robot") -> Robot:
    """Robot of named values.

    Parameters
    ----------
    values : mapping
        A number for each of `ROBOT_FIELDS`, SI units, in the ranges of `Robot`.
    name : str
        What errors call it.

    Returns
    -------
    Robot

    Raises
    ------
    InputError
        If one is missing, unknown, no number, or out of its range.
    """
    numbers = in_order(values, ROBOT_FIELDS, name)
    try:
        return Robot(*numbers)
    except InputError as error:
        raise InputError(f"{name}.{error.field}", error.value, error.allowed) from None


def robot_from_file(path: str | Path) -> Robot:
    """Robot of a JSON file, an object as `robot_from` takes it; raises InputError."""
    try:
        return robot_from(json.loads(Path(path).read_text()))
    except InputError as error:
        raise InputError(f"{path}: {error.field}", error.value, error.allowed) from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError("robot_file", str(path), f"a JSON file ({error})") from None


def model_values(model: WalkerModel) -> dict[str, Any]:
    """Values of a model by name; ``robot`` is there, as values by name, if it is not RABBIT."""
    values = {name: getattr(model, name) for name in MODEL_FIELDS}
    if model.robot != rabbit():
        values["robot"] = dataclasses.asdict(model.robot)
    return values


def model_from(values: Mapping[str, Any]) -> WalkerModel:
    """Model of what `model_values` gave; raises InputError."""
    given = dict(values)
    if "robot" in given:
        given["robot"] = robot_from(given["robot"])
    return WalkerModel(**given)
