"""Figures of the study: MFPT over the roughness of the ground, and its convergence."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from biped_mfpt_ros.report import paper
from biped_mfpt_ros.report.style import BODY, GRID, OURS, PAPER, Picture, new_figure, png, tidy
from biped_mfpt_ros.study.curves import Curve
from biped_mfpt_ros.study.plan import SIGMA_DEG, scheme_of
from biped_mfpt_ros.study.results import Results, mfpt_of

_COLOURS = {"base": "#e08e1b", "cot": "#2a9d72", "mfpt": OURS}
_MOST = 1e30  # steps: beyond it a curve tells nothing more
_PAPER_LIMIT = 1e14  # steps: as far as the paper could compute


def mfpt_curves(number: int, curves: Sequence[Curve]) -> Picture:
    """Figure 2 or 3: MFPT over sigma_s, a curve for each controller, with the paper's numbers.

    Parameters
    ----------
    number : int
        Of the figure in the paper.
    curves : sequence of Curve
        At least one, of a scheme.
    """
    figure = new_figure(4.4)
    axes = figure.subplots()
    largest = 10.0
    for curve in curves:
        colour = _COLOURS.get(curve.controller.partition("/")[2], BODY)
        at, steps = np.array(curve.sigma_deg), np.array(curve.mfpt)
        shown = np.isfinite(steps) & (steps <= _MOST)
        largest = max(largest, steps[shown].max(initial=1.0))
        # Below d_s the slope set is too coarse for the distribution.
        fine = shown & (at >= curve.slope_step_deg)
        axes.plot(at[fine], steps[fine], color=colour, linewidth=2.0, label=curve.controller)
        coarse = shown & (at <= at[fine].min(initial=math.inf))
        axes.plot(at[coarse], steps[coarse], ":", color=colour, linewidth=1.5)
        for sigma, value, kind in curve.paper:
            axes.plot(
                sigma, value, "o" if kind == "mesh" else "D", color=colour, markersize=7,
                markerfacecolor="white", markeredgewidth=1.6, zorder=4,
            )  # fmt: skip
        for sigma, value, low, high in curve.walks:
            axes.errorbar(
                sigma, value, [[value - low], [high - value]], fmt="s", color=colour,
                markersize=3.5, capsize=2.5, zorder=5,
            )  # fmt: skip
    if largest > _PAPER_LIMIT:
        axes.axhline(_PAPER_LIMIT, color=PAPER, linewidth=1.0, linestyle="--")
        axes.annotate(
            "as far as the paper computes", (1.0, _PAPER_LIMIT), (-4, 4), ha="right", color=PAPER,
            xycoords=("axes fraction", "data"), textcoords="offset points", fontsize=9,
        )  # fmt: skip
    style = {"color": BODY, "linestyle": "none"}
    axes.plot([], [], "o", markerfacecolor="white", label="paper, mesh", **style)
    axes.plot([], [], "D", markerfacecolor="white", label="paper, Monte Carlo", **style)
    axes.plot([], [], "s", markersize=3.5, label="Monte Carlo here, 95 %", **style)
    _steps_axis(axes)
    axes.set_ylim(1.0, 3.0 * largest)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("standard deviation of the slope $\\sigma_s$, degrees")
    axes.set_ylabel("mean steps to a fall")
    axes.legend(frameon=False, fontsize=9)
    counts = ", ".join(
        f"{c.controller}: d_s {c.slope_step_deg:g}°, d_thr {c.threshold:g}, {c.states} states"
        for c in curves
    )
    return Picture(
        f"Figure {number}: MFPT over the roughness of the ground",
        "Each curve comes from one mesh of the controller "
        f"({counts}), {len(curves[0].sigma_deg)} values of σ_s; dotted where σ_s is below d_s, "
        "so that the slope set is too coarse. Marks with white faces are the numbers of the "
        "paper's tables.",
        png(figure),
    )


def convergence(name: str, results: Results) -> Picture:
    """MFPT of a controller over the size of its meshes, with Monte Carlo where it can reach.

    Parameters
    ----------
    name : str
        Of a controller that has at least one mesh.
    results : Results
        Of the study.
    """
    meshes = results.meshes(name)
    sigmas = SIGMA_DEG[scheme_of(name)]
    figure = new_figure(2.9)
    panels = figure.subplots(1, len(sigmas), squeeze=False)[0]
    spacings = sorted({mesh["slope_step_deg"] for mesh in meshes}, reverse=True)
    markers = dict(zip(spacings, ("o-", "s--", "^:"), strict=False))
    for axes, sigma in zip(panels, sigmas, strict=True):
        values = []
        for spacing in spacings:
            mine = [mesh for mesh in meshes if mesh["slope_step_deg"] == spacing]
            mfpt = np.array([mfpt_of(mesh, sigma) for mesh in mine], dtype=np.float64)
            states = np.array([mesh["states"] for mesh in mine])
            finite = np.isfinite(mfpt)
            values += mfpt[finite].tolist()
            axes.plot(
                states[finite], mfpt[finite], markers[spacing], color=OURS, markersize=4.5,
                linewidth=1.5, markerfacecolor=OURS if spacing == spacings[0] else "white",
                label=f"$d_s$ = {spacing:g}°",
            )  # fmt: skip
            counted = [mesh["counted"].get(sigma) for mesh in mine]
            known = np.array([value is not None for value in counted], dtype=bool)
            if known.any():
                as_walks = np.array([float(value) for value in counted if value is not None])
                values += as_walks.tolist()
                axes.plot(
                    states[known], as_walks, markers[spacing][0] + ":", color=BODY, markersize=3.0,
                    linewidth=1.0, label="counted as walks",
                )  # fmt: skip
        walked = results.walks(name, sigma)
        if walked is not None:
            axes.axhspan(walked["low"], walked["high"], color=BODY, alpha=0.25, linewidth=0)
            axes.axhline(walked["mean_steps"], color=BODY, linewidth=1.0, label="Monte Carlo, 95 %")
            values.append(walked["mean_steps"])
        for value, style in (
            (paper.mfpt(name, 0.0, sigma), "-"), (paper.monte_carlo(name, 0.0, sigma), ":"),
        ):  # fmt: skip
            if value is not None:
                label = "paper, mesh" if style == "-" else "paper, Monte Carlo"
                axes.axhline(value, color=PAPER, linewidth=1.2, linestyle=style, label=label)
                values.append(value)
        axes.set_xscale("log")
        _few_ticks(axes, [mesh["states"] for mesh in meshes])
        wide = max(values, default=1.0) > 20.0 * min(values, default=1.0)
        if wide or max(values, default=1.0) > 1e4:
            _steps_axis(axes)
            # Whole decades, so that at least two powers of ten are there to read the rest by.
            powers = np.log10([0.8 * min(values), 1.25 * max(values)])
            axes.set_ylim(10.0 ** np.floor(powers[0]), 10.0 ** np.ceil(powers[1]))
        else:
            axes.set_ylim(0.0, 1.15 * max(values, default=1.0))
        tidy(axes)
        axes.tick_params(labelsize=8)
        axes.set_title(f"$\\sigma_s$ = {sigma:g}°", fontsize=10, loc="left")
        axes.set_xlabel("states", fontsize=9)
    panels[0].set_ylabel("mean steps to a fall", fontsize=9)
    handles = {
        label: handle
        for axes in panels
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=3, frameon=False,
        fontsize=8.5,
    )  # fmt: skip
    return Picture(
        f"{name}: convergence",
        "MFPT over the number of states as d_thr shrinks, for each spacing d_s of the slopes: "
        "blue by eq. (34), to be compared with the paper's mesh in red; dark as walks are counted, "
        "to be compared with Monte Carlo here, the grey band of 95 % confidence, where it reaches.",
        png(figure),
    )


def _few_ticks(axes: Axes, counts: Sequence[int]) -> None:
    """Put some round numbers on a logarithmic axis of counts, also on one below a decade."""
    low, high = 0.8 * min(counts), 1.25 * max(counts)
    tens = [10.0**k for k in range(8)]
    for factors in ((1,), (1, 3), (1, 2, 5)):
        ticks = [f * ten for ten in tens for f in factors if low <= f * ten <= high]
        if len(ticks) >= 2:
            break
    axes.set_xlim(low, high)
    axes.set_xticks(ticks, [f"{tick / 1000:g}k" if tick >= 1000 else f"{tick:g}" for tick in ticks])
    axes.xaxis.set_minor_formatter(NullFormatter())


def _steps_axis(axes: Axes) -> None:
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(numticks=9))
    axes.yaxis.set_major_formatter(FuncFormatter(_power_of_ten))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(which="major", color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _power_of_ten(value: float, position: int | None) -> str:
    exponent = round(math.log10(value))
    return f"{value:g}" if 0 <= exponent <= 3 else f"$10^{{{exponent}}}$"
