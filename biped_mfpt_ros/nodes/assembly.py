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


class _Pieces:
    """Arrays that are put together by index, in whichever order their pieces come.

    What comes in order is copied at once, so that memory never holds all of it twice.

    Parameters
    ----------
    topic : str
        Where they come from, for messages.
    first : numpy.ndarray
        Row 0 of each of the arrays.
    """

    def __init__(self, topic: str, *first: np.ndarray) -> None:
        self.count = 1
        self._topic = topic
        self._arrays = [np.array([row]) for row in first]
        self._early: dict[int, tuple[np.ndarray, ...]] = {}

    def add(self, first: int, pieces: tuple[np.ndarray, ...]) -> str:
        """Take pieces of equal length whose first row has index `first`; returns what is wrong."""
        if first == 0:
            return f"{self._topic}: index 0, the failure state, which is never published"
        if first < self.count or first in self._early:
            return f"{self._topic}: index {first} came twice"
        if len(pieces[0]):
            self._early[first] = pieces
        while self.count in self._early:
            self._append(self._early.pop(self.count))
        if self._early and min(self._early) < self.count:
            return f"{self._topic}: index {min(self._early)} came twice"
        return ""

    def _append(self, pieces: tuple[np.ndarray, ...]) -> None:
        end = self.count + len(pieces[0])
        for array, piece in zip(self._arrays, pieces, strict=True):
            if end > len(array):  # in place: large arrays are moved by the kernel, not copied
                array.resize((end + end // 8, *array.shape[1:]), refcheck=False)
            array[self.count : end] = piece
        self.count = end

    def missing(self) -> str:
        """Where there is a gap, in words; empty if there is none."""
        if not self._early:
            return ""
        return (
            f"{self._topic}: from index {self.count} to before {min(self._early)} nothing has come"
        )

    def joined(self) -> list[np.ndarray]:
        """The arrays, row 0 and all that came."""
        for array in self._arrays:
            array.resize((self.count, *array.shape[1:]), refcheck=False)
        return self._arrays


class MeshAssembly:
    """One mesh, put together from its messages, in whichever order they come.

    A middleware may hand a late subscriber new messages before those that were kept for it, the
    topics may be ahead of one another, and messages of other meshes may lie between. The indices
    in the messages tell what belongs where, and the counts in the last `MeshInfo` whether all of
    it has come. So a message that was lost never shows as such: the mesh stays incomplete, and
    whoever waits decides for how long.

    Messages are objects with the fields of `MeshInfo`, `MeshStates` and `MeshTransitions`, as
    rclpy or a reader of bags makes them.

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
        Status of the info that closed the mesh, or of the one that opened it.
    problem : str
        Why the mesh can never become complete; empty as long as it can.
    """

    _early: list[tuple[Callable[[Any], None], Any]]

    def __init__(self, mesh_id: str) -> None:
        self.mesh_id = mesh_id
        self.settings: MeshSettings | None = None
        self.step_map = ""
        self.status: int | None = None
        self.problem = ""
        self._final: Any = None
        self._forget()
        self._mesh: Mesh | None = None

    @property
    def complete(self) -> bool:
        """Whether all of it is there, so that `mesh` will return it."""
        final = self._final
        return (
            not self.problem
            and final is not None
            and self._states.count == self._rows.count == final.states
        )

    @property
    def missing(self) -> str:
        """What is missing, in words; empty if nothing is."""
        if self.problem:
            return self.problem
        if self.status is None:
            return "nothing says what it is a mesh of"
        parts = [self._states.missing(), self._rows.missing()]
        if self._final is None:
            parts.insert(0, f"it is not finished: {self._states.count} states so far")
        elif not self.complete:
            parts.insert(
                0,
                f"of {self._final.states} states {self._states.count} have come, and the "
                f"transitions of {self._rows.count} (x_1 counted)",
            )
        return "; ".join(filter(None, parts))

    def add_info(self, message: Any) -> None:
        """Take a `MeshInfo`."""
        if self.problem:
            return
        if self.status in (None, MeshInfo.GROWING):
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
            m = len(self.settings.slopes)
            fallen = np.zeros(m, np.uint32), np.full(m, NOT_SIMULATED, np.uint8)
            self._rows = _Pieces("mesh/transitions", *fallen)
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
        if self._mesh is None:
            if not self.complete:
                raise IncompleteMesh(f"mesh {self.mesh_id} cannot be used: {self.missing}")
            try:
                self._mesh = self._joined()
            except InputError as error:
                self._spoil(str(error))
                raise IncompleteMesh(f"mesh {self.mesh_id} cannot be used: {error}") from None
        return self._mesh

    def _joined(self) -> Mesh:
        assert self.settings is not None
        states, preceding, generation = self._states.joined()
        targets, outcomes = self._rows.joined()
        return Mesh(
            slopes=self.settings.slopes,
            states=states,
            preceding=preceding,
            generation=generation,
            targets=targets,
            outcomes=outcomes,
            scales=unpacked(self._final.scales, "d"),
            threshold=self.settings.threshold,
            clustered=self.settings.clustered,
        )

    def _spoil(self, problem: str) -> None:
        """Give the mesh up, and the memory of what has come of it."""
        self.problem = problem
        self._forget()

    def _forget(self) -> None:
        self._early = []
        zero = np.uint32(0)
        self._states = _Pieces("mesh/states", np.zeros(STATE_SIZE), zero, zero)
        self._rows = _Pieces("mesh/transitions")

    def _take(self, take: Callable[[Any], None], message: Any) -> None:
        # The arrays of a mesh that was handed out are not touched any more.
        if self.problem or self._mesh is not None:
            return
        # Without the slope set nothing can be checked.
        if self.settings is None:
            self._early.append((take, message))
        else:
            take(message)

    def _take_states(self, message: Any) -> None:
        states, preceding = unpacked(message.states, "d"), unpacked(message.preceding, "I")
        if states.size != STATE_SIZE * preceding.size:
            self._spoil(f"mesh/states: {states.size} numbers for {preceding.size} states")
            return
        generation = np.broadcast_to(np.uint32(message.generation), preceding.shape)
        rows = states.reshape(-1, STATE_SIZE)
        self._add(self._states, message.first_index, (rows, preceding, generation))

    def _take_transitions(self, message: Any) -> None:
        assert self.settings is not None
        m = len(self.settings.slopes)
        targets, outcomes = unpacked(message.targets, "I"), unpacked(message.outcomes, "B")
        if targets.size % m or outcomes.size != targets.size:
            self._spoil(
                f"mesh/transitions: {targets.size} targets and {outcomes.size} outcomes for rows "
                f"of {m} slopes"
            )
            return
        rows = targets.reshape(-1, m), outcomes.reshape(-1, m)
        self._add(self._rows, message.first_index, rows)

    def _add(self, pieces: _Pieces, first: int, arrays: tuple[np.ndarray, ...]) -> None:
        wrong = pieces.add(first, arrays)
        if wrong:
            self._spoil(wrong)
        else:
            self._check_counts()

    def _check_counts(self) -> None:
        came = max(self._states.count, self._rows.count)
        if self._final is not None and came > self._final.states:
            self._spoil(
                f"{self._states.count} states and {self._rows.count} rows of transitions came, "
                f"more than the {self._final.states} that it has (x_1 counted)"
            )
