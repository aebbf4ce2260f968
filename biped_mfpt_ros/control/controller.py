"""What a controller is, and the catalogue: the paper's six and others."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from biped_mfpt_ros.arrays import numbers
from biped_mfpt_ros.control import hzd, smc, spline
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.walker.robot import Robot


@dataclass(frozen=True)
class Scheme:
    """A low-level control scheme.

    Attributes
    ----------
    code : int
        By which the kernels know it.
    parameters : tuple of str
        Names of its parameters, in order.
    optional : int
        How many more values may follow them.
    packed : callable
        Parameters and robot to the array that the kernels read; raises InputError.
    reference_state : callable
        Parameters, a rate (rad/s) and robot to a state just after an impact on flat ground without
        tracking error: where a search for the limit cycle may start.
    """

    code: int
    parameters: tuple[str, ...]
    optional: int
    packed: Callable[[np.ndarray, Robot], np.ndarray]
    reference_state: Callable[[np.ndarray, float, Robot], np.ndarray]


HZD, SMC, SPLINE = 0, 1, 2

SCHEMES = {
    "hzd": Scheme(HZD, hzd.PARAMETERS, 1, hzd.packed, hzd.reference_state),
    "smc": Scheme(SMC, smc.PARAMETERS, 0, smc.packed, smc.reference_state),
    "spline": Scheme(SPLINE, spline.PARAMETERS, 0, spline.packed, spline.reference_state),
}
"""Every scheme by its name."""


@dataclass(frozen=True, eq=False)
class Controller:
    """A control scheme with its parameters.

    Attributes
    ----------
    name : str
        Label, such as ``"hzd/base"``.
    scheme : str
        A key of `SCHEMES`.
    parameters : numpy.ndarray
        float64, read-only, in the order of the scheme's ``parameters``.

    Raises
    ------
    InputError
        If the scheme is unknown, or the parameters have the wrong length or are not finite.
    """

    name: str
    scheme: str
    parameters: np.ndarray

    def __post_init__(self) -> None:
        """Check scheme, length and values, and freeze the parameters."""
        if self.scheme not in SCHEMES:
            raise InputError("scheme", self.scheme, "one of " + ", ".join(SCHEMES))
        scheme = SCHEMES[self.scheme]
        least, most = len(scheme.parameters), len(scheme.parameters) + scheme.optional
        lengths = f"{least}" if least == most else f"{least} to {most}"
        allowed = f"{lengths} numbers for scheme {self.scheme}"
        values = np.array(numbers(self.parameters, "parameters", allowed), dtype=np.float64)
        if values.ndim != 1 or not least <= values.size <= most:
            raise InputError("parameters", f"length {values.size}", allowed)
        # Only the optional ones may be infinite: they are limits.
        bad = np.isnan(values) | (np.isinf(values) & (np.arange(values.size) < least))
        if bad.any():
            i = int(np.argmax(bad))
            raise InputError(f"parameters[{i}]", float(values[i]), "finite numbers")
        values.setflags(write=False)
        object.__setattr__(self, "parameters", values)

    def packed(self, robot: Robot) -> np.ndarray:
        """Parameters as the kernels read them, float64; raises InputError."""
        return SCHEMES[self.scheme].packed(self.parameters, robot)

    def reference_state(self, rate: float, robot: Robot) -> np.ndarray:
        """State just after an impact on flat ground without tracking error, shape (10,)."""
        return SCHEMES[self.scheme].reference_state(self.parameters, rate, robot)

    @property
    def code(self) -> int:
        """By which the kernels know the scheme."""
        return SCHEMES[self.scheme].code


@cache
def _data() -> dict[str, dict[str, dict[str, Any]]]:
    """Rows of the catalogue by scheme and label."""
    data = json.loads(files("biped_mfpt_ros").joinpath("data/controllers.json").read_text())
    return {scheme: data[scheme]["controllers"] for scheme in SCHEMES}


_VALUES: dict[str, Callable[[dict[str, Any]], list[float]]] = {
    "hzd": lambda row: [row["kp"], row["kd"], *np.ravel(row["bezier"])],
    "smc": lambda row: [
        math.radians(row[f"{name}_deg"]) if f"{name}_deg" in row else row[name]
        for name in smc.PARAMETERS
    ],
    "spline": lambda row: [
        *row["kp"],
        *row["kd"],
        row["theta_first"],
        row["theta_last"],
        *np.ravel(row["coefficients"]),
    ],
}


@cache
def catalogue() -> dict[str, Controller]:
    """Every named controller: the six of Tables 1 and 3, and those with an origin of their own."""
    return {
        f"{scheme}/{label}": Controller(f"{scheme}/{label}", scheme, np.array(_VALUES[scheme](row)))
        for scheme, rows in _data().items()
        for label, row in rows.items()
    }


def controller_names() -> tuple[str, ...]:
    """Names of the catalogue."""
    return tuple(catalogue())


def paper_controller_names() -> tuple[str, ...]:
    """Names of the six controllers of the paper."""
    return tuple(
        f"{scheme}/{label}"
        for scheme, rows in _data().items()
        for label, row in rows.items()
        if "origin" not in row
    )


def origin(name: str) -> str:
    """Where a controller of the catalogue comes from: ``"paper"``, or how to get it again."""
    scheme, _, label = controller(name).name.partition("/")
    return str(_data()[scheme][label].get("origin", "paper"))


def confirmed(name: str) -> dict[str, Any] | None:
    """Figures with which a controller that a search found was entered into the catalogue.

    Returns
    -------
    dict or None
        ``mesh``: ``slope_step_deg``, ``slope_limit_deg``, ``threshold``, ``states``, and ``mfpt``,
        steps by sigma_s in degrees; ``walks``: ``number``, ``seed``, ``max_steps``, and
        ``mean_steps`` with ``standard_error``, each by sigma_s in degrees; ``speed`` (m/s) and
        ``cost_of_transport`` on flat ground; None for others.
    """
    scheme, _, label = controller(name).name.partition("/")
    return _data()[scheme][label].get("confirmed")


def catalogue_row(controller: Controller) -> dict[str, Any]:
    """Parameters as a row of ``data/controllers.json`` has them."""
    values = controller.parameters.tolist()
    if controller.scheme == "hzd":
        return {
            "kp": values[0],
            "kd": values[1],
            "bezier": np.reshape(values[2:30], (4, 7)).tolist(),
        }
    if controller.scheme == "smc":
        return {
            f"{name}_deg" if "_ref" in name else name: math.degrees(v) if "_ref" in name else v
            for name, v in zip(smc.PARAMETERS, values, strict=True)
        }
    return {
        "kp": values[:4],
        "kd": values[4:8],
        "theta_first": values[8],
        "theta_last": values[9],
        "coefficients": np.reshape(values[10:], (4, spline.COEFFICIENTS)).tolist(),
    }


def controller(name: str) -> Controller:
    """Controller of the catalogue.

    Raises
    ------
    InputError
        If there is none of that name.
    """
    try:
        return catalogue()[name]
    except KeyError:
        raise InputError("controller", name, "one of " + ", ".join(catalogue())) from None
