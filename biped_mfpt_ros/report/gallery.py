"""All pictures of a controller: its gait on rough ground up to the fall, its mesh, its falls."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from pathlib import Path

from biped_mfpt_ros.chain.markov import metastability
from biped_mfpt_ros.chain.mesh import Mesh
from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.trace import trace_swing
from biped_mfpt_ros.report import gaits, mesh_pictures
from biped_mfpt_ros.report.style import Picture
from biped_mfpt_ros.walker.robot import WalkerModel

_SOURCES = ("gaits.py", "gallery.py", "mesh_pictures.py", "pictures.py", "style.py")
_TRIES = 20  # walks, of which the first that is long enough is drawn
_LONG_ENOUGH = 5  # steps


def drawing() -> str:
    """Digest of the code that draws: pictures of other code are others."""
    digest = hashlib.sha256()
    for name in _SOURCES:
        digest.update(Path(__file__).with_name(name).read_bytes())
    return digest.hexdigest()[:12]


def gallery(
    controller: Controller,
    model: WalkerModel,
    state: Sequence[float],
    sigma_deg: float,
    mesh: Mesh | None,
    *,
    animated: bool = True,
) -> list[Picture]:
    """Draw the pictures of a controller.

    Parameters
    ----------
    controller : Controller
        What walks.
    model : WalkerModel
        Torque limit, friction and so on.
    state : sequence of float
        On the limit cycle on flat ground, ``[q, dq]``, rad and rad/s, ten numbers.
    sigma_deg : float
        Degrees, standard deviation of the slope.
    mesh : Mesh or None
        Of the controller; None leaves out what is drawn of it.
    animated : bool, optional
        Whether to draw the animation, which takes longest.
    """
    sigma_s = math.radians(sigma_deg)
    cycle = find_limit_cycle(controller, 0.0, model, state)
    for number in range(_TRIES):
        walk = gaits.rough_walk(controller, sigma_s, number=number, model=model, state=state)
        if walk.steps >= _LONG_ENOUGH:
            break
    flat = trace_swing(controller, cycle.state, 0.0, 0.0, model)
    out = [gaits.gait(walk)]
    if animated:
        out.append(gaits.animation(walk))
    out += [
        gaits.phase_portraits(walk, cycle),
        gaits.torques({"flat ground": flat, "the fall": walk.swings[-1]}, model, controller.name),
    ]
    if mesh is not None:
        found = metastability(mesh, 0.0, sigma_s)
        about = (0.0, sigma_s, controller.name)
        out += [
            mesh_pictures.mesh_plane(mesh, controller.name),
            mesh_pictures.mesh_distribution(mesh, found, *about),
            mesh_pictures.where_it_falls(mesh, found, *about),
        ]
    return out
