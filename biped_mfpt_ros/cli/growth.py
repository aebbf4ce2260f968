"""Growing a mesh in this process, with a thread for each core."""

from __future__ import annotations

import os
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.gait.step import simulate_steps
from biped_mfpt_ros.report.progress import MeshProgress, Progress
from biped_mfpt_ros.walker.robot import WalkerModel

_CHUNK = 16  # states: some milliseconds of work


@dataclass(frozen=True)
class Answer:
    """What `grow_mesh` needs of the steps of a generation."""

    outcomes: np.ndarray
    next_states: np.ndarray


class Growth:
    """Simulates the generations of a mesh and shows how far it has come.

    Use it as a context manager. The kernels run without the interpreter's lock, and chunks are put
    together in order: the mesh does not depend on the number of threads.

    Attributes
    ----------
    swings : int
        Swings simulated.
    seconds : float
        s spent in the step map, summed over the threads.
    """

    def __init__(
        self, controller: Controller, slopes: np.ndarray, model: WalkerModel, progress: Progress
    ) -> None:
        self._controller = controller
        self._slopes = slopes
        self._model = model
        self._progress = progress
        self._text = MeshProgress()
        self._pool = ThreadPoolExecutor(os.cpu_count() or 1)
        self._start = time.monotonic()
        self._generation = 0
        self._states = 0
        self.swings = 0
        self.seconds = 0.0

    def on_generation(
        self, generation: int, first_index: int, states: np.ndarray, preceding: np.ndarray
    ) -> None:
        """Take note of states that were added; for `grow_mesh`."""
        self._generation = generation
        self._states = first_index + len(states)

    def simulate(self, states: np.ndarray, previous_slopes: np.ndarray) -> Answer:
        """Simulate a generation; for `grow_mesh`."""

        def chunk(start: int) -> tuple[np.ndarray, np.ndarray, float]:
            part = slice(start, start + _CHUNK)
            steps = simulate_steps(
                self._controller,
                states[part],
                previous_slopes[part],
                self._slopes,
                self._model,
                measures=False,
            )
            return steps.outcomes, steps.next_states, steps.seconds

        outcomes, next_states = [], []
        self._show(len(states))
        for tried, reached, seconds in self._pool.map(chunk, range(0, len(states), _CHUNK)):
            outcomes.append(tried)
            next_states.append(reached)
            self.swings += len(tried)
            self.seconds += seconds
            self._show(len(states) - _CHUNK * len(outcomes))
        return Answer(np.concatenate(outcomes), np.concatenate(next_states))

    def _show(self, frontier: int) -> None:
        elapsed = time.monotonic() - self._start
        self._progress.show(
            self._text.text(
                generation=self._generation,
                states=self._states,
                frontier=max(0, frontier),
                swings_per_second=self.swings / elapsed if elapsed > 0.0 else 0.0,
            )
        )

    def __enter__(self) -> Growth:
        """Start."""
        return self

    def __exit__(self, *exc: object) -> None:
        """Drop what has not been started."""
        self._pool.shutdown(cancel_futures=True)
