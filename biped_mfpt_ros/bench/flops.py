"""Counts the operations of an evaluation, by running the kernels on numbers that count.

``python -m biped_mfpt_ros.bench.flops`` prints them as JSON. It runs the kernels as Python, not
compiled, so it has a process of its own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

if __name__ == "__main__":
    os.environ["NUMBA_DISABLE_JIT"] = "1"

from biped_mfpt_ros.control import hzd
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.gait import integrate
from biped_mfpt_ros.gait.closed_loop import powers
from biped_mfpt_ros.gait.scratch import STATES
from biped_mfpt_ros.walker import dynamics
from biped_mfpt_ros.walker.robot import WalkerModel


class Counting:
    """A number that counts the operations it takes part in."""

    count = 0
    value: float

    def __init__(self, value: Any) -> None:
        self.value = float(value.value if isinstance(value, Counting) else value)

    def _with(self, result: float) -> Counting:
        Counting.count += 1
        return Counting(result)

    def __add__(self, other: Any) -> Counting:
        return self._with(self.value + Counting(other).value)

    def __sub__(self, other: Any) -> Counting:
        return self._with(self.value - Counting(other).value)

    def __rsub__(self, other: Any) -> Counting:
        return self._with(Counting(other).value - self.value)

    def __mul__(self, other: Any) -> Counting:
        return self._with(self.value * Counting(other).value)

    def __truediv__(self, other: Any) -> Counting:
        return self._with(self.value / Counting(other).value)

    def __mod__(self, other: float) -> float:
        return self.value % other

    def __neg__(self) -> Counting:
        return Counting(-self.value)

    def __abs__(self) -> Counting:
        return Counting(abs(self.value))

    def __lt__(self, other: Any) -> bool:
        return self.value < Counting(other).value

    def __gt__(self, other: Any) -> bool:
        return self.value > Counting(other).value

    def __eq__(self, other: object) -> bool:
        return self.value == Counting(other).value

    __radd__, __rmul__, __hash__ = __add__, __mul__, object.__hash__


def _count() -> dict[str, float]:
    """Additions, subtractions, multiplications and divisions, kernel by kernel."""
    control, model = controller("hzd/base"), WalkerModel()
    rob, par = model.packed(), control.packed(model.robot)
    state = control.reference_state(1.7, model.robot)
    y = [Counting(value) for value in dynamics.to_absolute(state)]
    a, da = tuple(y[:5]), tuple(y[5:])
    out: dict[str, float] = {}

    def counted(what: str, work: Any, *arguments: Any) -> Any:
        Counting.count = 0
        result = work(*arguments)
        out[what] = out.get(what, 0.0) + Counting.count
        return result

    s, c = counted("sines and cosines", dynamics.sines, a)
    alpha, beta = counted("controller", hzd.command, par, a, da)
    dda = counted("accelerations", dynamics.prescribed_motion, rob, s, c, da, alpha, beta)
    x, y = counted("torques", dynamics.link_accelerations, s, c, da, dda)
    u = counted("torques", dynamics.required_torques, rob, s, c, dda, x, y)
    counted("torques", powers, u, da)
    counted("forces", dynamics.ground_force, rob, x, y)
    # The integrator's own share: sums over the stages, then the estimate of the error.
    stages = integrate._STAGES[: integrate.STAGES]
    sums = STATES * sum(2 * len(stage) + 1 for stage in stages)
    sums += 4 * (2 * len(stages[-1]) + 1)
    out["integrator"] = (sums + STATES * (4 * 8 + 7)) / integrate.STAGES
    return out


def counted_flops() -> dict[str, float]:
    """Operations of an evaluation with no torque at its limit, by what they are for."""
    run = subprocess.run(
        [sys.executable, "-m", __name__], capture_output=True, text=True, check=True
    )
    return dict(json.loads(run.stdout))


if __name__ == "__main__":
    print(json.dumps(_count()))
