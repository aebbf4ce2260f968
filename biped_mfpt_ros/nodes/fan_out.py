"""Chunks of swings over all simulators, and their answers in order. No rclpy in here.

A `FanOut` is the ``simulate`` that `grow_mesh` calls in the mesher. The answer for a state does not
depend on the states beside it, so neither the sizes of chunks nor who answers them, nor when, nor
how often, changes a bit of the result.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Protocol

import numpy as np
from biped_mfpt_msgs.srv import SimulateSteps

from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.step import Steps
from biped_mfpt_ros.nodes.messages import packed, steps_from

_POLL = 0.05  # s, between two looks for simulators that came, went, or are late
_FIRST_SWING = 1e-4  # s, what a swing is taken to cost until answers tell
_LEAST_SHARE = 0.2  # of a full chunk, below which splitting costs more than it balances
_MOST_OUTCOMES = 40_000  # in a chunk: keeps answers near the 1 MB that travel best
_MANY_TIMES = 10.0  # how much longer than expected an answer may take before it is late
_MOST_PATIENCE = 16.0  # by which that may grow
_MOST_FAILURES = 3  # refusals in a row before a simulator is dropped


class NoSimulatorError(RuntimeError):
    """There is no simulator that answers."""


class Simulators(Protocol):
    """The simulators that there are, and the way to ask them."""

    def found(self) -> Collection[str]:
        """Names of those that can be asked now, without the dropped ones."""

    def ask(
        self,
        name: str,
        request: SimulateSteps.Request,
        answer: Callable[[SimulateSteps.Response], None],
    ) -> Callable[[], None]:
        """Send a request. ``answer`` is called with the response, from any thread.

        Returns what to call when the response is no longer wanted.
        """

    def drop(self, name: str, reason: str) -> None:
        """Leave a simulator out of `found`, for a reason, until it has gone from the graph."""

    @property
    def dropped(self) -> Mapping[str, str]:
        """Reasons, by the names of the simulators that were dropped."""


@dataclass
class _Chunk:
    start: int
    stop: int
    states: np.ndarray
    previous: np.ndarray
    done: bool = False


@dataclass
class _Asked:
    chunk: _Chunk
    at: float
    forget: Callable[[], None]


@dataclass
class _Simulator:
    name: str
    asked: dict[int, _Asked] = field(default_factory=dict)
    """Unanswered requests by ticket, oldest first. They are answered in this order."""
    heard: float = -math.inf
    """When the last answer came."""
    swing_seconds: float = 0.0
    """Cost of a swing, as answers told; 0: not known yet."""
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

    chunk_seconds: float = 0.05
    in_flight: int = 2
    timeout: float = 1.0
    wait_seconds: float = 10.0


@dataclass
class Tally:
    """What has been done so far.

    Attributes
    ----------
    swings : int
        Swings answered, each counted once.
    frontier : int
        Swings of this generation not yet answered.
    chunks : int
        Requests sent.
    chunks_repeated : int
        Chunks handed on because their simulator was gone, late or dropped.
    step_map_seconds : float
        s, time in the step map, summed over the simulators.
    """

    swings: int = 0
    frontier: int = 0
    chunks: int = 0
    chunks_repeated: int = 0
    step_map_seconds: float = 0.0


@dataclass(frozen=True, eq=False)
class Answers:
    """Outcomes and next states of a generation, as in `Steps`."""

    outcomes: np.ndarray
    next_states: np.ndarray


class FanOut:
    """Simulates swings on all simulators; to be called from one thread.

    Parameters
    ----------
    simulators : Simulators
        Who can be asked.
    request : SimulateSteps.Request
        Controller, model, slopes and step map of every request.
    settings : FanOutSettings
        How to go about it.
    log : callable
        Told what happens to simulators.
    tick : callable
        Called every 50 ms or so while waiting. What it raises ends the call.
    """

    def __init__(
        self,
        simulators: Simulators,
        request: SimulateSteps.Request,
        settings: FanOutSettings,
        log: Callable[[str], object],
        tick: Callable[[], object],
    ) -> None:
        self._available = simulators
        self._request = request
        self._slopes = len(request.slopes)
        self._settings = settings
        self._log = log
        self._tick = tick
        self._simulators: dict[str, _Simulator] = {}
        self._answers: SimpleQueue[tuple[str, int, SimulateSteps.Response]] = SimpleQueue()
        self._ticket = 0
        self._looked = -math.inf
        self._usable = -math.inf  # when there was last a simulator that is not late
        self._again: deque[_Chunk] = deque()
        self._steps: dict[int, Steps] = {}
        self.tally = Tally()

    @property
    def simulators(self) -> int:
        """Simulators at work."""
        return sum(not s.late for s in self._simulators.values())

    @property
    def in_flight(self) -> int:
        """Requests sent and not answered."""
        return sum(len(s.asked) for s in self._simulators.values())

    def __call__(self, states: np.ndarray, previous_slopes: np.ndarray) -> Answers:
        """Simulate one step from every state, for every slope.

        Parameters
        ----------
        states : numpy.ndarray
            rad and rad/s, shape (n, 10).
        previous_slopes : numpy.ndarray
            rad, shape (n,).

        Raises
        ------
        NoSimulatorError
            If for the set time there was no simulator that answers.
        """
        n = len(states)
        self._again.clear()
        self._steps.clear()
        self._usable = time.monotonic()
        self.tally.frontier = n
        handed_out = 0
        while self.tally.frontier:
            now = time.monotonic()
            if now - self._looked >= _POLL:
                self._looked = now
                self._tick()
                self._look_around(now)
            while (simulator := self._next_simulator(now)) is not None:
                while self._again and self._again[0].done:
                    self._again.popleft()
                if self._again:
                    chunk = self._again.popleft()
                elif handed_out < n:
                    stop = handed_out + self._size(n - handed_out)
                    chunk = _Chunk(
                        handed_out,
                        stop,
                        states[handed_out:stop],
                        previous_slopes[handed_out:stop],
                    )
                    handed_out = stop
                else:
                    break
                self._ask(simulator, chunk, now)
                if simulator.late:
                    self._repeat(chunk)  # nobody is to wait for it
            try:
                answer = self._answers.get(timeout=_POLL)
                while True:
                    self._take(*answer)
                    answer = self._answers.get_nowait()
            except Empty:
                pass
        in_order = [self._steps[start] for start in sorted(self._steps)]
        return Answers(
            np.concatenate([steps.outcomes for steps in in_order]),
            np.concatenate([steps.next_states for steps in in_order]),
        )

    def close(self) -> None:
        """Forget all requests that are still unanswered."""
        for simulator in self._simulators.values():
            for asked in simulator.asked.values():
                asked.forget()
            simulator.asked.clear()

    def _size(self, remaining: int) -> int:
        """Swings of the next chunk: the fewer are left, the smaller, so that all end together."""
        simulators = self._simulators.values()
        known = [s.swing_seconds for s in simulators if s.swing_seconds]
        swing = sum(known) / len(known) if known else _FIRST_SWING
        full = round(self._settings.chunk_seconds / swing)
        full = max(1, min(full, _MOST_OUTCOMES // self._slopes))
        least = max(1, round(_LEAST_SHARE * full))
        share = math.ceil(remaining / (2 * max(1, self.simulators)))
        return min(remaining, max(least, min(full, share)))

    def _next_simulator(self, now: float) -> _Simulator | None:
        """Who gets the next chunk: the one with the least to do, if anyone has room."""
        most = self._settings.in_flight
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
        request = SimulateSteps.Request(
            step_map=self._request.step_map,
            controller=self._request.controller,
            model=self._request.model,
            slopes=self._request.slopes,
            states=packed(chunk.states, "d"),
            previous_slopes=packed(chunk.previous, "d"),
        )
        self._ticket += 1
        ticket, name, answers = self._ticket, simulator.name, self._answers
        try:
            forget = self._available.ask(
                name, request, lambda response: answers.put((name, ticket, response))
            )
        except Exception as error:
            self._fail(simulator, chunk, f"could not be asked: {error!r}")
            return
        simulator.asked[ticket] = _Asked(chunk, now, forget)
        self.tally.chunks += 1

    def _take(self, name: str, ticket: int, response: SimulateSteps.Response) -> None:
        simulator = self._simulators.get(name)
        asked = simulator.asked.pop(ticket, None) if simulator is not None else None
        if simulator is None or asked is None:
            return
        chunk = asked.chunk
        simulator.heard = time.monotonic()
        wanted = self._request.step_map
        if response.step_map != wanted:
            self._drop(simulator, f"runs step map {response.step_map}, not {wanted}", chunk)
            return
        if not response.success:
            self._fail(simulator, chunk, f"refuses: {response.message}")
            return
        n = chunk.stop - chunk.start
        try:
            steps = steps_from(response, n, self._slopes)
        except InputError as error:
            self._drop(simulator, f"gave an answer that cannot be: {error}", chunk)
            return
        simulator.failures = 0
        swing = max(steps.seconds / n, 1e-7)
        simulator.swing_seconds = (
            0.7 * simulator.swing_seconds + 0.3 * swing if simulator.swing_seconds else swing
        )
        if simulator.late:
            simulator.late = False
            # A simulator answers in order, so the requests before this one got lost on the way.
            for lost in [earlier for earlier in simulator.asked if earlier < ticket]:
                simulator.asked.pop(lost).forget()
            self._log(f"{name} answers again")
        if chunk.done:
            return  # it was late, and another one was faster
        chunk.done = True
        self._steps[chunk.start] = steps
        self.tally.frontier -= n
        self.tally.swings += n
        self.tally.step_map_seconds += steps.seconds

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
            for asked in gone.asked.values():
                asked.forget()
        for simulator in self._simulators.values():
            if simulator.asked and not simulator.late:
                self._check_late(simulator, now)
        if self.simulators:
            self._usable = now
        elif now - self._usable > self._settings.wait_seconds:
            raise NoSimulatorError(self._none_answers())

    def _limit(self, simulator: _Simulator) -> float:
        """Time after which its oldest request is late, s."""
        swings = next((a.chunk.stop - a.chunk.start for a in simulator.asked.values()), 0)
        expected = swings * (simulator.swing_seconds or _FIRST_SWING)
        return simulator.patience * max(self._settings.timeout, _MANY_TIMES * expected)

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

    def _repeat(self, chunk: _Chunk) -> None:
        if not chunk.done and all(chunk is not other for other in self._again):
            self._again.append(chunk)
            self.tally.chunks_repeated += 1

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
        for asked in simulator.asked.values():
            asked.forget()

    def _none_answers(self) -> str:
        reasons = [f"{name} is late" for name, s in self._simulators.items() if s.late]
        reasons += [f"{name}, dropped, {why}" for name, why in self._available.dropped.items()]
        why = "; ".join(reasons) or (
            "there is none on the graph; start one with: ros2 run biped_mfpt_ros simulator"
        )
        return f"no simulator answered for {self._settings.wait_seconds:g} s: {why}"
