"""What the paper leaves unsaid, fitted to the numbers that it prints.

The paper states neither torque limit nor friction, nor whether a slip of a millisecond is a fall,
nor in which frame friction is judged at impact, nor when r_i of eq. (25) is refreshed. A *reading*
is one choice of these five. It is judged by the twelve numbers of Tables 2 and 4, six from Monte
Carlo and six from the chain of a coarse mesh, and by what the paper claims of flat ground and of
constant slopes, which a reading has to fulfil.

A controller's numbers depend on its own reading only. So each controller is walked under every
reading once, and readings shared by several controllers are judged by sums.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from biped_mfpt_ros.chain.markov import ChainError, metastability
from biped_mfpt_ros.chain.mesh import SCALE_REFRESHES, MeshLimitError, grow_mesh
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.gait.cycle import NoLimitCycle, find_limit_cycle
from biped_mfpt_ros.gait.monte_carlo import monte_carlo
from biped_mfpt_ros.gait.step import simulate_steps
from biped_mfpt_ros.report import paper
from biped_mfpt_ros.study.plan import PAPER_MESH, TABLE_SIGMA_DEG, Job, scheme_of
from biped_mfpt_ros.study.work import steps_on
from biped_mfpt_ros.walker.robot import WalkerModel
from biped_mfpt_ros.walker.terrain import slope_set

MODEL_PARAMETERS = ("torque_limit", "friction", "slip_duration", "friction_frame")
PARAMETERS = (*MODEL_PARAMETERS, "scale_refresh")
"""What the paper leaves open: four fields of `WalkerModel`, one argument of `grow_mesh`."""

_CONTINUOUS = 3  # of them: torque_limit, friction, slip_duration
_PAPER_WALKS = 10_000
_MOST_STEPS = 2000  # of a walk
_MOST_STATES = 20_000
_SEVERAL = 10  # steps: what "several" may mean at most
# Meshes this much coarser or finer are as legitimate as the paper's: how far their estimates
# scatter is what its chain numbers can be trusted to. It optimised with d_s = sigma_s / 2 at a
# smaller sigma_s than that of its tables, and does not say whether it meshed again for them.
_THRESHOLD_FACTORS = (0.8, 1.0, 1.25)
_SLOPE_STEP_FACTORS = (1, 2)


# One controller under one reading ---------------------------------------------------------------


def reading_job(name: str, model: WalkerModel, walks: int, seed: int) -> Job:
    """Job that walks and meshes a controller under one reading, for both values of r_i's."""
    d_s, d_thr = PAPER_MESH[scheme_of(name)]
    settings = {
        "sigma_deg": TABLE_SIGMA_DEG[scheme_of(name)],
        "walks": walks,
        "seed": seed,
        "slope_step_deg": d_s,
        "threshold": d_thr,
    }
    return Job("reading", name, settings, model=model)


def scatter_job(name: str, model: WalkerModel) -> Job:
    """Job that grows meshes about as coarse as the paper's."""
    d_s, d_thr = PAPER_MESH[scheme_of(name)]
    settings = {
        "sigma_deg": TABLE_SIGMA_DEG[scheme_of(name)],
        "slope_steps_deg": [factor * d_s for factor in _SLOPE_STEP_FACTORS],
        "thresholds": [factor * d_thr for factor in _THRESHOLD_FACTORS],
    }
    return Job("scatter", name, settings, model=model)


def reading(job: Job) -> dict[str, Any]:
    """Result of a `reading_job`, on one core.

    Returns
    -------
    dict
        ``failed``: the claim of the paper that does not hold, empty if all do, and nothing else but
        ``seconds``, of this core, if one does not. ``walks``, ``mean_steps`` and
        ``standard_error`` of Monte Carlo. ``chain``: the estimate of eq. (34) by `SCALE_REFRESHES`,
        None where there is none.
    """
    start = time.process_time()
    model, settings = job.model, job.settings
    assert model is not None
    try:
        cycle = find_limit_cycle(controller(job.controller), 0.0, model)
    except NoLimitCycle:
        return {"failed": "no gait on flat ground", "seconds": time.process_time() - start}
    failed = _failed_claim(job.controller, model, cycle.state.tolist(), cycle.stable)
    if failed:
        return {"failed": failed, "seconds": time.process_time() - start}
    walked = monte_carlo(
        controller(job.controller),
        math.radians(settings["sigma_deg"]),
        settings["walks"],
        settings["seed"],
        model=model,
        state=cycle.state,
        max_steps=_MOST_STEPS,
        threads=1,
    )
    chain = {
        refresh: _chain(
            job, model, cycle.state, settings["slope_step_deg"], settings["threshold"], refresh
        )
        for refresh in SCALE_REFRESHES
    }
    return {
        "failed": "",
        "walks": settings["walks"],
        "mean_steps": walked.mean_steps,
        "standard_error": walked.standard_error,
        "chain": chain,
        "seconds": time.process_time() - start,
    }


def _failed_claim(name: str, model: WalkerModel, state: list[float], stable: bool) -> str:
    """The claim of the paper that does not hold; empty if all do."""
    if not stable:
        return "no stable gait on flat ground"
    if name != "hzd/base":
        return ""
    if steps_on(False, -1.0, model, state, _SEVERAL + 1, 1.0)["fell"] is None:
        return "walks down 1 degree"
    if steps_on(True, 0.0, model, state, 100, 1.0)["fell"] is not None:
        return "does not walk on flat ground with torques off late"
    if steps_on(True, -9.0, model, state, 100, 1.0)["fell"] is not None:
        return "does not walk down 9 degrees with torques off late"
    return ""


def scatter(job: Job) -> dict[str, Any]:
    """Result of a `scatter_job`: standard deviation of ln MFPT over the meshes, and the MFPTs."""
    model = job.model
    assert model is not None
    try:
        state = find_limit_cycle(controller(job.controller), 0.0, model).state
    except NoLimitCycle:
        return {"scatter": None, "mfpt": []}
    meshes = itertools.product(
        job.settings["slope_steps_deg"], job.settings["thresholds"], SCALE_REFRESHES
    )
    found = [_chain(job, model, state, *mesh) for mesh in meshes]
    logs = [math.log(value) for value in found if value is not None]
    return {"scatter": float(np.std(logs, ddof=1)) if len(logs) > 1 else None, "mfpt": found}


def _chain(
    job: Job,
    model: WalkerModel,
    state: np.ndarray,
    slope_step_deg: float,
    threshold: float,
    refresh: str,
) -> float | None:
    """Estimate of eq. (34) on one mesh; None if there is none."""
    control, slopes = controller(job.controller), slope_set(slope_step_deg)
    try:
        mesh = grow_mesh(
            lambda states, previous: simulate_steps(
                control, states, previous, slopes, model, measures=False
            ),
            state,
            slopes,
            threshold,
            scale_refresh=refresh,
            max_states=_MOST_STATES,
        )
        found = metastability(mesh, 0.0, math.radians(job.settings["sigma_deg"])).mfpt
    except (MeshLimitError, ChainError):
        return None
    return found if math.isfinite(found) else None


# All readings -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Grid:
    """Values of the five open parameters, in the order of `PARAMETERS`.

    Attributes
    ----------
    values : dict of str to tuple
        By parameter.
    tolerance : float
        Of the integrator.
    """

    values: Mapping[str, tuple[Any, ...]]
    tolerance: float

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values of each parameter."""
        return tuple(len(self.values[name]) for name in PARAMETERS)

    def models(self) -> Iterator[tuple[tuple[int, ...], WalkerModel]]:
        """Every combination of what the step map depends on: its indices, and the model."""
        for index in np.ndindex(*self.shape[: len(MODEL_PARAMETERS)]):
            settings = {
                name: self.values[name][i] for name, i in zip(MODEL_PARAMETERS, index, strict=True)
            }
            yield index, WalkerModel(**settings, tolerance=self.tolerance)

    def reading(self, index: Sequence[int]) -> dict[str, Any]:
        """The reading at five indices."""
        return {name: self.values[name][i] for name, i in zip(PARAMETERS, index, strict=True)}


class Judged:
    """What a controller's numbers say of every reading.

    Parameters
    ----------
    name : str
        The controller.
    grid : Grid
    results : mapping
        Result of the `reading_job` of each of `Grid.models`, by its indices.
    scatter : float or None
        Standard deviation of ln MFPT over meshes as coarse as the paper's.

    Attributes
    ----------
    residuals : numpy.ndarray
        ``ln(ours / paper)`` of Monte Carlo and of the chain, shape ``(*grid.shape, 2)``; nan under
        readings with which a claim of the paper does not hold.
    errors : numpy.ndarray
        What a residual may be by chance, same shape: for Monte Carlo the standard errors of our
        mean and of the paper's, for the chain the scatter of coarse meshes.
    failed : dict of str to int
        How many of the models break which claim.
    """

    def __init__(
        self,
        name: str,
        grid: Grid,
        results: Mapping[tuple[int, ...], dict[str, Any]],
        scatter: float | None,
    ) -> None:
        self.name = name
        sigma = TABLE_SIGMA_DEG[scheme_of(name)]
        theirs = paper.monte_carlo(name, 0.0, sigma), paper.mfpt(name, 0.0, sigma)
        assert theirs[0] is not None
        assert theirs[1] is not None
        self.residuals = np.full((*grid.shape, 2), np.nan)
        self.errors = np.full((*grid.shape, 2), np.nan)
        self.failed: dict[str, int] = {}
        for index, result in results.items():
            if result["failed"]:
                self.failed[result["failed"]] = self.failed.get(result["failed"], 0) + 1
                continue
            mean, error = float(result["mean_steps"]), result["standard_error"]
            if not (error and mean > 0.0):
                self.failed["no walks"] = self.failed.get("no walks", 0) + 1
                continue
            # Means of as many walks as the paper's would err by this.
            paper_error = error * math.sqrt(result["walks"] / _PAPER_WALKS)
            self.residuals[index][..., 0] = math.log(mean / theirs[0])
            self.errors[index][..., 0] = math.hypot(error, paper_error) / mean
            for i, refresh in enumerate(grid.values["scale_refresh"]):
                chain = result["chain"][refresh]
                if chain is not None:
                    self.residuals[index][i, 1] = math.log(chain / theirs[1])
            self.errors[index][..., 1] = scatter or 0.1

    @property
    def chi_squared(self) -> np.ndarray:
        """Sum of the squared residuals over their errors, shape ``grid.shape``; inf where nan."""
        total = ((self.residuals / self.errors) ** 2).sum(axis=-1)
        return np.where(np.isnan(total), np.inf, total)


@dataclass(frozen=True)
class Sharing:
    """Which controllers have which parameters in common.

    Attributes
    ----------
    title : str
    groups : tuple of tuple of str
        Controllers that have one reading.
    common : tuple of str
        Parameters that all groups have in common nevertheless.
    """

    title: str
    groups: tuple[tuple[str, ...], ...]
    common: tuple[str, ...] = ()


def sharings(names: Sequence[str]) -> list[Sharing]:
    """From one reading for all to one for each controller."""
    schemes = tuple(
        tuple(n for n in names if scheme_of(n) == scheme)
        for scheme in dict.fromkeys(map(scheme_of, names))
    )
    alone = tuple((n,) for n in names)
    rest = tuple(p for p in PARAMETERS if p != "torque_limit")
    found = [
        Sharing("one reading for all", (tuple(names),)),
        Sharing("one reading for each scheme", schemes),
        Sharing("one reading for all but the torque limit", alone, rest),
        Sharing("one reading for each controller", alone),
    ]
    # Of few controllers some are the same.
    return list({(s.groups, len(s.groups) > 1 and s.common): s for s in found[::-1]}.values())[::-1]


@dataclass(frozen=True)
class Fit:
    """The best readings of a sharing, and how well they are determined.

    Attributes
    ----------
    sharing : Sharing
    chi_squared : float
        Of all numbers; inf if no reading fulfils all claims.
    numbers, free : int
        Numbers fitted, and continuous parameters that were fitted to them.
    readings : dict of str to dict
        The reading of each controller; empty if there is none.
    residuals : dict of str to tuple of float
        ``ln(ours / paper)`` of Monte Carlo and chain under it.
    profiles : list of (str, tuple of str, list of (value, float))
        Parameter, controllers that have it in common, and the least chi squared with the parameter
        at each value while all others are free.
    """

    sharing: Sharing
    chi_squared: float
    numbers: int
    free: int
    readings: Mapping[str, dict[str, Any]]
    residuals: Mapping[str, tuple[float, float]]
    profiles: Sequence[tuple[str, tuple[str, ...], list[tuple[Any, float]]]]

    @property
    def scale(self) -> float:
        """Chi squared for each degree of freedom, or 1 if that is less.

        1 means that the numbers come out as well as noise allows. Where it is more, no reading of
        these parameters is the whole truth, and errors are widened by its root, as is usual.
        """
        return max(1.0, self.chi_squared / max(1, self.numbers - self.free))

    @property
    def typical(self) -> float:
        """Root mean square of the residuals of Monte Carlo."""
        walks = [r[0] for r in self.residuals.values()]
        return math.sqrt(sum(r * r for r in walks) / len(walks)) if walks else math.inf

    def as_good(self, profile: Sequence[tuple[Any, float]]) -> list[Any]:
        """Values of a profile that are as good as the best within one widened standard error."""
        return [value for value, chi in profile if chi <= self.chi_squared + self.scale]


def fit(judged: Mapping[str, Judged], grid: Grid, sharing: Sharing) -> Fit:
    """Find the best readings of a sharing among all of the grid."""
    axes = {name: i for i, name in enumerate(PARAMETERS)}
    common = tuple(axes[name] for name in sharing.common)
    everyone = tuple(name for group in sharing.groups for name in group)
    own = tuple(i for i in axes.values() if i not in common)
    sums = [np.sum([judged[n].chi_squared for n in group], axis=0) for group in sharing.groups]
    least = [chi.min(axis=own, keepdims=True) for chi in sums]
    total = np.sum(least, axis=0)  # over the common axes; the others have length 1
    best = float(total.min())

    profiles = []
    for name, axis in axes.items():
        with_axis = [(everyone, total)]
        if axis in own:
            rest = tuple(i for i in own if i != axis)
            with_axis = [
                (group, sums[g].min(axis=rest, keepdims=True) + sum(least[:g] + least[g + 1 :]))
                for g, group in enumerate(sharing.groups)
            ]
        for group, chi in with_axis:
            along = chi.min(axis=tuple(i for i in axes.values() if i != axis))
            values = zip(grid.values[name], along.tolist(), strict=True)
            profiles.append((name, group, list(values)))

    readings: dict[str, dict[str, Any]] = {}
    residuals: dict[str, tuple[float, float]] = {}
    if math.isfinite(best):
        at = np.unravel_index(int(total.argmin()), total.shape)
        for group, chi in zip(sharing.groups, sums, strict=True):
            where = tuple(
                slice(int(i), int(i) + 1) if axis in common else slice(None)
                for axis, i in enumerate(at)
            )
            inside = np.unravel_index(int(chi[where].argmin()), chi[where].shape)
            index = tuple(
                int(at[axis]) if axis in common else int(i) for axis, i in enumerate(inside)
            )
            for name in group:
                readings[name] = grid.reading(index)
                mean, chain = judged[name].residuals[index]
                residuals[name] = float(mean), float(chain)
    free = sum(
        (1 if axes[name] in common else len(sharing.groups)) for name in PARAMETERS[:_CONTINUOUS]
        if len(grid.values[name]) > 1
    )  # fmt: skip
    return Fit(sharing, best, 2 * len(judged), free, readings, residuals, profiles)
