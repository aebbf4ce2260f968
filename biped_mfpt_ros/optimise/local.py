"""The backend of a study in this process: meshes grown by the kernels, without ROS."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from biped_mfpt_ros.chain.markov import ChainError, metastability
from biped_mfpt_ros.chain.mesh import Mesh, MeshLimitError, grow_mesh
from biped_mfpt_ros.gait.cycle import LimitCycle
from biped_mfpt_ros.gait.step import simulate_steps
from biped_mfpt_ros.optimise.scoring import MeshFailed
from biped_mfpt_ros.optimise.settings import Stage, StudySettings

_CHUNK = 64  # states: some ten milliseconds of work between two looks at the clock


@dataclass(frozen=True)
class _Answer:
    outcomes: np.ndarray
    next_states: np.ndarray


@dataclass(frozen=True)
class LocalMesh:
    """A mesh in memory; see `GrownMesh`."""

    mesh: Mesh
    seconds: float
    step_map_seconds: float
    mesh_id: str = ""

    @property
    def states(self) -> int:
        """States, the failure state counted."""
        return len(self.mesh.states)

    def mfpt(self, mu_s: float, sigma_s: float, correlation: float) -> float:
        """MFPT in steps."""
        try:
            return float(metastability(self.mesh, mu_s, sigma_s, correlation).mfpt)
        except ChainError as error:
            raise MeshFailed(str(error), self.states) from None


class LocalBackend:
    """Grows meshes in the calling thread. Kernels run without the GIL, so threads run in parallel.

    A mesh is equal, bit for bit, to that of the pipeline.
    """

    def grow(
        self,
        cycle: LimitCycle,
        settings: StudySettings,
        stage: Stage,
        slopes: np.ndarray,
        check: Callable[[], None],
    ) -> LocalMesh:
        """Grow a mesh; see `Backend`."""
        start = time.monotonic()
        seconds = 0.0

        def simulate(states: np.ndarray, previous: np.ndarray) -> _Answer:
            nonlocal seconds
            outcomes, following = [], []
            for at in range(0, len(states), _CHUNK):
                check()
                part = slice(at, at + _CHUNK)
                steps = simulate_steps(
                    cycle.controller,
                    states[part],
                    previous[part],
                    slopes,
                    settings.model,
                    measures=False,
                )
                outcomes.append(steps.outcomes)
                following.append(steps.next_states)
                seconds += steps.seconds
            return _Answer(np.concatenate(outcomes), np.concatenate(following))

        try:
            mesh = grow_mesh(
                simulate, cycle.state, slopes, stage.threshold, max_states=stage.max_states
            )
        except MeshLimitError as error:
            raise MeshFailed(
                f"more than {error.max_states} states at d_s = {stage.slope_step_deg:g} degrees, "
                f"d_thr = {stage.threshold:g}",
                error.max_states,
            ) from None
        return LocalMesh(mesh, time.monotonic() - start, seconds)
