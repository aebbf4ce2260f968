"""Pictures of studies: how a search went, and what it costs to be robust."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from biped_mfpt_ros.control.controller import catalogue
from biped_mfpt_ros.gait.cycle import NoLimitCycle, find_limit_cycle
from biped_mfpt_ros.optimise.local import LocalBackend
from biped_mfpt_ros.optimise.scoring import MeshFailed, front_of
from biped_mfpt_ros.optimise.settings import Stage, StudySettings
from biped_mfpt_ros.optimise.store import Trial
from biped_mfpt_ros.optimise.study import Study
from biped_mfpt_ros.report.style import OURS, PAPER, Picture, new_figure, png, tidy
from biped_mfpt_ros.study.readings import readings

_COLOURS = (OURS, "#e08e1b", "#2a8c5a", "#8a4fae", "#333a45")
_GREY = "#a9adb3"


def history(study: Study) -> Picture:
    """Score of every trial, and the best confirmed one so far.

    Raises
    ------
    ValueError
        If no trial is done.
    """
    done = [t for t in study.trials() if t.found is not None]
    gaits = [t for t in done if t.found is not None and t.found.violation == 0.0]
    confirmed = [t for t in gaits if t.found is not None and t.found.confirmed]
    numbers, best = _best_so_far(confirmed)
    figure = new_figure(3.4)
    axes = figure.add_subplot()
    axes.plot(*_points(gaits), ".", color=_GREY, markersize=3, label="scored")
    axes.plot(*_points(confirmed), ".", color=OURS, markersize=5, label="confirmed")
    if done and numbers:
        axes.step([*numbers, done[-1].number], [*best, best[-1]], where="post", color=OURS)
        axes.set_ylim(best[0] - 1.0, best[-1] + 0.5)
    axes.set_xlabel("trial")
    names = ", ".join(study.settings.objectives)
    sigma = math.degrees(study.settings.sigma_s)
    only = tuple(study.settings.objectives) == ("mfpt",)
    axes.set_ylabel(f"log10 MFPT at σ = {sigma:g}°" if only else f"score ({names})")
    axes.legend(frameon=False)
    tidy(axes)
    caption = (
        f"Study {study.name}: {len(done)} trials of {study.settings.searcher} from "
        f"{study.settings.start.name}, {len(gaits)} with a stable gait within the constraints, "
        f"{len(confirmed)} confirmed. The line is the best confirmed score so far."
    )
    return Picture(f"Study {study.name}", caption, png(figure))


def _best_so_far(confirmed: Sequence[Trial]) -> tuple[list[int], list[float]]:
    numbers: list[int] = []
    best: list[float] = []
    for trial in confirmed:
        assert trial.found is not None
        if not best or trial.found.score > best[-1]:
            numbers.append(trial.number)
            best.append(trial.found.score)
    return numbers, best


def _points(trials: Sequence[Trial]) -> tuple[list[int], list[float]]:
    return [t.number for t in trials], [t.found.score for t in trials if t.found is not None]


def front(studies: Sequence[Study], paper: bool = True) -> Picture:
    """Cost of transport against MFPT: the confirmed trials of studies that no other beats in both.

    Studies of the same scheme are taken together. The paper's controllers are those of the
    catalogue, each under the limits of ``data/readings.json`` and on the last mesh of the first
    study, at its sigma_s.

    Parameters
    ----------
    studies : sequence of Study
        All at the same sigma_s.
    paper : bool, optional
        Whether the paper's controllers are marked, which takes a mesh of each.

    Raises
    ------
    ValueError
        If the studies are of different sigma_s.
    """
    settings = studies[0].settings
    if len({(s.settings.mu_s, s.settings.sigma_s) for s in studies}) > 1:
        raise ValueError("studies of different slope distributions do not make one front")
    figure = new_figure(4.2)
    axes = figure.add_subplot()
    texts = []
    schemes = dict.fromkeys(s.settings.start.scheme for s in studies)
    for colour, scheme in zip(_COLOURS, schemes, strict=False):
        points = [
            (-t.found.values["mfpt"], t.found.values["cot"])
            for s in studies
            if s.settings.start.scheme == scheme
            for t in s.trials()
            if t.found is not None and t.found.confirmed and "mfpt" in t.found.values
        ]
        best = sorted(points[i] for i in front_of(points))
        mfpt, cot = [-p[0] for p in best], [p[1] for p in best]
        axes.plot([-p[0] for p in points], [p[1] for p in points], ".", color=colour,
                  markersize=3, alpha=0.35)  # fmt: skip
        axes.plot(mfpt, cot, "o-", color=colour, markersize=4, label=scheme)
        texts.append(f"{scheme}: {len(best)} on the front of {len(points)} confirmed")
    if paper:
        for name, (mfpt_, cot_) in paper_points(settings).items():
            axes.plot([mfpt_], [cot_], "*", color=PAPER, markersize=11, markeredgecolor="white")
            axes.annotate(name, (mfpt_, cot_), (4, 4), textcoords="offset points", fontsize=8)
    axes.set_xscale("log")
    sigma = math.degrees(settings.sigma_s)
    axes.set_xlabel(f"MFPT at σ = {sigma:g}°, steps")
    axes.set_ylabel("cost of transport")
    axes.set_ylim(bottom=0.0)
    axes.legend(frameon=False)
    tidy(axes)
    caption = (
        f"Cost of transport on flat ground against MFPT at sigma_s = {sigma:g} degrees. "
        + "; ".join(texts)
        + (". Stars: the paper's controllers." if paper else ".")
    )
    return Picture("Cost of transport against MFPT", caption, png(figure))


def paper_points(settings: StudySettings) -> dict[str, tuple[float, float]]:
    """MFPT and cost of transport of the paper's controllers, on the last mesh of a study.

    Sliding-mode meshes are as the paper's, d_thr = 1 and 0.3 and d_s = 1 degree: theirs converge
    early and are large.
    """
    out = {}
    for name, reading in readings().items():
        sliding = name.startswith("smc")
        stage = Stage(1.0, 0.3 if name == "smc/base" else 1.0) if sliding else settings.stages[-1]
        try:
            cycle = find_limit_cycle(catalogue()[name], 0.0, reading.model)
            mine = StudySettings(
                start=catalogue()[name], model=reading.model, stages=(stage,),
                mu_s=settings.mu_s, sigma_s=settings.sigma_s,
            )  # fmt: skip
            mesh = LocalBackend().grow(cycle, mine, stage, mine.slopes[0], lambda: None)
            mfpt = mesh.mfpt(settings.mu_s, settings.sigma_s)
        except (NoLimitCycle, MeshFailed):
            continue
        if np.isfinite(mfpt):
            out[name] = (mfpt, cycle.cost_of_transport)
    return out
