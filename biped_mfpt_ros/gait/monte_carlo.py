"""Walks on random slopes until the fall, to check the Markov chain against."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait import step
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.ground import slopes_ahead, to_joint
from biped_mfpt_ros.gait.scratch import AHEAD, OUTCOME, VARIABLES, empty_scratch
from biped_mfpt_ros.gait.swing import advance, begin
from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.lanes import LANES
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import WalkerModel
from biped_mfpt_ros.walker.terrain import SLOPE_LIMIT, check_distribution, deviations

_BLOCK_WALKS = 64  # walks in a job: some ten milliseconds of work
_STEP = int(Outcome.STEP)


@kernel
def _walk(scheme, rob, par, states, previous, slopes, steps, outcomes):
    """Walk on from every state over its row of slopes, until a fall or the end of the row.

    Updates ``states`` and ``previous`` in place, adds the steps taken (that of the fall counted) to
    ``steps`` and puts the last outcome into ``outcomes``.
    """
    walks, length = slopes.shape
    w, v = empty_scratch(), np.zeros((VARIABLES, LANES))
    ahead = np.zeros((LANES, AHEAD, 1 + LANES))
    active = np.zeros(LANES, np.bool_)
    of, taken = np.full(LANES, -1), np.zeros(LANES, np.int64)
    trace = np.zeros((0, 0))
    started = 0
    while True:
        for lane in range(LANES):
            if active[lane]:
                continue
            n = of[lane]
            if n >= 0:
                k = taken[lane]
                steps[n] += 1
                outcomes[n] = int(ahead[lane, OUTCOME, 0])
                if outcomes[n] == _STEP:
                    previous[n] = slopes[n, k]
                    to_joint(ahead[lane], 0, states[n])
                    taken[lane] += 1
                if outcomes[n] != _STEP or taken[lane] == length:
                    n = -1
            if n < 0 and started < walks:
                n, taken[lane] = started, 0
                started += 1
            of[lane] = n
            if n >= 0:
                slopes_ahead(slopes[n, taken[lane] : taken[lane] + 1], ahead[lane])
                begin(
                    scheme,
                    rob,
                    par,
                    w,
                    v,
                    lane,
                    states[n],
                    previous[n],
                    ahead[lane],
                )
                active[lane] = True
        if not active.any():
            return
        advance(scheme, rob, par, w, v, active, ahead, trace)


@dataclass(frozen=True)
class MonteCarlo:
    """Steps to the fall of many walks on random slopes.

    Attributes
    ----------
    steps : numpy.ndarray
        Steps of each walk, that of the fall counted, int64, shape (walks,).
    outcomes : numpy.ndarray
        `Outcome` code of the fall of each walk, STEP where it was stopped first, uint8.
    """

    steps: np.ndarray
    outcomes: np.ndarray

    @property
    def counted(self) -> np.ndarray:
        """Steps after the first, of the walks that took more than one: as Table 2 counts."""
        return self.steps[self.steps > 1] - 1

    @property
    def falls(self) -> int:
        """Falls among the counted walks."""
        return int(((self.outcomes != _STEP) & (self.steps > 1)).sum())

    @property
    def mean_steps(self) -> float:
        """Mean number of steps to the fall, the first step dropped.

        Where walks were stopped before they fell: all counted steps over all falls, the maximum
        likelihood for a constant chance of falling. inf without a fall, nan without counted walks.
        """
        if self.falls:
            return float(self.counted.sum() / self.falls)
        return math.inf if self.counted.size else math.nan

    @property
    def standard_error(self) -> float:
        """Standard error of ``mean_steps``; nan for less than two falls."""
        if self.falls < 2:
            return math.nan
        if self.falls < self.counted.size:
            return self.mean_steps / math.sqrt(self.falls)
        return float(self.counted.std(ddof=1) / math.sqrt(self.counted.size))

    @property
    def confidence_interval(self) -> tuple[float, float]:
        """95 % confidence interval of ``mean_steps``, by the normal approximation."""
        half = 1.959964 * self.standard_error
        return self.mean_steps - half, self.mean_steps + half

    @property
    def failure_shares(self) -> dict[Outcome, float]:
        """Share of each outcome in the falls of the counted walks."""
        fallen = self.outcomes[(self.outcomes != _STEP) & (self.steps > 1)]
        codes, counts = np.unique(fallen, return_counts=True)
        shares = counts / counts.sum()
        return {Outcome(int(c)): float(s) for c, s in zip(codes, shares, strict=True)}


def monte_carlo(
    controller: Controller,
    sigma_s: float,
    walks: int,
    seed: int,
    *,
    mu_s: float = 0.0,
    correlation: float = 0.0,
    model: WalkerModel | None = None,
    state: ArrayLike | None = None,
    max_steps: int = 10_000,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> MonteCarlo:
    """Walk on slopes drawn from a normal distribution until the fall.

    Each walk has a random generator of its own, seeded by ``(seed, number of the walk)``: the
    result depends neither on the number of threads nor on that of the walks.

    Parameters
    ----------
    controller : Controller
        What walks.
    sigma_s : float
        rad, standard deviation of the slope, > 0.
    walks : int
        How many walks, >= 1.
    seed : int
        Of all walks, >= 0.
    mu_s : float, optional
        rad, mean slope.
    correlation : float, optional
        Of each slope with the one before, above -1 and below 1; see `terrain.deviations`. The
        slope before the first one is that of the flat ground on which the walk starts, 0, also
        where the mean is another: the first slope has the mean (1 - correlation) mu_s. So it is
        in a chain over a mesh, whose first state follows flat ground, too.
    model : WalkerModel, optional
        Torque limit, friction and so on.
    state : array_like, optional
        ``[q, dq]`` after an impact on flat ground, shape (10,), where every walk starts; the limit
        cycle on flat ground by default.
    max_steps : int, optional
        Walks that have not fallen after so many steps are stopped; >= 1.
    threads : int, optional
        >= 1; one per core by default.
    progress : callable, optional
        Called with the walks ended and all walks, now and then.

    Returns
    -------
    MonteCarlo
        Steps and falls. Slopes beyond those that can be simulated (45 degrees) are cut to them,
        which changes nothing in those that follow.

    Raises
    ------
    InputError
        If an argument is out of its range.
    NoLimitCycle
        If no state is given and no limit cycle is found.
    """
    model = model or WalkerModel()
    check_distribution(mu_s, sigma_s, correlation)
    for name, value in (("walks", walks), ("max_steps", max_steps), ("threads", threads)):
        if value is not None and value < 1:
            raise InputError(name, value, ">= 1")
    if seed < 0:
        raise InputError("seed", seed, ">= 0")
    if state is None:
        state = find_limit_cycle(controller, 0.0, model).state
    start = step.check_state(state)

    packed_model, packed_controller = model.packed(), controller.packed(model.robot)
    states = np.tile(start, (walks, 1))
    previous = np.zeros(walks)
    before = previous - mu_s
    steps = np.zeros(walks, dtype=np.int64)
    outcomes = np.zeros(walks, dtype=np.uint8)

    stop = threading.Event()

    def run(block: np.ndarray) -> int:
        randoms = [np.random.Generator(np.random.PCG64([seed, int(n)])) for n in block]
        upright = np.arange(block.size)
        length = 8
        while upright.size and not stop.is_set():
            length = min(length, max_steps - int(steps[block[upright[0]]]))
            if length == 0:
                break
            walkers = block[upright]
            draws = np.array([randoms[n].standard_normal(length) for n in upright])
            off = deviations(draws, before[walkers], sigma_s, correlation)
            before[walkers] = off[:, -1]
            slopes = np.clip(mu_s + off, -SLOPE_LIMIT, SLOPE_LIMIT)
            s, p = states[walkers], previous[walkers]
            k, o = np.zeros(walkers.size, dtype=np.int64), np.zeros(walkers.size, dtype=np.uint8)
            _walk(controller.code, packed_model, packed_controller, s, p, slopes, k, o)
            states[walkers], previous[walkers], outcomes[walkers] = s, p, o
            steps[walkers] += k
            upright = upright[o == _STEP]
            length = min(256, 2 * length)
        return block.size

    blocks = np.split(np.arange(walks), np.arange(_BLOCK_WALKS, walks, _BLOCK_WALKS))
    ended = 0
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        try:
            for size in pool.map(run, blocks):
                ended += size
                if progress is not None:
                    progress(ended, walks)
        finally:  # an interrupt does not wait for walks that have not fallen yet
            stop.set()
    return MonteCarlo(steps, outcomes)
