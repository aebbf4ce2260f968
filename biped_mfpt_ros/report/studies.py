"""Pictures of studies: how a search went, and what it costs to be robust."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from biped_mfpt_ros.control.controller import catalogue
from biped_mfpt_ros.gait.cycle import NoLimitCycle, find_limit_cycle
from biped_mfpt_ros.optimise.local import LocalBackend
from biped_mfpt_ros.optimise.scoring import MeshFailed, front_of
from biped_mfpt_ros.optimise.settings import Stage, StudySettings
from biped_mfpt_ros.optimise.store import Trial
from biped_mfpt_ros.optimise.study import Study
from biped_mfpt_ros.report.style import OURS, PAPER, Picture, new_figure, png, tidy
from biped_mfpt_ros.report.tables import plural
from biped_mfpt_ros.study.readings import readings

_COLOURS = (OURS, "#e08e1b", "#2a8c5a", "#8a4fae", "#333a45")
_GREY = "#a9adb3"
_TITLES = {"hzd": "hybrid zero dynamics", "smc": "sliding mode", "spline": "B-spline references"}
_NEAR = 1e10  # steps
_BEHIND = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5}


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
        f"Study {study.name}: {plural(len(done), 'trial')} of {study.settings.searcher} from "
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

    Studies of the same scheme are taken together. Points are filled where Monte Carlo has agreed,
    and hollow where falls are too rare for it even at the largest sigma_s that the slope set
    allows. The paper's controllers are those of the catalogue, each under the limits of
    ``data/readings.json`` and on the last mesh of the first study, at its sigma_s.

    Parameters
    ----------
    studies : sequence of Study
        All on the same ground: mean, sigma_s and correlation of the slopes.
    paper : bool, optional
        Whether the paper's controllers are marked, which takes a mesh of each.

    Raises
    ------
    ValueError
        If the studies are of different ground.
    """
    settings = studies[0].settings
    grounds = {(s.settings.mu_s, s.settings.sigma_s, s.settings.correlation) for s in studies}
    if len(grounds) > 1:
        raise ValueError("studies of different slope distributions do not make one front")
    confirmed: dict[str, list[dict[str, float]]] = {}
    for study in studies:
        rows = confirmed.setdefault(study.settings.start.scheme, [])
        for trial in study.trials():
            # Without an end on its slopes, a walk has no place on the axis.
            if (
                trial.found is not None
                and trial.found.confirmed
                and math.isfinite(trial.found.values.get("mfpt", math.nan))
            ):
                rows.append(trial.found.values)
    fronts = {scheme: _front(rows) for scheme, rows in confirmed.items()}
    stars = paper_points(settings) if paper else {}
    longest = max((v["mfpt"] for rows in fronts.values() for v in rows), default=1.0)
    # A panel of their own for the few decades in which the paper's are, if there are many more.
    near = longest > _NEAR**1.5
    figure = new_figure(7.0 if near else 4.2)
    panels = list(figure.subplots(2 if near else 1, squeeze=False)[:, 0])
    for axes in panels:
        for colour, (scheme, rows) in zip(_COLOURS, fronts.items(), strict=False):
            _draw_front(axes, scheme, colour, confirmed[scheme], rows)
        axes.set_xscale("log")
        axes.set_ylabel("cost of transport")
        tidy(axes)
    if near:
        panels[0].set_xlim(1.0, _NEAR)
    for name, point in stars.items():
        for axes in panels:
            axes.plot(*point, "*", color=PAPER, markersize=12, markeredgecolor="white", zorder=7)
        # In the panel where they are apart, and below where another star is above to the right.
        crowded = any(0.0 < cot - point[1] < 0.1 and 1.0 < mfpt / point[0] < 10.0
                      for mfpt, cot in stars.values())  # fmt: skip
        panels[0].annotate(name, point, (0, -14 if crowded else 8), textcoords="offset points",
                           fontsize=8, color=PAPER, zorder=6, bbox=_BEHIND)  # fmt: skip
    for axes in panels:
        top = 1.08 * axes.get_ylim()[1]
        axes.set_ylim(-0.06 * top, top)  # with room for a label below
    sigma = math.degrees(settings.sigma_s)
    panels[-1].set_xlabel(f"MFPT at σ = {sigma:g}°, steps")
    handles = [Line2D([], [], color=colour, marker="o", markersize=4, label=_TITLES[scheme])
               for colour, scheme in zip(_COLOURS, fronts, strict=False)]  # fmt: skip
    if any("check_steps" not in v for rows in fronts.values() for v in rows):
        handles.append(Line2D([], [], color=_GREY, marker="o", linestyle="", markersize=4,
                              markerfacecolor="white", label="too rare for walks"))  # fmt: skip
    if stars:
        handles.append(Line2D([], [], color=PAPER, marker="*", linestyle="", markersize=10,
                              label="the paper's six"))  # fmt: skip
    figure.legend(handles=handles, frameon=False, loc="outside upper center", ncols=2, fontsize=9)
    texts = [
        f"{scheme}: {len(rows)} on the front of {len(confirmed[scheme])} confirmed, "
        f"{sum('check_steps' in v for v in rows)} of these checked by walks"
        for scheme, rows in fronts.items()
    ]
    caption = (
        f"Cost of transport on flat ground against MFPT at sigma_s = {sigma:g} degrees. "
        + "; ".join(texts)
        + (". Stars: the paper's controllers." if stars else ".")
    )
    return Picture("Cost of transport against MFPT", caption, png(figure))


def _front(rows: Sequence[dict[str, float]]) -> list[dict[str, float]]:
    """Those that no other one beats in both, most steps first."""
    costs = [(-v["mfpt"], v["cot"]) for v in rows]
    return [rows[i] for i in sorted(front_of(costs), key=lambda i: costs[i])]


def _draw_front(
    axes: Axes,
    scheme: str,
    colour: str,
    confirmed: Sequence[dict[str, float]],
    front: Sequence[dict[str, float]],
) -> None:
    axes.plot([v["mfpt"] for v in confirmed], [v["cot"] for v in confirmed], ".", color=colour,
              markersize=3, alpha=0.35)  # fmt: skip
    # What has at least so many steps costs as much as the next one on the front: a staircase.
    axes.plot([v["mfpt"] for v in front], [v["cot"] for v in front], drawstyle="steps-post",
              color=colour, linewidth=1.2)  # fmt: skip
    for checked in (True, False):
        some = [v for v in front if ("check_steps" in v) is checked]
        axes.plot([v["mfpt"] for v in some], [v["cot"] for v in some], "o", color=colour,
                  markersize=4, markerfacecolor=colour if checked else "white")  # fmt: skip


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
            mfpt = mesh.mfpt(settings.mu_s, settings.sigma_s, settings.correlation)
        except (NoLimitCycle, MeshFailed):
            continue
        if np.isfinite(mfpt):
            out[name] = (mfpt, cycle.cost_of_transport)
    return out
