"""Curves of a study, with the paper's numbers: Figures 2 and 3."""

from __future__ import annotations

from dataclasses import dataclass, field

from biped_mfpt_ros.report import paper
from biped_mfpt_ros.study.plan import SIGMA_DEG, scheme_of
from biped_mfpt_ros.study.results import Results


@dataclass(frozen=True)
class Curve:
    """MFPT of a controller over the standard deviation of the slope.

    Attributes
    ----------
    controller : str
    slope_step_deg, threshold : float
        d_s (degrees) and d_thr of its mesh.
    states : int
        Of its mesh.
    sigma_deg, mfpt : list of float
        Degrees and steps.
    paper : list of (float, float, str)
        The paper's numbers: degrees, steps, ``"mesh"`` or ``"Monte Carlo"``.
    walks : list of (float, float, float, float)
        Monte Carlo here: degrees, steps, 95 % confidence interval.
    """

    controller: str
    slope_step_deg: float
    threshold: float
    states: int
    sigma_deg: list[float]
    mfpt: list[float]
    paper: list[tuple[float, float, str]] = field(default_factory=list)
    walks: list[tuple[float, float, float, float]] = field(default_factory=list)


def curves(results: Results) -> list[Curve]:
    """Figures 2 and 3: MFPT over sigma_s, of one mesh of each controller."""
    out = []
    for n in results.plan.controllers:
        mesh = results.finest(n)
        if mesh is None:
            continue
        theirs, walked = [], []
        for sigma in SIGMA_DEG[scheme_of(n)]:
            for kind, value in (
                ("mesh", paper.mfpt(n, 0.0, sigma)),
                ("Monte Carlo", paper.monte_carlo(n, 0.0, sigma)),
            ):
                if value is not None:
                    theirs.append((sigma, value, kind))
            walk = results.walks(n, sigma)
            if walk is not None and walk["low"] is not None:
                mean, low, high = (float(walk[k]) for k in ("mean_steps", "low", "high"))
                walked.append((sigma, mean, low, high))
        solved = [
            (at, float(value))
            for at, value in zip(mesh["sigma_deg"], mesh["mfpt"], strict=True)
            if value is not None
        ]
        out.append(
            Curve(
                n,
                mesh["slope_step_deg"],
                mesh["threshold"],
                mesh["states"],
                [at for at, _ in solved],
                [value for _, value in solved],
                theirs,
                walked,
            )
        )
    return out
