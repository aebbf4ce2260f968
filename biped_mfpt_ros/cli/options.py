"""From options to the objects of the core. Degrees end here."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from biped_mfpt_ros.control.controller import Controller, controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.walker.robot import WalkerModel, rabbit
from biped_mfpt_ros.walker.terrain import SLOPE_LIMIT_DEG, slope_set

_MODEL_OPTIONS = (
    "torque_limit", "friction", "friction_frame", "slip_duration", "time_limit", "tolerance",
)  # fmt: skip


def given(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Those of the named options that were given; defaults of the others live in the core."""
    return {name: getattr(args, name) for name in names if getattr(args, name) is not None}


def controller_of(args: argparse.Namespace) -> Controller:
    """The controller that was asked for, of the catalogue or of a file."""
    if args.controller_file is None:
        return controller(args.controller)
    made = controller_from_file(args.controller_file)
    args.controller = made.name
    return made


def controller_from_file(path: str) -> Controller:
    """Controller of a JSON object with name, scheme and parameters; raises InputError."""
    try:
        data = json.loads(Path(path).read_text())
        made = Controller(str(data["name"]), data["scheme"], np.array(data["parameters"], float))
        made.packed(rabbit())  # checks ranges
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = f"a JSON file with name, scheme and parameters ({error})"
        raise InputError("--controller-file", path, reason) from None
    return made


def model_of(args: argparse.Namespace) -> WalkerModel:
    """The walker's model."""
    return WalkerModel(**given(args, *_MODEL_OPTIONS))


def slopes_of(args: argparse.Namespace) -> np.ndarray:
    """The slope set, rad."""
    return slope_set(args.slope_step, args.slope_limit)


def mesh_settings(args: argparse.Namespace) -> dict[str, Any]:
    """What `grow_mesh` takes beside slopes and threshold."""
    return given(args, "max_states", "scale_refresh") | {"clustered": not args.unclustered}


def slope(option: str, degrees: float) -> float:
    """A slope in rad; raises InputError in the degrees that were typed."""
    if not abs(degrees) <= SLOPE_LIMIT_DEG:
        raise InputError(option, degrees, f"-{SLOPE_LIMIT_DEG:g} to {SLOPE_LIMIT_DEG:g} degrees")
    return math.radians(degrees)


def mean_of(args: argparse.Namespace) -> float:
    """The mean slope of a command that meshes, rad; it has to be within the slope set."""
    if abs(args.mean) > args.slope_limit:
        allowed = f"within --slope-limit, -{args.slope_limit:g} to {args.slope_limit:g} degrees"
        raise InputError("--mean", args.mean, allowed)
    return slope("--mean", args.mean)


def spread(option: str, degrees: float) -> float:
    """A standard deviation of the slope in rad; raises InputError in the degrees typed."""
    if not 0.0 < degrees < math.inf:
        raise InputError(option, degrees, "a finite number of degrees > 0")
    return math.radians(degrees)


def described(controller: Controller, model: WalkerModel) -> dict[str, Any]:
    """What walked, for JSON."""
    return {
        "controller": controller.name,
        "model": {name: getattr(model, name) for name in _MODEL_OPTIONS},
    }
