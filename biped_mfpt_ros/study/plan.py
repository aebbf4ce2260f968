"""What is computed for the paper's tables and figures: jobs that do not depend on one another."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from biped_mfpt_ros.control.controller import controller, paper_controller_names
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.jit import STEP_MAP
from biped_mfpt_ros.models import model_values
from biped_mfpt_ros.study.readings import readings
from biped_mfpt_ros.walker.robot import WalkerModel

SEED = 1
WALKS = 10_000
QUICK_WALKS = 500
SIGMA_DEG = {"hzd": (1.0, 2.0), "smc": (1.0, 2.0, 5.0)}
"""Standard deviations of the slope (degrees) at which every mesh is evaluated, by scheme."""

TABLE_SIGMA_DEG = {"hzd": 2.0, "smc": 5.0}
"""That of Tables 2 and 4."""

CURVE_DEG = {
    "hzd": tuple(np.round([*np.arange(0.2, 1.51, 0.05), *np.arange(1.6, 3.01, 0.2)], 3).tolist()),
    "smc": tuple(np.round([*np.arange(0.5, 3.51, 0.125), *np.arange(4.0, 7.01, 0.5)], 3).tolist()),
}
"""Standard deviations (degrees) of Figures 2 and 3."""

PAPER_MESH = {"hzd": (0.5, 0.3), "smc": (1.0, 1.0)}
"""d_s (degrees) and d_thr that the paper optimised with."""

# d_s (degrees) and d_thr of the study of convergence, coarse to fine; what comes last is the finest
# mesh, of which the figures are drawn. Sizes are such that all of it takes some minutes.
_MESHES = {
    "hzd": tuple((d_s, d_thr) for d_s in (0.5, 0.25) for d_thr in (0.3, 0.1, 0.03, 0.01)),
    "smc/base": ((1.0, 1.0), (1.0, 0.3), (1.0, 0.1), (0.5, 1.0), (0.5, 0.3)),
    "smc/cot": (
        (1.0, 1.0), (1.0, 0.3), (1.0, 0.1), (1.0, 0.03), (0.5, 1.0), (0.5, 0.3), (0.5, 0.1),
    ),
    "smc/mfpt": (
        (1.0, 1.0), (1.0, 0.3), (1.0, 0.1), (1.0, 0.03), (0.5, 1.0), (0.5, 0.3), (0.5, 0.1),
    ),
}  # fmt: skip
_QUICK_MESHES = {
    "hzd": ((0.5, 0.3), (0.5, 0.03)),
    "smc/base": ((1.0, 1.0),),
    "smc/cot": ((1.0, 1.0), (0.5, 0.1)),
    "smc/mfpt": ((1.0, 1.0), (1.0, 0.3)),
}

# Walks as a share of those of Tables 2 and 4, by sigma_s in degrees: to check the meshes where
# walks are not too long.
_WALKS = {
    "hzd/base": {1.0: 1.0, 2.0: 1.0},
    "hzd/cot": {1.0: 1.0, 2.0: 1.0},
    "hzd/mfpt": {1.0: 0.2, 2.0: 1.0},
    "smc/base": {2.0: 0.03, 5.0: 1.0},
    "smc/cot": {1.0: 0.4, 2.0: 0.4, 5.0: 1.0},
    "smc/mfpt": {5.0: 1.0},
}
_WALK_TOLERANCE = {"hzd": 3e-9, "smc": 1e-7}
_TOLERANCES = (1e-6, 1e-7, 3e-9, 1e-10)

# Standard deviation (degrees) of the ground in the pictures: for walks of some steps.
_PICTURE_DEG = {
    "hzd/base": 1.0, "hzd/cot": 1.0, "hzd/mfpt": 2.0,
    "smc/base": 5.0, "smc/cot": 1.0, "smc/mfpt": 5.0,
}  # fmt: skip

# s on one core, of a swing, for the time left.
_SWING = {"hzd": 0.0004, "smc": 0.0022}
# Steps of a walk or states of a mesh, roughly, for the same purpose.
_STEPS = {
    "hzd/base": {1.0: 7, 2.0: 3}, "hzd/cot": {1.0: 8, 2.0: 3}, "hzd/mfpt": {1.0: 137, 2.0: 7},
    "smc/base": {2.0: 95, 5.0: 6}, "smc/cot": {1.0: 7, 2.0: 3, 5.0: 2}, "smc/mfpt": {5.0: 10},
}  # fmt: skip
_STATES = {"hzd/cot": 8, "hzd/base": 20, "hzd/mfpt": 40, "smc/cot": 30, "smc/base": 1000,
           "smc/mfpt": 400}  # fmt: skip


@dataclass(frozen=True)
class Job:
    """Something to compute, whose result is kept.

    Attributes
    ----------
    kind : str
        ``cycle``, ``mesh``, ``counted``, ``walks``, ``tolerance``, ``slopes`` or ``pictures``;
        ``reading`` or ``scatter`` in a fit of the readings.
    controller : str
        What walks.
    settings : dict
        What else decides the result, of JSON's types; slopes in degrees.
    seconds : float
        s on two cores, roughly.
    model : WalkerModel or None
        What it walks with, if not the controller's reading.
    """

    kind: str
    controller: str
    settings: dict[str, Any] = field(default_factory=dict)
    seconds: float = 1.0
    model: WalkerModel | None = None

    @property
    def inputs(self) -> dict[str, Any]:
        """All that decides the result, of JSON's types."""
        values = controller(self.controller).parameters
        model = self.model or readings()[self.controller].model
        return {
            "kind": self.kind,
            "controller": self.controller,
            "parameters": hashlib.sha256(values.tobytes()).hexdigest()[:16],
            "model": {k: repr(v) for k, v in model_values(model).items()},
            "settings": self.settings,
            "step_map": STEP_MAP,
        }

    @property
    def name(self) -> str:
        """Name of its files: what it is, and a digest of its inputs."""
        text = json.dumps(self.inputs, sort_keys=True)
        label = self.controller.replace("/", "-")
        return f"{self.kind}-{label}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"

    @property
    def title(self) -> str:
        """What it is, for a progress line."""
        known = {
            "slope_step_deg": "d_s", "threshold": "d_thr", "at_deg": "sigma", "walks": "walks",
        }  # fmt: skip
        details = [f"{known[k]} {v:g}" for k, v in self.settings.items() if k in known]
        return " ".join([self.controller, self.kind, *details])


@dataclass(frozen=True)
class Plan:
    """All jobs of a study.

    Attributes
    ----------
    controllers : tuple of str
        What is studied.
    quick : bool
        Whether it is the short one.
    walks : int
        Walks of Tables 2 and 4.
    jobs : tuple of Job
        In the order in which they are to be done.
    """

    controllers: tuple[str, ...]
    quick: bool
    walks: int
    jobs: tuple[Job, ...]

    def of(self, kind: str, name: str | None = None) -> list[Job]:
        """The jobs of a kind, of a controller or of all."""
        return [j for j in self.jobs if j.kind == kind and name in (None, j.controller)]


def scheme_of(name: str) -> str:
    """Scheme of a controller of the catalogue."""
    return controller(name).scheme


def make_plan(
    controllers: Sequence[str] | None = None,
    *,
    quick: bool = False,
    walks: int | None = None,
    drawing: str = "",
) -> Plan:
    """Plan a study.

    Parameters
    ----------
    controllers : sequence of str, optional
        Controllers of the paper; all six by default. Their order does not count.
    quick : bool, optional
        Coarser meshes and fewer walks.
    walks : int, optional
        Walks of Tables 2 and 4; 10000 by default, 500 if quick.
    drawing : str, optional
        Identity of what draws the pictures; none are drawn without.

    Raises
    ------
    InputError
        If a controller is none of the paper's, or there are no walks.
    """
    papers = paper_controller_names()
    for name in controllers or ():
        if name not in papers:
            raise InputError("controllers", name, "one of " + ", ".join(papers))
    names = tuple(n for n in papers if not controllers or n in controllers)
    walks = (QUICK_WALKS if quick else WALKS) if walks is None else walks
    if walks < 2:
        raise InputError("walks", walks, ">= 2")
    jobs = [Job("cycle", name, seconds=1.0) for name in names]
    meshes = _QUICK_MESHES if quick else _MESHES
    for name in names:
        scheme = scheme_of(name)
        for d_s, d_thr in (chosen := meshes.get(name, meshes.get(scheme, ()))):
            curve = CURVE_DEG[scheme] if (d_s, d_thr) == chosen[-1] else ()
            finer = PAPER_MESH[scheme][0] / d_s * PAPER_MESH[scheme][1] / d_thr
            jobs.append(
                Job(
                    "mesh",
                    name,
                    {
                        "slope_step_deg": d_s,
                        "threshold": d_thr,
                        "sigma_deg": sorted({*SIGMA_DEG[scheme], *curve}),
                    },
                    2.0 + _STATES[name] * finer * _SWING[scheme] / 2.0,
                )
            )
            # At the sigmas at which there are walks: to be compared with them.
            mesh = {"slope_step_deg": d_s, "threshold": d_thr}
            counted = mesh | {"sigma_deg": sorted(_WALKS[name])}
            jobs.append(Job("counted", name, counted, 0.1 + 0.1 * jobs[-1].seconds))
    for name in names:
        scheme = scheme_of(name)
        for sigma, share in _WALKS[name].items():
            if quick and (name, sigma) == ("smc/base", 2.0):
                continue
            number = max(2, round(share * walks))
            jobs.append(
                Job(
                    "walks",
                    name,
                    {
                        "at_deg": sigma,
                        "walks": number,
                        "seed": SEED,
                        "tolerance": _WALK_TOLERANCE[scheme],
                    },
                    0.5 + number * _STEPS[name][sigma] * _SWING[scheme] / 2.0,
                )
            )
        if not quick:
            jobs.append(
                Job(
                    "tolerance",
                    name,
                    {
                        "sigma_deg": TABLE_SIGMA_DEG[scheme],
                        "walks": max(2, walks // 50),
                        "seed": SEED,
                        "tolerances": list(_TOLERANCES),
                    },
                    2.0 if scheme == "hzd" else 12.0,
                )
            )
    if "hzd/base" in names:
        jobs.append(Job("slopes", "hzd/base", {"steps": 100, "steepening_deg": 1.0}, 1.0))
    if drawing:
        for name in names:
            about = {"sigma_deg": _PICTURE_DEG[name], "animated": not quick, "drawing": drawing}
            jobs.append(Job("pictures", name, about, 2.5 if quick else 5.0))
    return Plan(names, quick, walks, tuple(jobs))
