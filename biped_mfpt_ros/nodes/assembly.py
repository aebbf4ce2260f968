"""A mesh from the messages that it was published in. No rclpy in here: a bag will do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from biped_mfpt_msgs.msg import MeshInfo

from biped_mfpt_ros.chain.mesh import NOT_SIMULATED, Mesh
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.nodes.messages import MeshSettings, settings_from, unpacked
from biped_mfpt_ros.walker.robot import STATE_SIZE


class IncompleteMesh(LookupError):
    """A mesh cannot be used: parts of it are missing, or do not fit together."""


class MeshAssembly:
    """One mesh, put together from its messages.

    Messages of one topic come in the order of their publication; the topics may be ahead of one
    another, and messages of other meshes may lie between. A lost message shows in the indices of
    the next one, or in the counts of the last. Messages are objects with the fields of
    `MeshInfo`, `MeshStates` and `MeshTransitions`, as rclpy or a reader of bags makes them.

    Parameters
    ----------
    mesh_id : str
        Which mesh.

    Attributes
    ----------
    settings : MeshSettings or None
        What is meshed; None until the first info has come.
    step_map : str
        Identity of the step map that simulated it; empty until then.
    status : int or None
        Status of the last info.
    problem : str
        Why the mesh can never become complete; empty as long as it can.
    """

    def __init__(self, mesh_id: str) -> None:
        self.mesh_id = mesh_id
        self.settings: MeshSettings | None = None
        self.step_map = ""
        self.status: int | None = None
        self.problem = ""
        self._final: Any = None
        self._early: list[tuple[Callable[[Any], None], Any]] = []
        self._states: list[tuple[int, np.ndarray, np.ndarray]] = []
        self._rows: list[tuple[np.ndarray, np.ndarray]] = []
        self._state_count = 1
        self._row_count = 1

    @property
    def complete(self) -> bool:
        """Whether all of it is there, so that `mesh` will return it."""
        final = self._final
        return (
            not self.problem
            and final is not None
            and self._state_count == self._row_count == final.states
        )

    @property
    def missing(self) -> str:
        """What is missing, in words; empty if nothing is."""
        if self.problem:
            return self.problem
        if self._final is None:
            if self.status is None:
                return "nothing says what it is a mesh of"
            return f"it is not finished: {self._state_count} states so far"
        if not self.complete:
            return (
                f"of {self._final.states} states {self._state_count} have come, and the "
                f"transitions of {self._row_count} (x_1 counted)"
            )
        return ""

    def add_info(self, message: Any) -> None:
        """Take a `MeshInfo`."""
        if self.problem:
            return
        self.status = message.status
        if message.status in (MeshInfo.FAILED, MeshInfo.CANCELLED):
            how = "failed" if message.status == MeshInfo.FAILED else "was cancelled"
            self._spoil(f"it {how}: {message.message}" if message.message else f"it {how}")
            return
        if self.settings is None:
            try:
                self.settings = settings_from(message.settings)
            except InputError as error:
                self._spoil(f"mesh/info: {error}")
                return
            self.step_map = message.step_map
            early, self._early = self._early, []
            for take, other in early:
                self._take(take, other)
        if message.status == MeshInfo.COMPLETE:
            self._final = message
            self._check_counts()

    def add_states(self, message: Any) -> None:
        """Take a `MeshStates`."""
        self._take(self._take_states, message)

    def add_transitions(self, message: Any) -> None:
        """Take a `MeshTransitions`."""
        self._take(self._take_transitions, message)

    def mesh(self) -> Mesh:
        """The whole mesh.

        Raises
        ------
        IncompleteMesh
            If parts are missing, or do not fit together.
        """
        if not self.complete:
            raise IncompleteMesh(f"mesh {self.mesh_id} cannot be used: {self.missing}")
        assert self.settings is not None
        m = len(self.settings.slopes)
        generations = [np.full(len(states), g) for g, states, _ in self._states]
        try:
            return Mesh(
                slopes=self.settings.slopes,
                states=np.concatenate(
                    [np.zeros((1, STATE_SIZE)), *(states for _, states, _ in self._states)]
                ),
                preceding=np.concatenate([np.zeros(1, np.uint32), *(p for *_, p in self._states)]),
                generation=np.concatenate([np.zeros(1, np.uint32), *generations]),
                targets=np.concatenate(
                    [np.zeros((1, m), np.uint32), *(targets for targets, _ in self._rows)]
                ),
                outcomes=np.concatenate(
                    [np.full((1, m), NOT_SIMULATED, np.uint8), *(o for _, o in self._rows)]
                ),
                scales=unpacked(self._final.scales, "d"),
                threshold=self.settings.threshold,
                clustered=self.settings.clustered,
            )
        except InputError as error:
            raise IncompleteMesh(f"mesh {self.mesh_id} cannot be used: {error}") from None

    def _spoil(self, problem: str) -> None:
        """Give the mesh up, and the memory of what has come of it."""
        self.problem = problem
        self._early, self._states, self._rows = [], [], []

    def _take(self, take: Callable[[Any], None], message: Any) -> None:
        # Topics may overtake one another; without the slope set nothing can be checked.
        if self.problem:
            return
        if self.settings is None:
            self._early.append((take, message))
        else:
            take(message)

    def _take_states(self, message: Any) -> None:
        states, preceding = unpacked(message.states, "d"), unpacked(message.preceding, "I")
        if states.size != STATE_SIZE * preceding.size:
            self._spoil(f"mesh/states: {states.size} numbers for {preceding.size} states")
        elif message.first_index != self._state_count:
            self._spoil(
                f"mesh/states: the next state was to have index {self._state_count}, not "
                f"{message.first_index}: messages were lost"
            )
        else:
            rows = states.reshape(-1, STATE_SIZE)
            self._states.append((message.generation, rows, preceding))
            self._state_count += len(rows)
            self._check_counts()

    def _take_transitions(self, message: Any) -> None:
        assert self.settings is not None
        m = len(self.settings.slopes)
        targets, outcomes = unpacked(message.targets, "I"), unpacked(message.outcomes, "B")
        if targets.size % m or outcomes.size != targets.size:
            self._spoil(
                f"mesh/transitions: {targets.size} targets and {outcomes.size} outcomes for rows "
                f"of {m} slopes"
            )
        elif message.first_index != self._row_count:
            self._spoil(
                f"mesh/transitions: the next row was to have index {self._row_count}, not "
                f"{message.first_index}: messages were lost"
            )
        else:
            self._rows.append((targets.reshape(-1, m), outcomes.reshape(-1, m)))
            self._row_count += targets.size // m
            self._check_counts()

    def _check_counts(self) -> None:
        if self._final is not None and max(self._state_count, self._row_count) > self._final.states:
            self._spoil(
                f"{self._state_count} states and {self._row_count} rows of transitions came, more "
                f"than the {self._final.states} that it has (x_1 counted)"
            )
