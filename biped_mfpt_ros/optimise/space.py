"""Search spaces: vectors that a searcher moves to the parameters of a controller, and back.

A vector is in scaled coordinates: the start is zero everywhere, and one is a sensible first step
of that coordinate. Gains and times are searched by their logarithm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from biped_mfpt_ros.arrays import numbers
from biped_mfpt_ros.control import hzd, smc, spline
from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.walker.robot import Robot


@dataclass(frozen=True)
class Coordinate:
    """One number that a search may vary.

    Attributes
    ----------
    name : str
        Of the scheme's parameter.
    scale : float
        A sensible first step: in the parameter's unit, or of its natural logarithm if ``log``.
    low, high : float
        Bounds, in the parameter's unit.
    log : bool
        Whether its logarithm is searched.
    """

    name: str
    scale: float
    low: float
    high: float
    log: bool = False


@dataclass(frozen=True)
class Parametrisation:
    """What of a scheme's parameters is free, and how the others follow.

    Attributes
    ----------
    coordinates : tuple of Coordinate
        The free ones, in order.
    free : callable
        Parameters of the scheme to the values of the free ones, shape (n,).
    parameters : callable
        Values of the free ones, parameters of the start, and robot to parameters of the scheme.
    """

    coordinates: tuple[Coordinate, ...]
    free: Callable[[np.ndarray], np.ndarray]
    parameters: Callable[[np.ndarray, np.ndarray, Robot], np.ndarray]


_COLUMNS = hzd.DEGREE + 1


def _hzd_coordinates() -> tuple[Coordinate, ...]:
    gains = (
        Coordinate("kp", 0.2, 10.0, 1e4, log=True),
        Coordinate("kd", 0.2, 1.0, 500.0, log=True),
    )
    # rad. The last two also decide the start of the step, through the impact; they are stiffer.
    scales = {2: 0.03, 3: 0.03, 4: 0.02, 5: 0.02, 6: 0.01}
    bounds = {1: (2.2, 4.4), 2: (2.2, 4.6), 3: (-1.8, 0.5), 4: (-2.2, 0.8)}
    return gains + tuple(
        Coordinate(f"alpha_{k}^{i}", scales[k], *bounds[i]) for i in bounds for k in scales
    )


def _hzd_free(parameters: np.ndarray) -> np.ndarray:
    bezier = parameters[2 : 2 + 4 * _COLUMNS].reshape(4, _COLUMNS)
    return np.concatenate([parameters[:2], bezier[:, 2:].ravel()])


def _hzd_parameters(free: np.ndarray, start: np.ndarray, robot: Robot) -> np.ndarray:
    """alpha_0 and alpha_1 follow from hybrid invariance."""
    bezier = np.empty((4, _COLUMNS))
    bezier[:, 2:] = free[2:].reshape(4, _COLUMNS - 2)
    bezier[:, 0], bezier[:, 1] = hzd.hybrid_invariant_start(bezier[:, 5], bezier[:, 6], robot)
    return np.concatenate([free[:2], bezier.ravel(), start[2 + 4 * _COLUMNS :]])


def _smc_coordinate(name: str) -> Coordinate:
    if name.startswith("k"):
        return Coordinate(name, 0.1, 1.0, 1e3, log=True)
    if name.startswith("tau"):
        return Coordinate(name, 0.1, 0.005, 1.0, log=True)
    if name.startswith("alpha"):
        return Coordinate(name, 0.02, 0.5, 1.0)
    low, high = {"theta2": (2.6, 4.7), "q3_ref": (-0.5, 0.1), "q4_ref": (-2.0, 0.1)}.get(
        name[:6], (-0.5, 0.5)
    )
    return Coordinate(name, 0.02, low, high)


def _spline_coordinate(name: str) -> Coordinate:
    if name.startswith("kp"):
        return Coordinate(name, 0.2, 10.0, 1e4, log=True)
    if name.startswith("kd"):
        return Coordinate(name, 0.2, 1.0, 500.0, log=True)
    if name.startswith("theta"):
        return Coordinate(name, 0.03, -4.5, -1.5)
    # rad, of theta_2, q3, q4 and q5
    low, high = {"1": (2.2, 5.0), "2": (-1.8, 0.5), "3": (-2.2, 0.8), "4": (-1.0, 1.0)}[name[-1]]
    return Coordinate(name, 0.03, low, high)


PARAMETRISATIONS = {
    "hzd": Parametrisation(_hzd_coordinates(), _hzd_free, _hzd_parameters),
    "smc": Parametrisation(
        tuple(_smc_coordinate(name) for name in smc.PARAMETERS),
        lambda parameters: np.array(parameters),
        lambda free, start, robot: free,
    ),
    "spline": Parametrisation(
        tuple(_spline_coordinate(name) for name in spline.PARAMETERS),
        lambda parameters: np.array(parameters),
        lambda free, start, robot: free,
    ),
}
"""What is free in each scheme, by its name."""


class SearchSpace:
    """Vectors around a start, and the controllers that they stand for.

    Parameters
    ----------
    start : Controller
        Where the search starts: the vector 0. Bounds that it breaks are widened to let it in.
    robot : Robot
        The links, for what follows from hybrid invariance.
    fixed : sequence of str, optional
        Names or patterns (``"alpha_*^3"``, ``"k*"``) of coordinates that stay as in the start.

    Raises
    ------
    InputError
        If the start's scheme has no parametrisation, a pattern fits nothing, or nothing is free.
    """

    def __init__(self, start: Controller, robot: Robot, fixed: Sequence[str] = ()) -> None:
        if start.scheme not in PARAMETRISATIONS:
            raise InputError("scheme", start.scheme, "one of " + ", ".join(PARAMETRISATIONS))
        self._start = start
        self._robot = robot
        self._parametrisation = PARAMETRISATIONS[start.scheme]
        coordinates = self._parametrisation.coordinates
        for pattern in fixed:
            if not any(fnmatchcase(c.name, pattern) for c in coordinates):
                names = ", ".join(c.name for c in coordinates)
                raise InputError("fixed", pattern, f"a name or a pattern of {names}")
        self._free = [
            i
            for i, c in enumerate(coordinates)
            if not any(fnmatchcase(c.name, pattern) for pattern in fixed)
        ]
        if not self._free:
            raise InputError("fixed", list(fixed), "patterns that leave something free")
        self.coordinates = tuple(coordinates[i] for i in self._free)
        self._log = np.array([c.log for c in coordinates])
        self._scales = np.array([c.scale for c in coordinates])
        self._origin = self._inside(self._parametrisation.free(start.parameters))
        low = np.minimum(self._inside(np.array([c.low for c in coordinates])), self._origin)
        high = np.maximum(self._inside(np.array([c.high for c in coordinates])), self._origin)
        bounds = (np.stack([low, high], axis=1) - self._origin[:, None]) / self._scales[:, None]
        self.bounds = bounds[self._free]
        """Of the scaled coordinates, shape (n, 2)."""

    def __len__(self) -> int:
        """How many coordinates are free."""
        return len(self._free)

    def _inside(self, values: np.ndarray) -> np.ndarray:
        """Values with logarithms where these are searched."""
        out = np.array(values, dtype=np.float64)
        out[self._log] = np.log(out[self._log])
        return out

    def controller(self, vector: np.ndarray, name: str = "") -> Controller:
        """Controller of a vector.

        Parameters
        ----------
        vector : numpy.ndarray
            Scaled coordinates, shape (n,).
        name : str, optional
            Of the controller.

        Returns
        -------
        Controller
            What walks.

        Raises
        ------
        InputError
            If there is no such controller: legs that never part, numbers that are not finite, or
            another number of them.
        """
        allowed = f"{len(self)} numbers"
        vector = numbers(vector, "vector", allowed)
        if vector.shape != (len(self),):
            raise InputError("vector", f"shape {vector.shape}", allowed)
        values = self._origin.copy()
        values[self._free] += vector * self._scales[self._free]
        with np.errstate(all="ignore"):
            values[self._log] = np.exp(values[self._log])
            try:
                parameters = self._parametrisation.parameters(
                    values, self._start.parameters, self._robot
                )
            except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
                if isinstance(error, InputError):
                    raise
                raise InputError("vector", vector.tolist(), f"a gait: {error}") from None
        made = Controller(name or f"{self._start.scheme}/trial", self._start.scheme, parameters)
        made.packed(self._robot)  # checks ranges
        return made

    def described(self) -> list[dict[str, Any]]:
        """Name, start, step and bounds of each free coordinate, for JSON and readers."""
        free = self._parametrisation.free(self._start.parameters)
        rows: list[dict[str, Any]] = []
        for i, c in zip(self._free, self.coordinates, strict=True):
            step = free[i] * math.expm1(c.scale) if c.log else c.scale
            rows.append(
                {"name": c.name, "start": float(free[i]), "step": float(step)}
                | {"low": min(c.low, float(free[i])), "high": max(c.high, float(free[i]))}
            )
        return rows
