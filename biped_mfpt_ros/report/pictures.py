"""Pictures, drawn with matplotlib into files; no display is needed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.gait.trace import Trace, trace_swing
from biped_mfpt_ros.report.style import BODY, GRID, GROUND, OURS, PAPER, STANCE, SWING
from biped_mfpt_ros.walker.dynamics import to_absolute
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import Robot, WalkerModel
from biped_mfpt_ros.walker.terrain import SLOPE_LIMIT, deviations

_INTERVAL = 0.085  # s between the figures of a sequence


@dataclass(frozen=True)
class Walk:
    """Figures of a robot that walks, for a picture.

    Attributes
    ----------
    points : numpy.ndarray
        m, shape (k, 6, 2): stance foot, stance knee, hip, head, swing knee, swing foot.
    steps : numpy.ndarray
        Number of the step that each figure belongs to, shape (k,).
    feet : numpy.ndarray
        m, shape (steps + 1, 2): where the stance feet stand, then where the last step leads.
    slopes : numpy.ndarray
        rad, shape (steps + 1,): behind the first stance foot, then ahead of each.
    outcome : Outcome
        How the last step ended.
    forces : numpy.ndarray
        N, shape (k, 2): of the ground on the stance foot, horizontal and vertical.
    """

    points: np.ndarray
    steps: np.ndarray
    feet: np.ndarray
    slopes: np.ndarray
    outcome: Outcome
    forces: np.ndarray


def link_points(states: np.ndarray, robot: Robot) -> np.ndarray:
    """Ends of the links, from the stance foot.

    Parameters
    ----------
    states : numpy.ndarray
        ``[q, dq]``, rad and rad/s, shape (k, 10).
    robot : Robot
        The links.

    Returns
    -------
    numpy.ndarray
        m, shape (k, 6, 2): stance foot, stance knee, hip, head, swing knee, swing foot.
    """
    angles = to_absolute(states)[:, :5]
    along = np.stack([-np.sin(angles), np.cos(angles)], axis=-1)
    stance_knee = -robot.tibia_length * along[:, 2]
    hip = stance_knee - robot.femur_length * along[:, 0]
    head = hip + robot.torso_length * along[:, 4]
    swing_knee = hip + robot.femur_length * along[:, 1]
    swing_foot = swing_knee + robot.tibia_length * along[:, 3]
    foot = np.zeros_like(hip)
    return np.stack([foot, stance_knee, hip, head, swing_knee, swing_foot], axis=1)


def walk(
    controller: Controller,
    state: np.ndarray,
    slopes: Sequence[float],
    model: WalkerModel,
    interval: float = _INTERVAL,
) -> Walk:
    """Walk over given slopes, or to the fall, and keep figures at regular times.

    Parameters
    ----------
    controller : Controller
        What walks.
    state : numpy.ndarray
        ``[q, dq]`` after an impact on flat ground, shape (10,).
    slopes : sequence of float
        rad, ahead of each step.
    model : WalkerModel
        Torque limit, friction and so on.
    interval : float, optional
        s between figures.
    """
    starts, swings, passed = [np.asarray(state)], [], [0.0]
    for slope in slopes:
        swings.append(trace_swing(controller, starts[-1], passed[-1], slope, model))
        passed.append(slope)
        following = swings[-1].next_state
        if following is None:
            break
        starts.append(following)
    return figures(swings, starts[: len(swings)], passed, model.robot, interval)


def figures(
    swings: Sequence[Trace],
    starts: Sequence[np.ndarray],
    slopes: Sequence[float],
    robot: Robot,
    interval: float = _INTERVAL,
) -> Walk:
    """Keep figures at regular times of consecutive swings, and the last one.

    Parameters
    ----------
    swings : sequence of Trace
        The swings, each from where the one before it ended.
    starts : sequence of numpy.ndarray
        State in which each swing starts, shape (10,): a fall at the very start leaves no samples.
    slopes : sequence of float
        rad, behind the first stance foot, then ahead of each.
    robot : Robot
        The links.
    interval : float, optional
        s between figures.
    """
    foot, late = np.zeros(2), 0.0
    points, forces, steps, feet = [], [], [], [foot]
    for number, (swing, start, slope) in enumerate(zip(swings, starts, slopes[1:], strict=True)):
        sampled = swing.times.size > 0
        at = swing.times if sampled else np.zeros(1)
        values = np.hstack([swing.states, swing.forces]) if sampled else np.zeros((1, 12))
        if not sampled:
            values[0, :10] = start
        times = np.arange(late, at[-1], interval)
        late = (times[-1] + interval if times.size else late) - at[-1]
        if swing.next_state is None or number == len(swings) - 1:
            times = np.append(times, at[-1])
        if times.size:
            kept = np.stack([np.interp(times, at, column) for column in values.T], axis=1)
            points.append(link_points(kept[:, :10], robot) + foot)
            forces.append(kept[:, 10:])
            steps.append(np.full(times.size, number))
        if swing.next_state is None:
            feet.append(foot + math.cos(slope) * np.array([0.45, 0.45 * math.tan(slope)]))
            break
        foot = link_points(values[-1:, :10], robot)[0, 5] + foot
        feet.append(foot)
    return Walk(
        points=np.concatenate(points),
        steps=np.concatenate(steps),
        feet=np.array(feet),
        slopes=np.array(slopes),
        outcome=swings[-1].outcome,
        forces=np.concatenate(forces),
    )


def example_walk(
    controller: Controller,
    state: np.ndarray,
    mu_s: float,
    sigma_s: float,
    steps: int,
    model: WalkerModel,
    correlation: float = 0.0,
) -> Walk:
    """Walk on random slopes for a picture: up to ``steps`` steps, of the first walks the longest.

    Slopes (rad, mean ``mu_s``, standard deviation ``sigma_s``, ``correlation`` with the one before)
    come from fixed seeds, so that the picture is always the same.
    """
    best: Walk | None = None
    for seed in range(20):
        random = np.random.default_rng(seed)
        off = deviations(random.standard_normal(steps), -mu_s, sigma_s, correlation)
        slopes = np.clip(mu_s + off, -SLOPE_LIMIT, SLOPE_LIMIT)
        found = walk(controller, state, slopes.tolist(), model)
        if best is None or found.steps[-1] > best.steps[-1]:
            best = found
        if best.steps[-1] == steps - 1:
            break
    assert best is not None
    return best


def where_it_falls(walking: Walk) -> np.ndarray:
    """Point of the last figure at which a walk failed: a foot, or a part of the body; m, (2,)."""
    points = walking.points[-1]
    if walking.outcome in (Outcome.STANCE_LIFTS, Outcome.STANCE_SLIPS, Outcome.NO_LIFT_OFF):
        return points[0]
    if walking.outcome is Outcome.BODY_TOUCHES:
        corners = ground_line(walking)
        return min(points[1:5], key=lambda p: p[1] - np.interp(p[0], *corners.T))
    return points[5]


def ground_line(walking: Walk, before: float = 0.5, after: float = 0.25) -> np.ndarray:
    """Corners of the ground, m, shape (steps + 3, 2); some of it before and after the steps."""
    behind, ahead = walking.slopes[0], walking.slopes[-1]
    back = walking.feet[0] - before * np.array([math.cos(behind), math.sin(behind)])
    front = walking.feet[-1] + after * np.array([math.cos(ahead), math.sin(ahead)])
    return np.vstack([back, walking.feet, front])


def draw_ground(axes: Axes, ground: np.ndarray, top: float, depth: float = 0.12) -> None:
    """Draw ground by its corners, and set the limits of the axes: up to ``top``, m, or more."""
    low = ground[:, 1].min() - depth
    axes.fill_between(ground[:, 0], ground[:, 1], low, color=GROUND, alpha=0.25, linewidth=0)
    axes.plot(ground[:, 0], ground[:, 1], color=GROUND, linewidth=1.4)
    axes.set_aspect("equal")
    axes.set_xlim(ground[0, 0], ground[-1, 0])
    axes.set_ylim(low, max(ground[:, 1].max(), top) + 0.12)


def draw_walk(
    axes: Axes, walking: Walk, ground: np.ndarray | None = None, depth: float = 0.12
) -> None:
    """Draw a walk as a sequence of stick figures on its ground, see `ground_line`, ``depth`` m."""
    ground = ground_line(walking) if ground is None else ground
    draw_ground(axes, ground, walking.points[:, 3, 1].max(), depth)
    last = len(walking.points) - 1
    for i, (points, step) in enumerate(zip(walking.points, walking.steps, strict=True)):
        # A leg keeps its colour: it is the stance leg in every second step.
        legs = (STANCE, SWING) if step % 2 == 0 else (SWING, STANCE)
        strong = i in (0, last)
        alpha, width = (0.95, 2.2) if strong else (0.45, 1.1)
        style: dict[str, Any] = {"alpha": alpha, "linewidth": width, "solid_capstyle": "round"}
        axes.plot(*points[[0, 1, 2]].T, color=legs[0], solid_joinstyle="round", **style)
        axes.plot(*points[[5, 4, 2]].T, color=legs[1], solid_joinstyle="round", **style)
        axes.plot(*points[[2, 3]].T, color=BODY, **style)
        axes.plot(*points[3], "o", color=BODY, alpha=alpha, markersize=3.4 if strong else 2.0)
    if walking.outcome is not Outcome.STEP:
        at = where_it_falls(walking)
        axes.plot(*at, "o", color=PAPER, markersize=9, fillstyle="none", markeredgewidth=1.8)
        axes.set_title(walking.outcome.label, fontsize=10, loc="right", color=PAPER)
    axes.set_xlabel("distance, m")
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(left=False, labelleft=False)


def draw_mfpt(
    axes: Axes,
    sigma_deg: np.ndarray,
    mfpt: np.ndarray,
    paper: Sequence[tuple[float, float, str]] = (),
    monte_carlo: Sequence[tuple[float, float, float, float]] = (),
) -> None:
    """Draw MFPT over the standard deviation of the slope, on a logarithmic axis.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
        Where to draw.
    sigma_deg, mfpt : numpy.ndarray
        Degrees and steps, shape (k,).
    paper : sequence of (float, float, str)
        Degrees, steps, and what that figure of the paper is: ``"mesh"`` or ``"Monte Carlo"``.
    monte_carlo : sequence of (float, float, float, float)
        Degrees, steps, and their confidence interval.
    """
    finite = np.isfinite(mfpt)
    axes.plot(sigma_deg[finite], mfpt[finite], color=OURS, linewidth=2.0, label="our mesh")
    if not finite.any():
        middle = {"ha": "center", "va": "center", "transform": axes.transAxes}
        axes.text(0.5, 0.5, "no fall can be reached", **middle)
    if monte_carlo:
        at, steps, low, high = np.array(monte_carlo).T
        axes.errorbar(
            at, steps, [steps - low, high - steps], fmt="s", color=BODY, markersize=4.5, capsize=3,
            label="our Monte Carlo, 95 %",
        )  # fmt: skip
    for kind, marker in (("mesh", "o"), ("Monte Carlo", "D")):
        at_steps = [(at, steps) for at, steps, which in paper if which == kind]
        if at_steps:
            axes.plot(
                *np.array(at_steps).T, marker, color=PAPER, markersize=7, fillstyle="none",
                markeredgewidth=1.8, label=f"paper, {kind}",
            )  # fmt: skip
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(numticks=10))
    axes.yaxis.set_major_formatter(FuncFormatter(_power_of_ten))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylim(bottom=1.0)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("standard deviation of the slope, degrees")
    axes.set_ylabel("mean steps to a fall")
    axes.grid(which="major", color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)


def save_run(
    file: Path | BinaryIO,
    title: str,
    walking: Walk,
    walk_title: str,
    sigma_deg: np.ndarray,
    mfpt: np.ndarray,
    paper: Sequence[tuple[float, float, str]] = (),
    monte_carlo: Sequence[tuple[float, float, float, float]] = (),
) -> None:
    """Save the picture of a run: MFPT over the roughness beside a walk; see `draw_mfpt`."""
    figure = Figure(figsize=(13.0, 4.6), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.75])
    draw_mfpt(left, sigma_deg, mfpt, paper, monte_carlo)
    left.set_title(title, fontsize=11, loc="left")
    draw_walk(right, walking)
    right.set_title(walk_title, fontsize=11, loc="left")
    figure.savefig(file, format="png")


def _power_of_ten(value: float, position: int | None) -> str:
    exponent = round(math.log10(value))
    return f"{value:g}" if 0 <= exponent <= 3 else f"$10^{{{exponent}}}$"
