"""Simulators and meshers that are killed and stopped while meshes grow: `make soak`.

Meshes of one controller are grown one after the other, and every few tenths of a second something
is done to a process, by chance: a simulator is killed, ended, or stopped for a while, all of them
are killed at once, the mesher is killed. What was killed is started again after a while. Each mesh
must come out as the one that was grown in this process, to the last bit, with every swing counted
once.
"""

from __future__ import annotations

import signal
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from subprocess import Popen

import numpy as np
from biped_mfpt_msgs.action import GrowMesh

from biped_mfpt_ros.bench.nodes import Nodes, end
from biped_mfpt_ros.chain.mesh import Mesh, grow_mesh
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.step import simulate_steps
from biped_mfpt_ros.nodes.messages import MeshSettings
from biped_mfpt_ros.report.progress import Progress
from biped_mfpt_ros.soak.result import PromiseBroken, Row, check
from biped_mfpt_ros.walker.robot import WalkerModel
from biped_mfpt_ros.walker.terrain import slope_set

_SIMULATORS = 3
_MESH_TIMEOUT = 300.0  # s, after which a mesh counts as lost
_RESEND = 3.0  # s: a goal may go to a mesher that was killed and is still on the graph
# How often each is done. What is killed takes seconds to start again.
_FAULTS = {"stop": 0.6, "kill": 0.14, "end": 0.08, "kill all": 0.04, "kill the mesher": 0.14}


class _Broken:
    """Processes, and what is done to them.

    Parameters
    ----------
    nodes : Nodes
        Where they run.
    rng : numpy.random.Generator
        Chance.
    """

    def __init__(self, nodes: Nodes, rng: np.random.Generator) -> None:
        self._nodes = nodes
        self._rng = rng
        self._count = 0
        self._due: list[tuple[float, Callable[[], None]]] = []
        self.simulators: list[Popen[bytes]] = []
        self.meshers = 0
        self.done: Counter[str] = Counter()
        for _ in range(_SIMULATORS):
            self._start_simulator()
        self._start_mesher()

    def _start_simulator(self) -> None:
        self._count += 1
        self.simulators.append(self._nodes.start("simulator", f"simulator_{self._count}"))

    def _start_mesher(self) -> None:
        self.meshers += 1
        self._mesher = self._nodes.start(
            "mesher",
            f"mesher_{self.meshers}",
            checkpoint_directory=self._nodes.directory / "journals",
            chunk_seconds=0.005,
            simulator_timeout=0.2,
            simulator_wait_seconds=_MESH_TIMEOUT,
        )

    def _later(self, seconds: float, do: Callable[[], None]) -> None:
        self._due.append((time.monotonic() + seconds, do))

    def act(self) -> None:
        """Start and continue what is due."""
        now = time.monotonic()
        due = [do for at, do in self._due if at <= now]
        self._due = [(at, do) for at, do in self._due if at > now]
        for do in due:
            do()

    def fault(self) -> None:
        """Do something to a process that runs."""
        what = str(self._rng.choice([*_FAULTS], p=[*_FAULTS.values()]))
        victims = list(self.simulators)
        if what == "kill the mesher":
            end(self._mesher, signal.SIGKILL)
            self._start_mesher()
        elif not victims:
            return
        elif what == "stop":
            victim = victims[int(self._rng.integers(len(victims)))]
            victim.send_signal(signal.SIGSTOP)
            self._later(self._rng.uniform(0.05, 1.5), lambda: victim.send_signal(signal.SIGCONT))
        else:
            if what != "kill all":
                victims = [victims[int(self._rng.integers(len(victims)))]]
            for victim in victims:
                victim.send_signal(signal.SIGCONT)
                end(victim, signal.SIGTERM if what == "end" else signal.SIGKILL)
                self.simulators.remove(victim)
                self._later(self._rng.uniform(0.0, 1.0), self._start_simulator)
        self.done[what] += 1


def _check(result: GrowMesh.Result, mesh: Mesh, expected: Mesh) -> None:
    for name in ("states", "preceding", "generation", "targets", "outcomes", "scales"):
        same = getattr(mesh, name).tobytes() == getattr(expected, name).tobytes()
        check(same, f"{name} of a mesh are not those of the undisturbed one")
    counted = result.swings + result.swings_resumed
    check(counted == len(mesh.states) - 1, f"{counted} swings counted, {len(mesh.states) - 1} made")


def _one_mesh(
    nodes: Nodes, broken: _Broken, settings: MeshSettings, rng: np.random.Generator
) -> GrowMesh.Result:
    """Grow a mesh with faults until it is there."""
    results: list[GrowMesh.Result] = []
    accepted: list[int] = []
    deadline = time.monotonic() + _MESH_TIMEOUT
    sent = -np.inf
    next_fault = time.monotonic() + rng.uniform(0.1, 0.6)
    while not results:
        now = time.monotonic()
        if now > deadline:
            raise PromiseBroken(f"a mesh was not there after {_MESH_TIMEOUT:g} s")
        mesher = broken.meshers
        if mesher not in accepted and now - sent > _RESEND:
            sent = now
            nodes.send(settings, results.append, partial(accepted.append, mesher))
        broken.act()
        # Faults count while a mesh grows.
        if now >= next_fault and mesher in accepted:
            broken.fault()
            sent = sent if broken.meshers == mesher else -np.inf
            next_fault = now + rng.uniform(0.05, 0.6)
        nodes.spin_once(0.02)
    return results[0]


def run(short: bool, seed: int, progress: Progress) -> list[Row]:
    """Grow meshes among faults, and compare them with the one grown here."""
    start = time.monotonic()
    control, slopes, wanted = controller("hzd/mfpt"), slope_set(0.5), 8 if short else 120
    state = find_limit_cycle(control).state
    threshold = 0.02 if short else 0.004
    expected = grow_mesh(
        lambda states, previous: simulate_steps(control, states, previous, slopes),
        state,
        slopes,
        threshold,
    )
    settings = MeshSettings(control, WalkerModel(), slopes, threshold, initial_state=state)
    rng = np.random.default_rng(seed)
    meshes, resumed, repeated = 0, 0, 0
    problems: list[str] = []
    with Nodes(listen=True) as nodes:
        broken = _Broken(nodes, rng)
        nodes.wait(_SIMULATORS)
        while (faults := broken.done.total()) < wanted and len(problems) < 5:
            progress.show(f"{faults} of {wanted} faults, {meshes} meshes")
            meshes += 1
            try:
                result = _one_mesh(nodes, broken, settings, rng)
                check(result.success, result.message)
                _check(result, nodes.mesh(result.mesh_id), expected)
            except (PromiseBroken, TimeoutError) as error:
                problems.append(f"mesh {meshes}: {error}")
                continue
            resumed += result.swings_resumed
            repeated += result.chunks_repeated
    facts = {
        "meshes": meshes,
        "states_of_a_mesh": len(expected.states),
        "swings_resumed": resumed,
        "chunks_repeated": repeated,
        **{f"faults: {what}": n for what, n in sorted(broken.done.items())},
    }
    return [
        Row(
            "simulators",
            "faults while meshes grow, compared bit for bit",
            broken.done.total(),
            len(problems),
            time.monotonic() - start,
            facts,
            problems,
        )
    ]
