"""Pictures of walks: stick figures, animations, phase portraits, torques and forces."""

from __future__ import annotations

import io
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.cycle import LimitCycle, find_limit_cycle
from biped_mfpt_ros.gait.step import check_states, simulate_steps
from biped_mfpt_ros.gait.trace import Trace, trace_swing
from biped_mfpt_ros.report import pictures
from biped_mfpt_ros.report.style import (
    BODY,
    GROUND,
    PAPER,
    SLOPES,
    STANCE,
    SWING,
    Picture,
    legend_below,
    new_figure,
    pixels,
    png,
    slope_norm,
    tidy,
    with_palette,
)
from biped_mfpt_ros.report.tables import correlation_text
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import WalkerModel
from biped_mfpt_ros.walker.terrain import SLOPE_LIMIT, check_distribution, deviations

FRAME_INTERVAL = 0.05
"""s between the frames of an animation: 20 a second, in real time."""

_HOLD = 2.0  # s, of the last frame
_FIGURE_INTERVAL = 0.11  # s between the figures of a sequence: five or six in a step
_MOST_NUMBERS = 10  # slopes that can be written under a sequence
_FRAME = (720, 420)  # pixels of a frame, at most
_BANNER = 34  # pixels of a frame, above, for the text
_NARROWEST = 1.7  # width of a scene over its height
_FRAME_DPI = 130
_COLOURS = 64  # of an animation
_BODY_WEIGHT = 0.5  # m, length of the arrow of a force as large as the weight
_JOINTS = ("stance hip", "swing hip", "stance knee", "swing knee")
_ANGLES = ("stance femur", "swing femur", "stance knee", "swing knee", "torso")
_NO_SLIP = 10.0  # a friction from here on is drawn as none
_LEAST_NORMAL = 1e-3  # share of the weight: below this a ratio of forces says nothing
_BLOCK = 256  # slopes drawn at a time


@dataclass(frozen=True, eq=False)
class RoughWalk:
    """The end of a walk on random slopes.

    Attributes
    ----------
    controller : Controller
        What walked.
    model : WalkerModel
        Torque limit, friction and so on.
    mu_s, sigma_s : float
        rad, mean and standard deviation of the slope.
    correlation : float
        Of each slope with the one before.
    seed, number : int
        It is walk ``number`` of this seed of `monte_carlo`.
    steps : int
        Steps of the whole walk, that of the fall counted.
    starts : numpy.ndarray
        ``[q, dq]`` in which each of the last k swings starts, rad and rad/s, shape (k, 10).
    slopes : numpy.ndarray
        rad, behind the first of these and ahead of each, shape (k + 1,).
    swings : tuple of Trace
        These swings.
    """

    controller: Controller
    model: WalkerModel
    mu_s: float
    sigma_s: float
    correlation: float
    seed: int
    number: int
    steps: int
    starts: np.ndarray
    slopes: np.ndarray
    swings: tuple[Trace, ...]

    @property
    def outcome(self) -> Outcome:
        """How the walk ended; STEP if it was stopped before a fall."""
        return self.swings[-1].outcome

    @property
    def first(self) -> int:
        """Number of the first step that is kept, counted from 1."""
        return self.steps - len(self.swings) + 1

    def figures(self, interval: float) -> pictures.Walk:
        """Figures at regular times, s."""
        return pictures.figures(
            self.swings, list(self.starts), self.slopes.tolist(), self.model.robot, interval
        )


def rough_walk(
    controller: Controller,
    sigma_s: float,
    *,
    mu_s: float = 0.0,
    correlation: float = 0.0,
    seed: int = 1,
    number: int = 0,
    last_steps: int = 8,
    max_steps: int = 10_000,
    model: WalkerModel | None = None,
    state: ArrayLike | None = None,
) -> RoughWalk:
    """Walk on random slopes until the fall, and keep what happens in the last steps.

    The slopes are those of walk ``number`` of `monte_carlo` with the same seed, and so are the
    steps.

    Parameters
    ----------
    controller : Controller
        What walks.
    sigma_s, mu_s : float
        rad, standard deviation (> 0) and mean of the slope.
    correlation : float, optional
        Of each slope with the one before, as for `monte_carlo`.
    seed, number : int, optional
        Of the walk, >= 0.
    last_steps : int, optional
        How many steps to keep, >= 1.
    max_steps : int, optional
        A walk that has not fallen after so many steps is stopped.
    model : WalkerModel, optional
        Torque limit, friction and so on.
    state : array_like, optional
        ``[q, dq]`` after an impact on flat ground, shape (10,), where the walk starts; the limit
        cycle on flat ground by default.

    Raises
    ------
    InputError
        If an argument is out of its range.
    NoLimitCycle
        If no state is given and no limit cycle is found.
    """
    model = model or WalkerModel()
    check_distribution(mu_s, sigma_s, correlation)
    for name, value, least in (
        ("seed", seed, 0),
        ("number", number, 0),
        ("last_steps", last_steps, 1),
        ("max_steps", max_steps, 1),
    ):
        if value < least:
            raise InputError(name, value, f">= {least}")
    if state is None:
        state = find_limit_cycle(controller, 0.0, model).state
    here, behind = check_states(np.asarray(state, dtype=np.float64)[None], "state")[0], 0.0
    random = np.random.Generator(np.random.PCG64([seed, number]))
    kept: deque[tuple[np.ndarray, float, float]] = deque(maxlen=last_steps)
    draws: list[float] = []
    off = np.array([-mu_s])
    steps = 0
    while steps < max_steps:
        steps += 1
        if not draws:
            off = deviations(random.standard_normal(_BLOCK), off[-1], sigma_s, correlation)
            draws = np.clip(mu_s + off, -SLOPE_LIMIT, SLOPE_LIMIT)[::-1].tolist()
        ahead = draws.pop()
        kept.append((here, behind, ahead))
        tried = simulate_steps(controller, here[None], [behind], [ahead], model)
        if tried.outcomes[0, 0] != Outcome.STEP:
            break
        here, behind = tried.next_states[0], ahead
    starts, before, after = zip(*kept, strict=True)
    return RoughWalk(
        controller=controller,
        model=model,
        mu_s=mu_s,
        sigma_s=sigma_s,
        correlation=correlation,
        seed=seed,
        number=number,
        steps=steps,
        starts=np.array(starts),
        slopes=np.array([before[0], *after]),
        swings=tuple(trace_swing(controller, *step, model) for step in kept),
    )


# Stick figures ----------------------------------------------------------------------------------


def gait(walk: RoughWalk) -> Picture:
    """Sequence of stick figures of the last steps of a walk, with the slopes in degrees."""
    walking = walk.figures(_FIGURE_INTERVAL)
    ground, low, top = _scene(walking)
    room = 0.14  # m, for the numbers
    figure = new_figure(5.0 * (top - low + room) / np.ptp(ground[:, 0]) + 0.9)
    axes = figure.subplots()
    pictures.draw_walk(axes, walking, ground, 0.12 + room)
    numbered = len(walk.swings) <= _MOST_NUMBERS
    corners = zip(walking.feet[:-1], walking.feet[1:], walking.slopes[1:], strict=True)
    for (x, y), (x_ahead, y_ahead), slope in corners if numbered else ():
        middle = (0.5 * (x + x_ahead), 0.5 * (y + y_ahead))
        axes.annotate(
            f"{math.degrees(slope):+.1f}°".replace("-", "−"), middle, (0, -4),
            textcoords="offset points", ha="center", va="top", fontsize=7.5, color=BODY,
        )  # fmt: skip
    return Picture(
        f"{walk.controller.name} on rough ground",
        f"{_sentence(walk)} A figure every {_FIGURE_INTERVAL:g} s, one leg blue and one orange"
        f"{'; the numbers are slopes' if numbered else ''}.",
        png(figure),
    )


def _scene(walking: pictures.Walk) -> tuple[np.ndarray, float, float]:
    """Ground of a picture, with more of it around a short walk, and its lower and upper end, m."""
    ground = pictures.ground_line(walking)
    top = max(ground[:, 1].max(), walking.points[:, 3, 1].max()) + 0.12
    low = ground[:, 1].min() - 0.12
    lacking = max(0.0, _NARROWEST * (top - low) - float(np.ptp(ground[:, 0])))
    return pictures.ground_line(walking, 0.5 + 0.5 * lacking, 0.25 + 0.5 * lacking), low, top


def animation(walk: RoughWalk) -> Picture:
    """Animate the last steps of a walk as a GIF, in real time, with the force of the ground.

    The last frame, of the very moment of the fall, stays for two seconds; then it starts again.
    """
    walking = walk.figures(FRAME_INTERVAL)
    frames = with_palette(_frames(walk, walking), _COLOURS)
    file = io.BytesIO()
    durations = [round(1000 * FRAME_INTERVAL)] * (len(frames) - 1) + [round(1000 * _HOLD)]
    frames[0].save(file, "GIF", save_all=True, append_images=frames[1:], duration=durations, loop=0)
    cone = (
        f" The red arrow is the force of the ground on the stance foot, which slips where it "
        f"leaves the cone of friction ({walk.model.friction:g})."
        if walk.model.friction < _NO_SLIP
        else " The red arrow is the force of the ground on the stance foot."
    )
    return Picture(
        f"{walk.controller.name} walks on rough ground",
        f"{_sentence(walk)} In real time.{cone}",
        file.getvalue(),
        "image/gif",
    )


def _frames(walk: RoughWalk, walking: pictures.Walk) -> list[np.ndarray]:
    """The frames of an animation, as `pixels`."""
    ground, low, top = _scene(walking)
    length = np.ptp(ground[:, 0])
    scale = min(_FRAME[0] / length, (_FRAME[1] - _BANNER) / (top - low))
    width, height = round(scale * length), round(scale * (top - low)) + _BANNER
    figure = new_figure(height / _FRAME_DPI, width / _FRAME_DPI)
    figure.set_dpi(_FRAME_DPI)
    figure.set_layout_engine("none")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0 - _BANNER / height))
    pictures.draw_ground(axes, ground, top - 0.12)
    axes.set_axis_off()
    axes.plot(*walking.feet[:-1].T, "|", color=GROUND, markersize=7)
    text = figure.text(0.012, 0.985, "", va="top", fontsize=10, color=BODY)
    friction = walk.model.friction
    cone = Polygon(np.zeros((3, 2)), facecolor=PAPER, alpha=0.16, linewidth=0)
    axes.add_patch(cone)
    round_line = {"solid_capstyle": "round", "solid_joinstyle": "round", "linewidth": 3.0}
    (far,) = axes.plot([], [], color=SWING, **round_line)
    (near,) = axes.plot([], [], color=STANCE, **round_line)
    (torso,) = axes.plot([], [], color=BODY, **round_line)
    (head,) = axes.plot([], [], "o", color=BODY, markersize=6)
    (force,) = axes.plot([], [], color=PAPER, linewidth=1.8)
    (fell,) = axes.plot([], [], "o", color=PAPER, markersize=14, fillstyle="none",
                        markeredgewidth=2.0)  # fmt: skip
    per_newton = _BODY_WEIGHT / (walk.model.robot.mass * walk.model.robot.gravity)
    what = (
        f"{walk.controller.name}, slopes {math.degrees(walk.mu_s):g} ± "
        f"{math.degrees(walk.sigma_s):g}°{correlation_text(walk.correlation)}"
    )
    frames = []
    last = len(walking.points) - 1
    for i, (points, push, step) in enumerate(
        zip(walking.points, walking.forces, walking.steps, strict=True)
    ):
        legs = (near, far) if (walk.first + step) % 2 else (far, near)
        legs[0].set_data(*points[[0, 1, 2]].T)
        legs[1].set_data(*points[[5, 4, 2]].T)
        torso.set_data(*points[[2, 3]].T)
        head.set_data(*points[[3]].T)
        tip = points[0] + per_newton * push
        force.set_data(*np.array([points[0], tip]).T)
        reach = max(0.0, per_newton * push[1])
        cone.set_visible(friction < _NO_SLIP)
        side = np.array([friction * reach, reach])
        cone.set_xy(np.array([points[0], points[0] + side, points[0] + side * [-1.0, 1.0]]))
        caption = f"{what}, step {walk.first + step} of {walk.steps}"
        if i == last and walk.outcome is not Outcome.STEP:
            fell.set_data(*pictures.where_it_falls(walking)[:, None])
            caption += f": {walk.outcome.label}"
        text.set_text(caption)
        frames.append(pixels(figure))
    return frames


def _sentence(walk: RoughWalk) -> str:
    """What walk this is and how it ends."""
    steps = f"All {walk.steps} steps" if walk.first == 1 else f"Steps {walk.first} to {walk.steps}"
    if walk.steps == 1:
        steps = "The only step"
    end = (
        "where it was stopped, still upright"
        if walk.outcome is Outcome.STEP
        else f"where it falls: {walk.outcome.label}"
    )
    return (
        f"{steps} of {walk.controller.name} on slopes of mean {math.degrees(walk.mu_s):g}° and "
        f"standard deviation {math.degrees(walk.sigma_s):g}°"
        f"{correlation_text(walk.correlation)} (walk {walk.number} of seed {walk.seed}), "
        f"to the moment {end}."
    )


# Phase portraits --------------------------------------------------------------------------------


def phase_portraits(walk: RoughWalk, cycle: LimitCycle | None = None) -> Picture:
    """Rates over angles in the swings of a walk, by slope ahead, and the flat limit cycle on top.

    Parameters
    ----------
    walk : RoughWalk
        Its swings are drawn.
    cycle : LimitCycle, optional
        Of the same controller and model.
    """
    figure = new_figure(6.6)
    panels = figure.subplots(3, 2)
    draw_phases(panels.ravel()[:5], walk.swings, walk.slopes[1:])
    if cycle is not None:
        swing = trace_swing(cycle.controller, cycle.state, cycle.slope, cycle.slope, walk.model)
        _draw_cycle(panels.ravel()[:5], swing, cycle.state)
    key = panels[2, 1]
    key.set_axis_off()
    handles = [
        Line2D([], [], marker="o", linestyle="none", color=BODY, markersize=3.5,
               label="after an impact"),
        Line2D([], [], marker="x", linestyle="none", color=PAPER, markersize=7,
               markeredgewidth=2.0, label=f"fall: {walk.outcome.label}"),
    ]  # fmt: skip
    if walk.outcome is Outcome.STEP:
        handles.pop()
    if cycle is not None:
        name = "flat limit cycle" if cycle.slope == 0.0 else "limit cycle"
        handles.append(Line2D([], [], color="black", linewidth=2.2, label=name))
        handles.append(
            Line2D([], [], color="black", linewidth=1.0, linestyle=":", label="its impact")
        )
    key.legend(handles=handles, loc="upper left", frameon=False, borderaxespad=0.0)
    _slope_bar(figure, key, np.degrees(walk.slopes[1:]), "slope ahead, degrees")
    on_top = "" if cycle is None else " The limit cycle on flat ground is drawn in black."
    return Picture(
        f"Phase portraits of {walk.controller.name}",
        f"{_sentence(walk)} Angles and rates of each swing, from impact to impact.{on_top}",
        png(figure),
    )


def draw_phases(panels: Sequence[Axes], swings: Sequence[Trace], slopes: np.ndarray) -> None:
    """Draw dq_i over q_i of swings into five axes, coloured by the slope ahead, rad, shape (k,)."""
    norm = slope_norm(np.degrees(slopes))
    for i, axes in enumerate(panels):
        curves = [swing.states[:, [i, 5 + i]] for swing in swings]
        axes.add_collection(
            LineCollection(
                [c for c in curves if len(c)],
                colors=[
                    SLOPES(norm(math.degrees(s)))
                    for s, c in zip(slopes, curves, strict=True)
                    if len(c)
                ],
                linewidths=1.0,
            )
        )
        for curve in curves:
            axes.plot(*curve[:1].T, "o", color=BODY, markersize=2.6)
        if swings[-1].next_state is None:
            axes.plot(
                *curves[-1][-1:].T, "x", color=PAPER, markersize=7, markeredgewidth=2.0, zorder=5
            )
        axes.set_xlabel(f"$q_{i + 1}$, rad", labelpad=1.0)
        axes.set_ylabel(f"$\\dot q_{i + 1}$, rad/s", labelpad=1.0)
        axes.set_title(_ANGLES[i], fontsize=10, loc="left")
        tidy(axes)
        axes.margins(0.06)


def _draw_cycle(panels: Sequence[Axes], swing: Trace, start: np.ndarray) -> None:
    halo = [withStroke(linewidth=3.6, foreground="white")]
    for i, axes in enumerate(panels):
        curve = swing.states[:, [i, 5 + i]]
        axes.plot(*curve.T, color="black", linewidth=2.0, path_effects=halo, zorder=4)
        impact = np.array([curve[-1], start[[i, 5 + i]]])
        axes.plot(*impact.T, color="black", linewidth=1.0, linestyle=":", zorder=4)
        axes.plot(*impact[1:].T, "o", color="black", markersize=4.0, zorder=4)


def _slope_bar(figure: Figure, beside: Axes, slopes_deg: np.ndarray, label: str) -> None:
    bar = beside.inset_axes((0.0, 0.2, 0.9, 0.07))
    colours = ScalarMappable(slope_norm(slopes_deg), SLOPES)
    figure.colorbar(colours, cax=bar, orientation="horizontal", label=label)


# Torques and forces -----------------------------------------------------------------------------


def torques(swings: Mapping[str, Trace], model: WalkerModel, name: str) -> Picture:
    """Joint torques over steps, with their limit, and below them how near the foot is to slipping.

    Parameters
    ----------
    swings : mapping of str to Trace
        Swings by what they are, one column each; those without samples (a fall at the very start)
        stay empty.
    model : WalkerModel
        Its torque limit and friction are drawn.
    name : str
        Of the controller.
    """
    figure = new_figure(4.9)
    columns = len(swings)
    panels = figure.subplots(2, columns, sharex="col", sharey="row", squeeze=False)
    for (upper, lower), (what, swing) in zip(panels.T, swings.items(), strict=True):
        draw_torques(upper, swing, model.torque_limit)
        draw_force_ratio(lower, swing, model)
        upper.set_title(what, fontsize=10, loc="left")
        if not swing.times.size:
            middle = {"ha": "center", "va": "center", "transform": upper.transAxes}
            upper.text(0.5, 0.5, f"falls at once:\n{swing.outcome.label}", **middle)
        lower.xaxis.set_major_locator(MaxNLocator(4))
        lower.set_xlabel("time since the impact, s")
    # Axes that share a scale show the last one's.
    panels[1, 0].set_ylim(0.0, max(_ratio_top(swing, model) for swing in swings.values()))
    panels[0, 0].set_ylabel("torque, N m")
    panels[1, 0].set_ylabel(r"$|F_t / F_n|$ of the stance foot")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    handles += panels[1, 0].get_legend_handles_labels()[0]
    labels += panels[1, 0].get_legend_handles_labels()[1]
    legend_below(figure, handles, labels)
    limit = (
        "There is no torque limit."
        if math.isinf(model.torque_limit)
        else f"Torques are cut off at {model.torque_limit:g} N m."
    )
    slip = (
        ""
        if model.friction >= _NO_SLIP
        else f" The stance foot slips where the ratio of forces exceeds {model.friction:g}."
    )
    if slip and model.slip_duration > 0.0:
        slip += f" Slips shorter than {1000.0 * model.slip_duration:g} ms are no falls."
    return Picture(
        f"Torques and ground forces of {name}",
        f"Joint torques of {name} and the ratio of tangential to normal ground force: "
        f"{', '.join(swings)}. {limit}{slip}",
        png(figure),
    )


def draw_torques(axes: Axes, swing: Trace, limit: float) -> None:
    """Draw the four torques of a swing over time, s and N m; no limit if it is infinite."""
    for i, joint in enumerate(_JOINTS):
        axes.plot(
            swing.times, swing.torques[:, i], label=joint, color=SWING if i % 2 else STANCE,
            linestyle="-" if i < 2 else (0, (2.2, 1.1)), linewidth=1.6,
        )  # fmt: skip
    if math.isfinite(limit):
        for sign, label in ((1.0, "torque limit"), (-1.0, None)):
            axes.axhline(sign * limit, color=PAPER, linewidth=1.2, linestyle="-.", label=label)
    tidy(axes)
    axes.set_xlim(left=0.0)


def draw_force_ratio(axes: Axes, swing: Trace, model: WalkerModel) -> None:
    """Draw the ratio of ground forces of a swing over time, s, and the friction."""
    ratio = force_ratio(swing, model)
    axes.plot(swing.times, ratio, color=BODY, linewidth=1.6, label="force ratio")
    if model.friction < _NO_SLIP:
        axes.axhline(model.friction, color=PAPER, linewidth=1.2, label=r"friction $\mu_s$")
    if swing.next_state is None and len(ratio):
        axes.plot(swing.times[-1:], ratio[-1:], "x", color=PAPER, markersize=7,
                  markeredgewidth=2.0)  # fmt: skip
    tidy(axes)
    axes.set_ylim(0.0, _ratio_top(swing, model))
    axes.set_xlim(left=0.0)


def force_ratio(swing: Trace, model: WalkerModel) -> np.ndarray:
    """Tangential over normal force on the stance foot, absolute; nan where the foot bears nothing.

    Shape (k,), as the samples of the swing.
    """
    tangential, normal = swing.forces.T
    bears = normal > _LEAST_NORMAL * model.robot.mass * model.robot.gravity
    return np.abs(np.divide(tangential, normal, where=bears, out=np.full(normal.shape, np.nan)))


def _ratio_top(swing: Trace, model: WalkerModel) -> float:
    # A foot that is about to lift has a ratio without bounds.
    friction = model.friction if model.friction < _NO_SLIP else 0.0
    ratio = force_ratio(swing, model)
    largest = float(ratio[np.isfinite(ratio)].max(initial=0.1))
    return max(1.25 * friction, 1.1 * min(largest, 2.0 * friction or 2.0))
