"""RABBIT in a general rigid-body engine, MuJoCo: the same swing, its stance foot a hinge.

Not needed to run anything but this comparison: ``pip install -r requirements/bench.txt``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from biped_mfpt_ros.walker.robot import Robot

try:
    import mujoco
    from mujoco import rollout
except ImportError:
    mujoco = None

_LINK = """<body pos="0 0 {at}"><joint type="hinge" axis="0 -1 0"/>
<inertial pos="0 0 {com}" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>"""


class RigidBody:
    """The five links as a chain of hinges from the stance foot, without contacts.

    Its joints turn by ``a_3``, ``a_1 - a_3``, ``a_5 - a_1``, ``a_2 - a_5`` and ``a_4 - a_2``, of
    the absolute angles a_1 to a_5: from the stance tibia over femur, torso and swing femur to the
    swing tibia.

    Parameters
    ----------
    robot : Robot
        The links.
    step : float
        s, of the integrator: the semi-implicit Euler method, MuJoCo's fastest.
    """

    def __init__(self, robot: Robot, step: float) -> None:
        femur, tibia = robot.femur_length, robot.tibia_length
        links = (
            (0.0, robot.tibia_com - tibia, robot.tibia_mass, robot.tibia_inertia),
            (-tibia, robot.femur_com - femur, robot.femur_mass, robot.femur_inertia),
            (-femur, robot.torso_com, robot.torso_mass, robot.torso_inertia),
            (0.0, robot.femur_com, robot.femur_mass, robot.femur_inertia),
            (femur, robot.tibia_com, robot.tibia_mass, robot.tibia_inertia),
        )
        bodies = "".join(
            _LINK.format(at=at, com=com, mass=mass, inertia=inertia)
            for at, com, mass, inertia in links
        )
        self.model = mujoco.MjModel.from_xml_string(
            f'<mujoco><compiler boundmass="0" boundinertia="0"/>'
            f'<option timestep="{step}" gravity="0 0 {-robot.gravity}">'
            f'<flag contact="disable" constraint="disable"/></option>'
            f"<worldbody>{bodies}{'</body>' * 5}</worldbody></mujoco>"
        )
        self.data = mujoco.MjData(self.model)

    def run(
        self, y: np.ndarray, duration: float, torques: Callable[[np.ndarray], np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Integrate a swing, the controller asked once every step.

        Parameters
        ----------
        y : numpy.ndarray
            Absolute angles (rad) and rates (rad/s) at the start, shape (10,).
        duration : float
            s, a multiple of the step.
        torques : callable
            Such a state to u1 to u4, N m.

        Returns
        -------
        y, applied : numpy.ndarray
            The state at the end, and the joints' torques step by step, shape (steps, 5).
        """
        data = self.data
        mujoco.mj_resetData(self.model, data)
        order = [2, 0, 4, 1, 3]  # absolute angles along the chain
        for half, joints in ((y[:5], data.qpos), (y[5:], data.qvel)):
            joints[:] = np.diff(half[order], prepend=0.0)
        applied = np.empty((round(duration / self.model.opt.timestep), 5))
        out = np.empty(10)
        for k in range(len(applied) + 1):
            out[order] = np.cumsum(data.qpos)
            out[[5 + i for i in order]] = np.cumsum(data.qvel)
            if k < len(applied):
                u = torques(out)
                applied[k] = 0.0, -u[2], -u[0], u[1], u[3]
                data.qfrc_applied[:] = applied[k]
                mujoco.mj_step(self.model, data)
        return out, applied

    def repetition(self, y: np.ndarray, applied: np.ndarray) -> Callable[[], Any]:
        """The same swing again with the torques found, all of it inside of the engine.

        No controller is computed then, and Python is entered once.
        """
        control = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
        self.run(y, 0.0, lambda _: np.zeros(4))
        size = mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        start = np.empty(size)
        mujoco.mj_getState(self.model, self.data, start, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        states = np.empty((1, len(applied), size))
        return lambda: rollout.rollout(
            self.model,
            self.data,
            start,
            applied[None],
            control_spec=control,
            state=states,
            skip_checks=False,
        )
