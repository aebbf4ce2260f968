"""The meshes in a bag, put together from their messages."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass

from biped_mfpt_msgs.msg import MeshInfo

from biped_mfpt_ros.bag.error import BagError
from biped_mfpt_ros.bag.reader import Bag
from biped_mfpt_ros.chain.mesh import Mesh
from biped_mfpt_ros.nodes.assembly import IncompleteMesh, MeshAssembly
from biped_mfpt_ros.nodes.messages import MeshSettings

_ADD = {
    "biped_mfpt_msgs/msg/MeshInfo": MeshAssembly.add_info,
    "biped_mfpt_msgs/msg/MeshStates": MeshAssembly.add_states,
    "biped_mfpt_msgs/msg/MeshTransitions": MeshAssembly.add_transitions,
}

_STATUS = {
    None: "unknown",
    MeshInfo.GROWING: "growing",
    MeshInfo.COMPLETE: "complete",
    MeshInfo.FAILED: "failed",
    MeshInfo.CANCELLED: "cancelled",
}


@dataclass(frozen=True, eq=False)
class RecordedMesh:
    """A mesh as a bag holds it.

    Parameters
    ----------
    mesh_id : str
    status : str
        ``complete``, ``growing``, ``failed`` or ``cancelled``, as published last; ``unknown`` if
        nothing was.
    mesh : Mesh or None
        None if anything of it is missing.
    problem : str
        Why there is no mesh; empty if there is one.
    settings : MeshSettings or None
        What was meshed; None if the bag does not say.
    step_map : str
        Identity of the step map that simulated it, empty if the bag does not say.
    seconds : float
        s, wall time that it took to grow.
    """

    mesh_id: str
    status: str
    mesh: Mesh | None
    problem: str
    settings: MeshSettings | None
    step_map: str
    seconds: float


def recorded_meshes(bag: Bag) -> Iterator[RecordedMesh]:
    """Put the meshes of a bag together, one after the other.

    Only the meshes that are not complete yet are held, so the bag may be much larger than memory.

    Parameters
    ----------
    bag : Bag

    Yields
    ------
    RecordedMesh
        Each complete mesh as its last message is read, then those that never became complete.

    Raises
    ------
    BagError
        The bag is damaged, or its messages are of another version of biped_mfpt_msgs.
    """
    unfinished: dict[str, MeshAssembly] = {}
    seconds: dict[str, float] = {}
    finished: set[str] = set()
    for read in bag.messages(types=_ADD):
        message, complete = read.message, None
        try:
            mesh_id = message.mesh_id
            if mesh_id in finished:
                continue
            assembly = unfinished.setdefault(mesh_id, MeshAssembly(mesh_id))
            _ADD[read.type_name](assembly, message)
            if read.type_name == "biped_mfpt_msgs/msg/MeshInfo":
                seconds[mesh_id] = message.seconds
            if assembly.complete:
                finished.add(mesh_id)
                complete = _recorded(unfinished.pop(mesh_id), seconds.pop(mesh_id))
        except AttributeError as error:
            raise BagError(
                bag.path,
                f"has messages of another version, without {error.name!r}",
                "messages of this version of biped_mfpt_msgs",
            ) from None
        if complete is not None:
            yield complete
    for mesh_id, assembly in unfinished.items():
        yield _recorded(assembly, seconds.get(mesh_id, 0.0))


def read_meshes(path: str | os.PathLike[str]) -> dict[str, RecordedMesh]:
    """Read all meshes of a bag into memory.

    Parameters
    ----------
    path : path-like
        The bag.

    Returns
    -------
    dict
        `RecordedMesh` by mesh_id.

    Raises
    ------
    BagError
        The bag is missing, cut off, damaged, or of another format.
    """
    return {recorded.mesh_id: recorded for recorded in recorded_meshes(Bag(path))}


def _recorded(assembly: MeshAssembly, seconds: float) -> RecordedMesh:
    mesh, problem = None, assembly.missing
    if not problem:
        try:
            mesh = assembly.mesh()
        except IncompleteMesh as error:
            problem = str(error)
    return RecordedMesh(
        mesh_id=assembly.mesh_id,
        status=_STATUS.get(assembly.status, "unknown"),
        mesh=mesh,
        problem=problem,
        settings=assembly.settings,
        step_map=assembly.step_map,
        seconds=seconds,
    )
