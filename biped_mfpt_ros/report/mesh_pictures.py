"""Pictures of meshes and of the Markov chain over them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, NullFormatter

from biped_mfpt_ros.chain.markov import (
    Metastability,
    conditional_probabilities,
    slope_probabilities,
)
from biped_mfpt_ros.chain.mesh import Mesh
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.report.style import (
    BODY,
    OUTCOME_COLOURS,
    PAPER,
    SLOPES,
    Picture,
    legend_below,
    new_figure,
    png,
    slope_norm,
    tidy,
)
from biped_mfpt_ros.report.tables import correlation_text, number
from biped_mfpt_ros.walker.outcome import Outcome

_FALLS = tuple(Outcome)[1:]
_LEAST_WEIGHT = 1e-12  # of a state that gets a colour; fainter ones are grey
_PERCENT = FuncFormatter(lambda value, _: f"{100.0 * value:g}%")
_NAMES = [f"{symbol}_{i}" for symbol in ("q", r"\dot q") for i in range(1, 6)]
_WEIGHTS = LinearSegmentedColormap.from_list(
    "weights", colormaps["plasma"](np.linspace(0.92, 0.0, 32))
)  # without the yellow that fades into the page


# Principal plane --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Plane:
    """Principal components of the standardised states of a mesh.

    Attributes
    ----------
    scores : numpy.ndarray
        Of each state but the failure state, in standard deviations, shape (n - 1, 10).
    directions : numpy.ndarray
        Unit vectors over the standardised dimensions, one in each row, shape (10, 10).
    shares : numpy.ndarray
        Share of each component in the variance, descending, shape (10,), sum 1; all 0 if all
        states are one.
    """

    scores: np.ndarray
    directions: np.ndarray
    shares: np.ndarray


def principal_plane(mesh: Mesh) -> Plane:
    """Principal components of the states of a mesh, standardised by its scales r_i (eq. 25).

    A dimension whose scale is inf does not count.
    """
    states = mesh.states[1:]
    standard = (states - states.mean(axis=0)) / mesh.scales
    variances, vectors = np.linalg.eigh(standard.T @ standard / len(standard))
    variances, directions = np.maximum(variances[::-1], 0.0), vectors.T[::-1]
    # The sign of an eigenvector is free: its largest entry is to be positive.
    largest = np.abs(directions).argmax(axis=1)
    directions = directions * np.sign(directions[np.arange(10), largest])[:, None]
    total = variances.sum()
    # One state, or copies of one: what is left is rounding.
    shares = variances / total if total > 1e-20 else np.zeros(10)
    return Plane(standard @ directions.T, directions, shares)


def mesh_plane(mesh: Mesh, name: str) -> Picture:
    """Draw the states of a mesh on their principal plane, coloured by the slope before them."""
    plane = principal_plane(mesh)
    slopes_deg = np.degrees(mesh.slopes[mesh.preceding[1:]])
    figure = new_figure(4.6)
    axes = figure.subplots()
    size = _marker_size(len(plane.scores))
    # Steep slopes last: they are few, and those are the ones to see.
    order = np.argsort(np.abs(slopes_deg), kind="stable")
    states = axes.scatter(
        *plane.scores[order, :2].T, s=size, c=slopes_deg[order], cmap=SLOPES,
        norm=slope_norm(slopes_deg), linewidths=0,
    )  # fmt: skip
    _label_plane(axes, plane)
    _mark_start(axes, plane)
    figure.colorbar(states, ax=axes, label="slope before the state, degrees", pad=0.02)
    return Picture(
        f"Reachable states of {name}",
        f"The {len(plane.scores)} states of the mesh of {name} (d_thr {mesh.threshold:g}, "
        f"{len(mesh.slopes)} slopes) on their principal plane. {_variance_text(plane)}",
        png(figure),
    )


def mesh_distribution(
    mesh: Mesh,
    found: Metastability,
    mu_s: float,
    sigma_s: float,
    name: str,
    correlation: float = 0.0,
) -> Picture:
    """Draw the metastable distribution over the principal plane of a mesh.

    Parameters
    ----------
    mesh : Mesh
        The mesh.
    found : Metastability
        Of that mesh for slopes of mean ``mu_s`` and standard deviation ``sigma_s``, rad, and
        ``correlation`` with the one before.
    mu_s, sigma_s : float
        rad, for the caption.
    name : str
        Of the controller.
    correlation : float, optional
        For the caption.
    """
    plane = principal_plane(mesh)
    weights = _distribution(mesh, found)
    figure = new_figure(4.6)
    axes = figure.subplots()
    size = _marker_size(len(plane.scores))
    shown = weights >= _LEAST_WEIGHT
    axes.scatter(*plane.scores[~shown, :2].T, s=0.4 * size, color="#c9cdd3", linewidths=0)
    least = max(weights[shown].min(), _LEAST_WEIGHT)
    norm = LogNorm(least if least < weights.max() else 0.1 * least, weights.max())
    order = np.flatnonzero(shown)[np.argsort(weights[shown], kind="stable")]
    axes.scatter(
        *plane.scores[order, :2].T, s=size * (0.5 + 5.0 * norm(weights[order]) ** 4),
        c=weights[order], cmap=_WEIGHTS, norm=norm, linewidths=0,
    )  # fmt: skip
    _label_plane(axes, plane)
    _mark_start(axes, plane)
    bar = figure.colorbar(ScalarMappable(norm, _WEIGHTS), ax=axes, pad=0.02)
    bar.set_label("chance of the state before a step")
    ordered = np.cumsum(np.sort(weights)[::-1])
    half, most = (int(np.searchsorted(ordered, share)) + 1 for share in (0.5, 0.99))
    return Picture(
        f"Metastable distribution of {name}",
        f"Where {name} is found while it walks on slopes of mean {math.degrees(mu_s):g}° and "
        f"standard deviation {math.degrees(sigma_s):g}°{correlation_text(correlation)} and has not "
        f"fallen for long (MFPT {number(found.mfpt)} steps): "
        f"{_of_states(half, 'half')}, {_of_states(most, '99 %')} of "
        f"the time, of {len(weights)}. Grey: less than {_LEAST_WEIGHT:g}. {_variance_text(plane)}",
        png(figure),
    )


def _distribution(mesh: Mesh, found: Metastability) -> np.ndarray:
    """Distribution over the states but the failure state, shape (n - 1,)."""
    if found.distribution.shape != (len(mesh.states),):
        shape = f"shape ({len(mesh.states)},), as the states of the mesh"
        raise InputError("distribution", found.distribution.shape, shape)
    return found.distribution[1:]


def _of_states(count: int, share: str) -> str:
    return f"in {count} state{'s' if count > 1 else ''} {share}"


def _marker_size(count: int) -> float:
    """Square points: a mesh is to look like a surface, and a small one not like dust."""
    return float(np.clip(14000.0 / count, 1.8, 30.0))


def _label_plane(axes: Axes, plane: Plane) -> None:
    for axis, number_, share, direction in zip(
        (axes.xaxis, axes.yaxis), ("1st", "2nd"), plane.shares, plane.directions, strict=False
    ):
        strongest = np.argsort(-np.abs(direction), kind="stable")[:3]
        terms = "".join(f"{'+' if direction[i] > 0 else '-'}{_NAMES[i]}" for i in strongest)
        meaning = f"\n({share:.1%} of variance; mostly ${terms.removeprefix('+')}$)"
        axis.set_label_text(
            f"{number_} component, standard deviations{meaning if plane.shares.any() else ''}"
        )
    tidy(axes)


def _mark_start(axes: Axes, plane: Plane) -> None:
    axes.plot(*plane.scores[:1, :2].T, "o", color=PAPER, markersize=9, fillstyle="none",
              markeredgewidth=1.8, label="flat limit cycle")  # fmt: skip
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), fontsize=8.5, handletextpad=0.2, frameon=False
    )  # above the axes, where no state is


def _variance_text(plane: Plane) -> str:
    if not plane.shares.any():
        return "All states are one."
    together = np.cumsum(plane.shares)
    enough = int(np.searchsorted(together, 0.99)) + 1
    return (
        f"The plane holds {together[1]:.1%} of the variance of the standardised states, and "
        f"{enough} of 10 components hold 99 %; the paper calls them a quasi-2D manifold."
    )


# Falls ------------------------------------------------------------------------------------------


def falls_by_slope(
    mesh: Mesh, distribution: np.ndarray, ahead: np.ndarray | None = None
) -> np.ndarray:
    """Chance of each way to fall on each slope ahead, from a distribution over the states.

    Parameters
    ----------
    mesh : Mesh
        Outcomes of every state and slope.
    distribution : numpy.ndarray
        Over all states, the failure state counted, shape (n,), sum 1.
    ahead : numpy.ndarray, optional
        Probabilities of the slopes ahead of each state but the failure state, shape (n - 1, m),
        where they depend on it.

    Returns
    -------
    numpy.ndarray
        Shape (11, m), by `Outcome` and slope; row 0 is the chance of no fall, columns sum to 1.
    """
    weights = np.asarray(distribution)[1:]
    if ahead is None:
        return np.stack([weights @ (mesh.outcomes[1:] == outcome) for outcome in Outcome])
    joint = weights[:, np.newaxis] * ahead
    chances = [(joint * (mesh.outcomes[1:] == outcome)).sum(axis=0) for outcome in Outcome]
    with np.errstate(invalid="ignore"):  # slopes that never occur
        return np.nan_to_num(np.stack(chances) / joint.sum(axis=0))


def falls_by_slope_before(
    mesh: Mesh, distribution: np.ndarray, probabilities: np.ndarray
) -> np.ndarray:
    """Chance that a step comes after each slope and ends in each way to fall.

    Parameters
    ----------
    mesh : Mesh
        Outcomes of every state and slope, and the slope that precedes each state.
    distribution : numpy.ndarray
        Over all states, the failure state counted, shape (n,), sum 1.
    probabilities : numpy.ndarray
        Of the slopes ahead, shape (m,), or of each state but the failure state, shape (n - 1, m).

    Returns
    -------
    numpy.ndarray
        Shape (10, m), by way to fall and slope before; the sum is the chance of a fall.
    """
    weights, preceding = np.asarray(distribution)[1:], mesh.preceding[1:]
    return np.stack(
        [
            np.bincount(
                preceding,
                weights * ((mesh.outcomes[1:] == outcome) * probabilities).sum(axis=1),
                len(mesh.slopes),
            )
            for outcome in _FALLS
        ]
    )


def where_it_falls(
    mesh: Mesh,
    found: Metastability,
    mu_s: float,
    sigma_s: float,
    name: str,
    correlation: float = 0.0,
) -> Picture:
    """Draw on which slopes and why a controller falls; arguments as of `mesh_distribution`.

    From above: chance of a fall on the slope ahead; ways to fall there; share of way and slope
    ahead in all falls; share of way and slope before in all falls.
    """
    weights, ahead = _distribution(mesh, found), None
    of_each = probabilities = slope_probabilities(mesh.slopes, mu_s, sigma_s)
    if correlation != 0.0:
        rows = conditional_probabilities(mesh.slopes, mu_s, sigma_s, correlation)
        of_each = ahead = rows[mesh.preceding[1:]]
        probabilities = weights @ ahead
    chances = falls_by_slope(mesh, found.distribution, ahead)[1:]
    slopes_deg, edges = np.degrees(mesh.slopes), _edges(np.degrees(mesh.slopes))
    fall = chances.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ways = np.where(fall > 0.0, chances / fall, 0.0)
    share = _shares(chances * probabilities)
    before = _shares(falls_by_slope_before(mesh, found.distribution, of_each))

    figure = new_figure(7.6)
    top, middle, ahead, behind = figure.subplots(4, 1, sharex=True)
    possible = fall > 0.0
    top.stairs(np.where(possible, fall, np.nan), edges, color=BODY, linewidth=1.6, baseline=None)
    top.set_yscale("log")
    # One power of ten at least, and where falls are very rare not more than twenty.
    least = fall[possible].min() if possible.any() else 1.0
    top.set_ylim(np.clip(0.5 * least, 1e-20, 0.07), 1.6)
    top.yaxis.set_minor_formatter(NullFormatter())
    top.set_ylabel("chance")
    top.set_title("chance of a fall on the slope ahead", fontsize=10, loc="left")
    _stack(middle, edges, ways)
    middle.set_ylim(0.0, 1.0)
    middle.yaxis.set_major_formatter(_PERCENT)
    middle.set_ylabel("share of falls\non that slope")
    middle.set_title("how it then falls", fontsize=10, loc="left")
    for axes, values, where in ((ahead, share, "ahead"), (behind, before, "before the step")):
        _stack(axes, edges, values)
        most = values.sum(axis=0).max()
        axes.set_ylim(0.0, 1.08 * most if most > 0.0 else 1.0)
        axes.yaxis.set_major_formatter(_PERCENT)
        axes.set_ylabel("share of\nall falls")
        axes.set_title(f"all falls over the slope {where}", fontsize=10, loc="left")
    behind.set_xlabel("slope, degrees (negative is downhill)")
    for axes in (top, middle, ahead, behind):
        tidy(axes)
    # Beyond, every step is a fall, and no slope occurs.
    occurs = share.sum(axis=0) + before.sum(axis=0) > 1e-4
    matters = np.flatnonzero((fall < 0.999) | occurs)
    if matters.size:
        first, last = edges[matters[0]], edges[matters[-1] + 1]
        margin = 0.15 * (last - first)
        top.set_xlim(max(edges[0], first - margin), min(edges[-1], last + margin))
    visible = np.maximum(ways.max(axis=1), before.sum(axis=1)) > 0.01
    seen = [outcome for outcome, shown in zip(_FALLS, visible, strict=True) if shown]
    legend_below(
        figure,
        [Patch(color=OUTCOME_COLOURS[outcome]) for outcome in seen],
        [outcome.label for outcome in seen],
    )
    return Picture(
        f"Where and why {name} falls",
        _falls_text(name, slopes_deg, share, found, mu_s, sigma_s, correlation),
        png(figure),
    )


def _edges(slopes_deg: np.ndarray) -> np.ndarray:
    """Edges between slopes, shape (m + 1,)."""
    if len(slopes_deg) == 1:
        return slopes_deg[0] + np.array([-0.5, 0.5])
    inner = 0.5 * (slopes_deg[1:] + slopes_deg[:-1])
    first, last = 2.0 * slopes_deg[0] - inner[0], 2.0 * slopes_deg[-1] - inner[-1]
    return np.concatenate([[first], inner, [last]])


def _stack(axes: Axes, edges: np.ndarray, values: np.ndarray) -> None:
    """Draw rows of values, one for each way to fall, on top of each other."""
    below = np.zeros(values.shape[1])
    for outcome, row in zip(_FALLS, values, strict=True):
        if row.any():
            axes.stairs(
                below + row, edges, baseline=below, fill=True, color=OUTCOME_COLOURS[outcome],
                label=outcome.label,
            )  # fmt: skip
            below = below + row


def _shares(values: np.ndarray) -> np.ndarray:
    """Values that are not negative, scaled to sum 1; all 0 if they are."""
    total = values.sum()
    return values / total if total > 0.0 else values


def _falls_text(
    name: str,
    slopes_deg: np.ndarray,
    share: np.ndarray,
    found: Metastability,
    mu_s: float,
    sigma_s: float,
    correlation: float,
) -> str:
    text = (
        f"{name} on slopes of mean {math.degrees(mu_s):g}° and standard deviation "
        f"{math.degrees(sigma_s):g}°{correlation_text(correlation)}, when it has not fallen for "
        f"long (MFPT {number(found.mfpt)} steps). From above: the chance that the next step is a "
        "fall, over the slope ahead; how "
        "it then falls; how much of all falls happens over the slopes ahead, and over those "
        "before the step."
    )
    if not share.any():
        return f"{text} It cannot fall on any slope that occurs."
    by_way = share.sum(axis=1)
    ways = [
        f"{_FALLS[i].label} {by_way[i]:.1%}"
        for i in np.argsort(-by_way, kind="stable")
        if by_way[i] >= 0.0005
    ]
    middle = slopes_deg[np.searchsorted(np.cumsum(share.sum(axis=0)), 0.5)]
    return (
        f"{text} All falls: {', '.join(ways)}; half of them on slopes ahead of up to {middle:g}°."
    )
