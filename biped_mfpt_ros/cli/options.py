"""From options to the objects of the core. Degrees end here."""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from biped_mfpt_ros.control.controller import SCHEMES, Controller, controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.models import MODEL_FIELDS, in_order, model_values, robot_from_file
from biped_mfpt_ros.walker.robot import Robot, WalkerModel
from biped_mfpt_ros.walker.terrain import SLOPE_LIMIT_DEG, check_correlation, slope_set


def given(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Those of the named options that were given; defaults of the others live in the core."""
    return {name: getattr(args, name) for name in names if getattr(args, name) is not None}


def controller_of(args: argparse.Namespace, robot: Robot) -> Controller:
    """The controller that was asked for, of the catalogue or of a file.

    On a robot of a file it has another name, as the paper's numbers are none of its own.
    """
    if args.controller_file is None:
        made = controller(args.controller)
    else:
        made = controller_from_file(args.controller_file, robot)
    if args.robot_file is not None:
        made = replace(made, name=f"{made.name} on {Path(args.robot_file).stem}")
    args.controller = made.name
    return made


def controller_from_file(path: str, robot: Robot) -> Controller:
    """Controller of a JSON object with name, scheme and parameters; raises InputError.

    The parameters are a list in the scheme's order, or an object of them by name.
    """
    try:
        data = json.loads(Path(path).read_text())
        for field in ("name", "scheme", "parameters"):
            if field not in data:
                raise InputError(field, None, "an object with name, scheme and parameters")
        scheme, parameters = data["scheme"], data["parameters"]
        if scheme not in SCHEMES:
            raise InputError("scheme", scheme, "one of " + ", ".join(SCHEMES))
        if isinstance(parameters, dict):
            parameters = in_order(parameters, SCHEMES[scheme].parameters, "parameters")
        made = Controller(str(data["name"]), scheme, np.array(parameters, float))
        made.packed(robot)  # checks ranges
    except InputError as error:
        raise InputError(f"{path}: {error.field}", error.value, error.allowed) from None
    except (OSError, ValueError, TypeError, RecursionError) as error:
        reason = f"a JSON file with name, scheme and parameters ({error})"
        raise InputError("--controller-file", path, reason) from None
    return made


def model_of(args: argparse.Namespace) -> WalkerModel:
    """The walker's model."""
    values = given(args, *MODEL_FIELDS)
    if args.robot_file is not None:
        values["robot"] = robot_from_file(args.robot_file)
    return WalkerModel(**values)


def walker_of(args: argparse.Namespace) -> tuple[Controller, WalkerModel]:
    """The controller and the model that were asked for."""
    model = model_of(args)
    return controller_of(args, model.robot), model


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


def correlation_of(args: argparse.Namespace) -> float:
    """The correlation of successive slopes; other than 0 a mesh has to be clustered."""
    correlation = check_correlation(args.correlation)
    if correlation != 0.0 and getattr(args, "unclustered", False):
        raise InputError("--correlation", correlation, "0 with --unclustered")
    return correlation


def described(controller: Controller, model: WalkerModel) -> dict[str, Any]:
    """What walked, for JSON."""
    return {
        "controller": controller.name,
        "model": model_values(model),
    }
