"""The results of a study by what they are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from biped_mfpt_ros.study.plan import PAPER_MESH, Plan, scheme_of


class Results:
    """The results of a plan's jobs that there are, by what they are.

    Parameters
    ----------
    plan : Plan
    results : mapping
        Result by the job's name.
    """

    def __init__(self, plan: Plan, results: Mapping[str, dict[str, Any]]) -> None:
        self.plan = plan
        self._results = results

    def _of(self, kind: str, name: str) -> list[tuple[dict[str, Any], dict[str, Any]]]:
        """Settings and result of each job of a kind and a controller."""
        return [
            (job.settings, self._results[job.name])
            for job in self.plan.of(kind, name)
            if job.name in self._results
        ]

    def cycle(self, name: str) -> dict[str, Any] | None:
        """The limit cycle's job."""
        return next((result for _, result in self._of("cycle", name)), None)

    def meshes(self, name: str) -> list[dict[str, Any]]:
        """Settings and results of the meshes, coarse to fine.

        ``counted`` has the mean steps of walks by their sigma in degrees, as the mesh has them.
        """
        counted = {
            (settings["slope_step_deg"], settings["threshold"]): dict(
                zip(settings["sigma_deg"], result["mean_steps"], strict=True)
            )
            for settings, result in self._of("counted", name)
        }
        return [
            settings
            | result
            | {"counted": counted.get((settings["slope_step_deg"], settings["threshold"]), {})}
            for settings, result in self._of("mesh", name)
        ]

    def mesh(self, name: str, d_s: float, d_thr: float) -> dict[str, Any] | None:
        """The mesh of given settings."""
        for mesh in self.meshes(name):
            if (mesh["slope_step_deg"], mesh["threshold"]) == (d_s, d_thr):
                return mesh
        return None

    def paper_mesh(self, name: str) -> dict[str, Any] | None:
        """The mesh of the paper's settings."""
        return self.mesh(name, *PAPER_MESH[scheme_of(name)])

    def finest(self, name: str) -> dict[str, Any] | None:
        """The mesh that the figures are drawn of."""
        jobs = self.plan.of("mesh", name)
        if not jobs:
            return None
        settings = jobs[-1].settings
        return self.mesh(name, settings["slope_step_deg"], settings["threshold"])

    def walks(self, name: str, sigma_deg: float) -> dict[str, Any] | None:
        """Monte Carlo at a standard deviation."""
        for settings, result in self._of("walks", name):
            if settings["at_deg"] == sigma_deg:
                return settings | result
        return None

    def tolerance(self, name: str) -> dict[str, Any] | None:
        """Walks with several tolerances."""
        return next((settings | result for settings, result in self._of("tolerance", name)), None)

    def slopes(self) -> dict[str, Any] | None:
        """Steps on constant slopes."""
        return next((result for _, result in self._of("slopes", "hzd/base")), None)


def mfpt_of(mesh: dict[str, Any] | None, sigma_deg: float) -> float | None:
    """MFPT of a mesh's result at a standard deviation in degrees; None if there is none."""
    if mesh is None:
        return None
    for at, value in zip(mesh["sigma_deg"], mesh["mfpt"], strict=True):
        if at == sigma_deg:
            return None if value is None else float(value)
    return None


def percent(value: float | None, reference: float | None) -> float | None:
    """Difference from a reference in per cent; None where one is missing."""
    if value is None or reference is None or not math.isfinite(reference) or reference == 0.0:
        return None
    return 100.0 * (value / reference - 1.0)
