"""Chunks of swings over all simulators, for several meshes at once. No rclpy in here.

The answer for a state does not depend on the states beside it, so neither the sizes of chunks nor
who answers them, nor when, nor how often, changes a bit of a mesh.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from biped_mfpt_msgs.srv import SimulateSteps

from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.step import Steps
from biped_mfpt_ros.nodes.messages import packed, steps_from

_POLL = 0.05  # s, between two looks for simulators that came, went, or are late
_FIRST_SWING = 1e-4  # s, what a swing is taken to cost until answers tell
_LEAST_SHARE = 0.2  # of a full chunk, below which splitting costs more than it balances
_MOST_BYTES = 1_000_000  # in an answer: larger ones do not travel through shared memory
_MOST_SWINGS = 2000  # in a chunk: what a simulator takes has its limits
_MANY_TIMES = 10.0  # how much longer than expected an answer may take before it is late
_MOST_PATIENCE = 16.0  # by which that may grow
_QUIET = 1.0  # s without a simulator that answers, before that is worth a word
_MOST_FAILURES = 3  # refusals in a row before a simulator is dropped


class NoSimulatorError(RuntimeError):
    """There is no simulator that answers."""


class Simulators(Protocol):
    """The simulators that there are, and the way to ask them."""

    def found(self) -> Collection[str]:
        """Names of those that can be asked now, without the dropped ones."""

    def ask(self, name: str, request: SimulateSteps.Request) -> int:
        """Send a request. Returns a ticket, ascending for each simulator."""

    def answers(self, timeout: float) -> Iterable[tuple[str, int, SimulateSteps.Response]]:
        """Wait for answers: name, ticket and response of those that came within a time (s)."""

    def wake(self) -> None:
        """End the wait for answers; from any thread."""

    def drop(self, name: str, reason: str) -> None:
        """Leave a simulator out of `found`, for a reason, until it has gone from the graph."""

    @property
    def dropped(self) -> Mapping[str, str]:
        """Reasons, by the names of the simulators that were dropped."""


class Growth(Protocol):
    """What grows: see `biped_mfpt_ros.chain.mesh.MeshGrowth`."""

    @property
    def known(self) -> int:
        """Number of states so far, the failure state counted; all of them may be simulated."""

    @property
    def resumed(self) -> int:
        """Number of states whose answers were there from the beginning."""

    def unanswered(self, start: int, most: int) -> tuple[int, int]:
        """The first range of at most that many states from ``start`` on that have no answer."""

    def states(self, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        """States, shape (n, 10), and the slopes behind them, shape (n,)."""

    def take(self, start: int, steps: Steps, n: int) -> None:
        """Take the answer for n states from index ``start`` on."""


@dataclass
class Tally:
    """What has been done so far for a job.

    Attributes
    ----------
    swings : int
        Swings answered, each counted once.
    chunks : int
        Requests sent.
    chunks_repeated : int
        Chunks handed on because their simulator was gone, late, dropped or busy.
    step_map_seconds : float
        s, time in the step map, summed over the simulators.
    """

    swings: int = 0
    chunks: int = 0
    chunks_repeated: int = 0
    step_map_seconds: float = 0.0


@dataclass(eq=False)
class Job:
    """A mesh that grows.

    Attributes
    ----------
    growth : Growth
        Knows what is to be simulated, and takes the answers.
    request : SimulateSteps.Request
        Controller, model, slopes and step map of every request.
    tally : Tally
        What has been done.
    error : Exception or None
        Why it cannot go on: `NoSimulatorError`, or what ``growth.take`` raised.
    """

    growth: Growth
    request: SimulateSteps.Request
    tally: Tally = field(default_factory=Tally)
    error: Exception | None = None
    _handed_out: int = 1
    _again: deque[_Chunk] = field(default_factory=deque)
    _swing_seconds: float = 0.0
    _swing_bytes: float = 0.0
    _since: float = field(default_factory=time.monotonic)

    @property
    def frontier(self) -> int:
        """States known that have not been simulated."""
        return self.growth.known - 1 - self.growth.resumed - self.tally.swings


@dataclass(eq=False)
class _Chunk:
    job: Job
    start: int
    stop: int
    done: bool = False


@dataclass
class _Asked:
    chunk: _Chunk
    at: float


@dataclass
class _Simulator:
    name: str
    asked: dict[int, _Asked] = field(default_factory=dict)
    """Unanswered requests by ticket, oldest first. They are answered in this order."""
    heard: float = -math.inf
    """When the last answer came."""
    failures: int = 0
    patience: float = 1.0
    """Factor on the time after which it is late; doubled whenever it was."""
    late: bool = False
    """A late one gets no work until it answers, but for a chunk now and then to try it."""
    try_at: float = 0.0


@dataclass(frozen=True)
class FanOutSettings:
    """How chunks are cut, and when a simulator counts as late.

    Attributes
    ----------
    chunk_seconds : float
        s, work in a full chunk.
    in_flight : int
        Chunks that a simulator has at once: one that it computes, the others wait for it.
    timeout : float
        s, after which an answer may be late. It is if it also takes 10 times what it should.
    wait_seconds : float
        s, for how long to wait for a simulator when there is none that answers.
    """

    chunk_seconds: float = 0.1
    in_flight: int = 2
    timeout: float = 1.0
    wait_seconds: float = 10.0


class FanOut:
    """Simulates the swings of jobs on all simulators; to be used from one thread.

    Parameters
    ----------
    simulators : Simulators
        Who can be asked.
    settings : FanOutSettings
        How to go about it. May be replaced at any time.
    log : callable
        Told what happens to simulators.
    """

    def __init__(
        self,
        simulators: Simulators,
        settings: FanOutSettings,
        log: Callable[[str], object],
    ) -> None:
        self.settings = settings
        self._available = simulators
        self._log = log
        self._simulators: dict[str, _Simulator] = {}
        self._looked = -math.inf
        self._usable = -math.inf  # when there was last a simulator that is not late
        self._waiting = False
        # Whose turn it is comes first.
        self._jobs: deque[Job] = deque()

    @property
    def simulators(self) -> int:
        """Simulators at work."""
        return sum(not s.late for s in self._simulators.values())

    def in_flight(self, job: Job | None = None) -> int:
        """Requests sent and not answered, of one job or of all."""
        return sum(
            job is None or asked.chunk.job is job
            for simulator in self._simulators.values()
            for asked in simulator.asked.values()
        )

    def add(self, job: Job) -> None:
        """Begin a job. It ends when it is removed."""
        self._jobs.append(job)

    def remove(self, job: Job) -> None:
        """Forget a job, and its requests that are still unanswered."""
        self._jobs.remove(job)
        for simulator in self._simulators.values():
            for ticket in [t for t, a in simulator.asked.items() if a.chunk.job is job]:
                del simulator.asked[ticket]

    def step(self, timeout: float) -> None:
        """Hand out what can be, and take the answers that come within a time (s)."""
        now = time.monotonic()
        if now - self._looked >= _POLL:
            self._looked = now
            self._look_around(now)
        while self._jobs and (simulator := self._next_simulator(now)) is not None:
            chunk = self._next_chunk()
            if chunk is None:
                break
            self._ask(simulator, chunk, now)
            if simulator.late:
                self._repeat(chunk)  # nobody is to wait for it
        for answer in self._available.answers(timeout):
            self._take(*answer)

    def _next_chunk(self) -> _Chunk | None:
        """The next chunk of the job whose turn it is, of those that have something to do."""
        for _ in range(len(self._jobs)):
            job = self._jobs[0]
            self._jobs.rotate(-1)
            if job.error is not None:
                continue
            while job._again and job._again[0].done:
                job._again.popleft()
            if job._again:
                return job._again.popleft()
            ready = job.growth.known - job._handed_out
            if ready > 0:
                start, stop = job.growth.unanswered(job._handed_out, self._size(job, ready))
                job._handed_out = stop
                if stop > start:
                    return _Chunk(job, start, stop)
        return None

    def _size(self, job: Job, ready: int) -> int:
        """Swings of the next chunk: the fewer are left, the smaller, so that all end together."""
        full = round(self.settings.chunk_seconds / (job._swing_seconds or _FIRST_SWING))
        # Until answers tell, every step is taken to succeed.
        size = job._swing_bytes or 81.0 * len(job.request.slopes)
        full = max(1, min(full, _MOST_SWINGS, int(_MOST_BYTES / size)))
        least = max(1, round(_LEAST_SHARE * full))
        share = math.ceil(ready / (2 * max(1, self.simulators)))
        return min(ready, max(least, min(full, share)))

    def _next_simulator(self, now: float) -> _Simulator | None:
        """Who gets the next chunk: the one with the least to do, if anyone has room."""
        most = self.settings.in_flight
        best = None
        for simulator in self._simulators.values():
            if simulator.late:
                # Its requests may have been lost on the way: it gets another chance.
                if now >= simulator.try_at:
                    simulator.try_at = now + self._limit(simulator)
                    simulator.patience = min(2.0 * simulator.patience, _MOST_PATIENCE)
                    return simulator
                continue
            if len(simulator.asked) < most:
                most, best = len(simulator.asked), simulator
        return best

    def _ask(self, simulator: _Simulator, chunk: _Chunk, now: float) -> None:
        job = chunk.job
        states, previous = job.growth.states(chunk.start, chunk.stop)
        request = SimulateSteps.Request(
            step_map=job.request.step_map,
            controller=job.request.controller,
            model=job.request.model,
            slopes=job.request.slopes,
            states=packed(states, "d"),
            previous_slopes=packed(previous, "d"),
        )
        try:
            ticket = self._available.ask(simulator.name, request)
        except Exception as error:
            self._fail(simulator, chunk, f"could not be asked: {error!r}")
            return
        simulator.asked[ticket] = _Asked(chunk, now)
        job.tally.chunks += 1

    def _take(self, name: str, ticket: int, response: SimulateSteps.Response) -> None:
        simulator = self._simulators.get(name)
        asked = simulator.asked.pop(ticket, None) if simulator is not None else None
        if simulator is None or asked is None:
            return
        chunk = asked.chunk
        job = chunk.job
        simulator.heard = time.monotonic()
        if response.busy:
            self._put_off(simulator, chunk, response.message)
            return
        wanted = job.request.step_map
        if response.step_map != wanted:
            self._drop(simulator, f"runs step map {response.step_map}, not {wanted}", chunk)
            return
        if not response.success:
            self._fail(simulator, chunk, f"refuses: {response.message}")
            return
        m = len(job.request.slopes)
        # Where swings crawl, an answer is for the first ones only.
        n = min(chunk.stop - chunk.start, max(1, len(response.outcomes) // m))
        try:
            steps = steps_from(response, n, m)
        except InputError as error:
            self._drop(simulator, f"gave an answer that cannot be: {error}", chunk)
            return
        simulator.failures = 0
        swing = max(steps.seconds / n, 1e-7)
        job._swing_seconds = _smoothed(job._swing_seconds, swing)
        size = (steps.outcomes.nbytes + steps.next_states.nbytes) / n
        job._swing_bytes = _smoothed(job._swing_bytes, size)
        if simulator.late:
            simulator.late = False
            # A simulator answers in order, so the requests before this one got lost on the way.
            for lost in [earlier for earlier in simulator.asked if earlier < ticket]:
                self._repeat_unless_asked(simulator.asked.pop(lost).chunk)
            self._log(f"{name} answers again")
        if chunk.done or job.error is not None:
            return  # it was late, and another one was faster
        chunk.done = True
        rest = chunk.start + n
        while rest < chunk.stop:
            start, rest = rest, rest + self._size(job, chunk.stop - rest)
            job._again.append(_Chunk(job, start, rest))
        job.tally.swings += n
        job.tally.step_map_seconds += steps.seconds
        try:
            job.growth.take(chunk.start, steps, n)
        except Exception as error:
            job.error = error

    def _look_around(self, now: float) -> None:
        """See who came, who went, who is late."""
        found = self._available.found()
        for name in found:
            if name not in self._simulators:
                self._simulators[name] = _Simulator(name)
        for name in [name for name in self._simulators if name not in found]:
            gone = self._simulators.pop(name)
            if gone.asked:
                self._log(f"{name} has gone with {len(gone.asked)} requests unanswered")
            self._hand_on(gone)
        for simulator in self._simulators.values():
            if simulator.asked and not simulator.late:
                self._check_late(simulator, now)
        if self.simulators or not self._jobs:
            if self._waiting and self.simulators:
                self._log("there is a simulator again: going on")
            self._usable, self._waiting = now, False
            return
        wait = self.settings.wait_seconds
        if not self._waiting and now - self._usable > min(_QUIET, wait):
            self._waiting = True
            self._log(f"no simulator answers: waiting for one, for {wait:g} s ({self._why()})")
        for job in self._jobs:
            if job.error is None and now - max(self._usable, job._since) > wait:
                job.error = NoSimulatorError(f"no simulator answered for {wait:g} s: {self._why()}")

    def _limit(self, simulator: _Simulator) -> float:
        """Time after which its oldest request is late, s."""
        oldest = next(iter(simulator.asked.values()), None)
        expected = 0.0
        if oldest is not None:
            chunk = oldest.chunk
            expected = (chunk.stop - chunk.start) * (chunk.job._swing_seconds or _FIRST_SWING)
        return simulator.patience * max(self.settings.timeout, _MANY_TIMES * expected)

    def _check_late(self, simulator: _Simulator, now: float) -> None:
        limit = self._limit(simulator)
        oldest = next(iter(simulator.asked.values()))
        if now - max(oldest.at, simulator.heard) <= limit:
            return
        self._log(f"{simulator.name} has not answered for {limit:.1f} s: its work is handed on")
        simulator.late = True
        simulator.patience = min(2.0 * simulator.patience, _MOST_PATIENCE)
        simulator.try_at = now + self._limit(simulator)
        self._hand_on(simulator)

    def _hand_on(self, simulator: _Simulator) -> None:
        """Have the chunks that a simulator has not answered done by others."""
        for asked in simulator.asked.values():
            self._repeat(asked.chunk)

    def _put_off(self, simulator: _Simulator, chunk: _Chunk, reason: str) -> None:
        """Have a chunk done that a simulator had no room for; it is tried again like a late one."""
        if not simulator.late:
            self._log(f"{simulator.name} refuses: {reason}")
            simulator.late = True
            simulator.try_at = simulator.heard + self._limit(simulator)
        self._repeat_unless_asked(chunk)

    def _repeat_unless_asked(self, chunk: _Chunk) -> None:
        """Have a chunk done, unless it was handed on before and someone is at it."""
        if not any(a.chunk is chunk for s in self._simulators.values() for a in s.asked.values()):
            self._repeat(chunk)

    def _repeat(self, chunk: _Chunk) -> None:
        job = chunk.job
        if not chunk.done and chunk not in job._again:
            job._again.append(chunk)
            job.tally.chunks_repeated += 1

    def _fail(self, simulator: _Simulator, chunk: _Chunk, reason: str) -> None:
        simulator.failures += 1
        if simulator.failures >= _MOST_FAILURES:
            self._drop(simulator, f"{reason} ({_MOST_FAILURES} times in a row)", chunk)
        else:
            self._log(f"{simulator.name} {reason}")
            self._repeat(chunk)

    def _drop(self, simulator: _Simulator, reason: str, chunk: _Chunk) -> None:
        self._log(f"{simulator.name} is dropped: it {reason}")
        self._available.drop(simulator.name, reason)
        del self._simulators[simulator.name]
        self._repeat(chunk)
        self._hand_on(simulator)

    def _why(self) -> str:
        """Why there is no simulator that answers."""
        reasons = [f"{name} is late" for name, s in self._simulators.items() if s.late]
        reasons += [f"{name}, dropped, {why}" for name, why in self._available.dropped.items()]
        return "; ".join(reasons) or (
            "there is none on the graph; start one with: ros2 run biped_mfpt_ros simulator"
        )


def _smoothed(before: float, value: float) -> float:
    """The value, with those before it in mind; 0 stands for none."""
    return 0.7 * before + 0.3 * value if before else value
