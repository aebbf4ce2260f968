"""The chain of up to a million states, what has to be held for it, and the search for states.

The chains are walkers' in a model that is solved exactly: an offset from the limit cycle, which a
slope pushes and a step contracts, in whole degrees; beyond 30 degrees is a fall. Each of its 61
states is copied, and the copy tells the slopes of the last steps apart, as the states of a mesh do.
States are numbered as they are found. The MFPT is that of the 61 states, for any number of copies;
where slopes are correlated, that of 61 states times 81 slopes before them.
92 % of the transitions do not fall, against 11 % in the mesh of hzd/mfpt: this is the harder case.

The states to search are those of a mesh of hzd/mfpt, made more by random states between neighbours
of the same cluster; what is looked up is made in the same way.
"""

from __future__ import annotations

import math
import os
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
from biped_mfpt_msgs.msg import MeshInfo
from scipy.spatial import cKDTree

from biped_mfpt_ros.bench.measure import SLOPES, BenchError, Section, row, timed
from biped_mfpt_ros.bench.step_map import reached
from biped_mfpt_ros.chain.markov import (
    ChainError,
    Metastability,
    metastabilities,
    metastability,
)
from biped_mfpt_ros.chain.mesh import NOT_SIMULATED, Mesh, grow_mesh
from biped_mfpt_ros.chain.nearest import STATE_SIZE, StateSet
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.gait.step import simulate_steps
from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.nodes import messages
from biped_mfpt_ros.nodes.assembly import MeshAssembly
from biped_mfpt_ros.nodes.messages import MeshSettings
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import WalkerModel

_HALF, _CONTRACTION = 30, 0.85
_REACHED = 0.752  # share of the copies that are found
_WITH_SLOPES = 3_716  # states of a chain in which each knows the slope before it, and no other
_CORRELATION = 0.5
_SIGMAS = np.radians(np.geomspace(1.2, 8.0, 50))  # MFPT from 65 to some 1e38


# Chains -----------------------------------------------------------------------------------------


def small_chain() -> np.ndarray:
    """Targets of the 61 states, uint32, shape (62, 81)."""
    offsets = sorted(range(-_HALF, _HALF + 1), key=abs)
    number = {offset: i for i, offset in enumerate(offsets, start=1)}
    rows = [
        [number.get(round(_CONTRACTION * o + math.degrees(s)), 0) for s in SLOPES] for o in offsets
    ]
    return np.array([[0] * len(SLOPES), *rows], dtype=np.uint32)


@kernel
def _copied(small, copies, number, queue, targets):
    """Copy k of a state goes to copy (m k + s) mod copies on slope s; returns how many are found.

    They are numbered as they are found; `queue` and `number` are the way from there and back.
    """
    m = small.shape[1]
    # x_2 walks on flat ground, slope m // 2, and comes to itself.
    queue[1] = copies + (copies - 1) // 2
    number[queue[1]] = 1
    found = 2
    i = 1
    while i < found:
        state = queue[i] // copies
        copy = queue[i] % copies
        for s in range(m):
            if small[state, s] != 0:
                to = small[state, s] * copies + (m * copy + s) % copies
                if number[to] == 0:
                    number[to] = found
                    queue[found] = to
                    found += 1
                targets[i, s] = number[to]
        i += 1
    return found


def chain_mesh(states: int) -> Mesh:
    """A mesh with a chain of about so many states; where the states are is of no account."""
    small = small_chain()
    m = small.shape[1]
    # Odd multiples of m, or one: of other numbers some take thousands of steps to forget the copy.
    pieces = round(states / _REACHED / (len(small) - 1) / m)
    copies = (pieces | 1) * m if pieces else 1
    most = len(small) * copies
    targets = np.zeros((most, m), dtype=np.uint32)
    number, queue = np.zeros(most, dtype=np.uint32), np.empty(most, dtype=np.int64)
    n = _copied(small, copies, number, queue, targets)
    # Copy m k + s comes after slope s, also modulo a multiple of m.
    preceding = (queue[:n] % copies % m).astype(np.uint32)
    outcomes = np.where(targets[:n] == 0, Outcome.SWING_SCUFFS, Outcome.STEP).astype(np.uint8)
    outcomes[0] = NOT_SIMULATED
    return Mesh(
        slopes=SLOPES,
        states=np.zeros((n, STATE_SIZE)),
        preceding=preceding,
        generation=np.zeros(n, np.uint32),
        targets=targets[:n].copy(),
        outcomes=outcomes,
        scales=np.ones(STATE_SIZE),
        threshold=1.0,
        clustered=True,
    )


def _solved(
    mesh: Mesh, sigmas: np.ndarray, threads: int | None = None, correlation: float = 0.0
) -> list[Metastability]:
    out = []
    found = metastabilities(mesh, 0.0, sigmas, threads=threads, correlation=correlation)
    for sigma, result in zip(sigmas, found, strict=True):
        if isinstance(result, ChainError):
            raise BenchError(f"chain of {len(mesh.states)} states, sigma_s {sigma:g} rad: {result}")
        out.append(result)
    return out


def check_chain(found: list[Metastability], sigmas: np.ndarray, correlation: float = 0.0) -> float:
    """Largest relative error against the small chain; more than 1e-8 is an error."""
    small = chain_mesh(_WITH_SLOPES if correlation else 1)
    error = 0.0
    for sigma, result in zip(sigmas, found, strict=True):
        exact = metastability(small, 0.0, sigma, correlation).mfpt
        error = max(error, abs(result.mfpt / exact - 1.0))
    if not error <= 1e-8:
        raise BenchError(f"chain of {len(found[0].distribution)} states: error {error:g}")
    return error


def _resident(field: str) -> int:
    """Bytes that this process holds (VmRSS) or held at most (VmHWM), from the kernel."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return int(line.split()[1]) * 1024
    raise BenchError(f"/proc/self/status says nothing of {field}")


def peak_of(work: Callable[[], object]) -> int:
    """Most bytes of memory that some work took, beyond what was held before."""
    Path("/proc/self/clear_refs").write_text("5")  # VmHWM begins anew
    before = _resident("VmRSS")
    work()
    return max(0, _resident("VmHWM") - before)


def chain(states: int, sigmas: np.ndarray, section: Section) -> None:
    """All sigmas on one chain: time, processor time, memory, and error."""
    mesh = chain_mesh(states)
    n = len(mesh.states)
    _solved(chain_mesh(100), sigmas[:2])  # compiled
    found: list[Metastability] = []
    start, used = time.perf_counter(), time.process_time()
    peak = peak_of(lambda: found.extend(_solved(mesh, sigmas)))
    seconds, used = time.perf_counter() - start, time.process_time() - used
    name = f"chain of {n} states x {len(SLOPES)} slopes x {len(sigmas)} sigma_s"
    section.rows.append(row(name, np.array([seconds]), 1, "s"))
    section.facts[f"{name}: processor seconds, of {os.cpu_count()} cores"] = round(used, 2)
    section.facts[f"{name}: largest relative error"] = check_chain(found, sigmas)
    held = mesh.targets.nbytes + mesh.outcomes.nbytes + mesh.states.nbytes
    section.facts[f"{name}: peak memory with the mesh, GiB"] = round((peak + held) / 2**30, 3)
    section.facts[f"{name}: MFPT"] = [f"{found[i].mfpt:.2g}" for i in (0, -1)]
    alone = _solved(mesh, sigmas[:1], threads=1)[0]
    if (alone.mfpt, alone.distribution.tobytes()) != (
        found[0].mfpt,
        found[0].distribution.tobytes(),
    ):
        raise BenchError(f"chain of {n} states: other bits alone than among {len(sigmas)}")


def correlated(states: int, sigmas: np.ndarray, repetitions: int, section: Section) -> None:
    """Some sigmas on one chain in one thread, with correlated slopes and with independent ones."""
    mesh = chain_mesh(states)
    n = len(mesh.states)
    seconds = {}
    for correlation in (0.0, _CORRELATION):

        def solve(correlation: float = correlation) -> list[Metastability]:
            return _solved(mesh, sigmas, 1, correlation)

        error = check_chain(solve(), sigmas, correlation)
        seconds[correlation] = timed(solve, repetitions, time.thread_time)
        name = f"chain of {n} states, {len(sigmas)} sigma_s, correlation {correlation:g}"
        section.rows.append(row(name, seconds[correlation], 1, "s"))
        section.facts[f"{name}: largest relative error"] = error
    medians = {rho: float(np.median(values)) for rho, values in seconds.items()}
    section.ratios[f"correlated_over_independent_{n}"] = medians[_CORRELATION] / medians[0.0]


def assembly(states: int, section: Section) -> None:
    """Peak memory when a mesh is put together from messages, relative to the mesh."""
    mesh = chain_mesh(states)
    n = len(mesh.states)
    settings = messages.settings_message(
        MeshSettings(controller("hzd/base"), WalkerModel(), SLOPES, 1.0)
    )
    put_together: list[Mesh] = []

    def work() -> None:
        whole = MeshAssembly("m")
        whole.add_info(MeshInfo(mesh_id="m", settings=settings))
        for message in messages.states_messages("m", 0, 1, mesh.states[1:], mesh.preceding[1:]):
            whole.add_states(message)
        for message in messages.transitions_messages("m", mesh.targets, mesh.outcomes):
            whole.add_transitions(message)
        scales = messages.packed(mesh.scales, "d")
        closing = MeshInfo(
            mesh_id="m", settings=settings, status=MeshInfo.COMPLETE, states=n, scales=scales
        )
        whole.add_info(closing)
        put_together.append(whole.mesh())

    peak = peak_of(work)
    if not np.array_equal(put_together[0].targets, mesh.targets):
        raise BenchError("a mesh put together from its messages is another one")
    held = sum(a.nbytes for a in (mesh.targets, mesh.outcomes, mesh.states)) + 8 * n
    section.facts[f"mesh of {n} states from messages: peak memory over that of the mesh"] = round(
        peak / held, 3
    )


# Search -----------------------------------------------------------------------------------------


def refined(mesh: Mesh, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """States between neighbours of a cluster, shape (count, 10), and their clusters."""
    rng = np.random.default_rng(seed)
    near = np.zeros((len(mesh.states), 4), dtype=np.int64)
    for cluster in np.unique(mesh.preceding[1:]):
        own = 1 + np.flatnonzero(mesh.preceding[1:] == cluster)
        scaled = mesh.states[own] / mesh.scales
        _, found = cKDTree(scaled).query(scaled, min(4, len(own)))
        near[own] = own[np.resize(found.reshape(len(own), -1).T, (4, len(own))).T]
    picked = np.sort(rng.integers(1, len(mesh.states), count))  # in the order of the mesh
    weights = rng.dirichlet(np.ones(4), count)
    states = np.einsum("nk,nkd->nd", weights, mesh.states[near[picked]])
    return states, mesh.preceding[picked]


class Trees:
    """scipy's trees, one for each cluster, over the standardised states."""

    def __init__(self, states: np.ndarray, clusters: np.ndarray, scales: np.ndarray) -> None:
        self._scales = scales
        self._of = {c: np.flatnonzero(clusters == c) for c in np.unique(clusters)}
        self._trees = {c: cKDTree(states[of] / scales) for c, of in self._of.items()}

    def nearest(self, candidates: np.ndarray, clusters: np.ndarray) -> np.ndarray:
        """Position of the nearest state of each candidate's cluster."""
        out = np.empty(len(candidates), dtype=np.int64)
        for c, tree in self._trees.items():
            own = np.flatnonzero(clusters == c)
            out[own] = self._of[c][tree.query(candidates[own] / self._scales)[1]]
        return out


def search(
    mesh: Mesh, states: int, looked_up: int, repetitions: int, section: Section
) -> dict[str, float]:
    """Our search beside scipy's trees, on the same states."""
    scales = mesh.scales
    known, clusters = refined(mesh, states, 1)
    candidates, own = refined(mesh, looked_up, 2)
    found = StateSet(len(SLOPES), states + 1)
    spacing = 0.0  # all are new, as far as they differ
    added, _ = found.extend(known, clusters, scales, spacing)
    known, clusters = known[added], clusters[added]
    trees = Trees(known, clusters, scales)
    ours, theirs = found.nearest(candidates, own, scales) - 1, trees.nearest(candidates, own)

    def distance(index: np.ndarray) -> np.ndarray:
        return (((candidates - known[index]) / scales) ** 2).sum(axis=1)

    # Where two are equally far but for rounding, either may be taken.
    if not np.allclose(distance(ours), distance(theirs), rtol=1e-9, atol=0.0):
        raise BenchError(f"search among {states} states: not the nearest")
    threshold = 4.0 * float(np.median(distance(ours)))  # most are known, as of a mesh's successors
    seconds = {
        "nearest": timed(lambda: found.nearest(candidates, own, scales), repetitions),
        "trees": timed(lambda: trees.nearest(candidates, own), repetitions),
        "known": timed(lambda: found.extend(candidates, own, scales, 1e3 * threshold), repetitions),
    }

    def grown() -> None:
        StateSet(len(SLOPES), states + 1).extend(known, clusters, scales, spacing)

    def built() -> None:
        Trees(known, clusters, scales)

    seconds["grown"] = timed(grown, max(1, repetitions // 3))
    seconds["built"] = timed(built, max(1, repetitions // 3))
    n = len(known)
    section.rows.extend(
        [
            row(f"{n} states: nearest, a candidate", seconds["nearest"], looked_up, "us"),
            row(f"{n} states: nearest by scipy, a candidate", seconds["trees"], looked_up, "us"),
            row(f"{n} states: test of a known candidate", seconds["known"], looked_up, "us"),
            row(f"{n} states: test and addition of a new one", seconds["grown"], n, "us"),
            row(f"{n} states: scipy's trees built once, a state", seconds["built"], n, "us"),
        ]
    )
    # Counted by allocation: what the process holds does not show memory that is used again.
    tracemalloc.start()
    try:
        grown()
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    section.facts[f"{n} states: peak memory of the set, bytes a state"] = round(peak / n)
    medians = {name: float(np.median(values)) for name, values in seconds.items()}
    section.ratios[f"scipy_over_nearest_{states}"] = medians["trees"] / medians["nearest"]
    return medians


def run(short: bool) -> Section:
    """Time chain and search, after checking them."""
    section = Section()
    for states in (2_000,) if short else (10_000, 100_000, 1_000_000):
        chain(states, _SIGMAS[:: 10 if short else 1], section)
    correlated(10_000 if short else 100_000, _SIGMAS[:8], 3 if short else 5, section)
    assembly(2_000 if short else 1_000_000, section)
    small = chain_mesh(1)
    seconds = timed(lambda: _solved(small, _SIGMAS[:1]), 20 if short else 200)
    section.rows.append(row(f"chain of {len(small.states)} states, one sigma_s", seconds, 1, "ms"))
    walking = controller("hzd/mfpt")
    mesh = grow_mesh(
        lambda states, previous: simulate_steps(walking, states, previous, SLOPES),
        reached(walking)[0],
        SLOPES,
        0.03 if short else 0.002,
    )
    for states in (1_000,) if short else (1_000, 100_000, 1_000_000):
        search(mesh, states, 1_000 if short else 100_000, 3 if short else 5, section)
    return section
