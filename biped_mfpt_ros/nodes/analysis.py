"""The analysis: puts published meshes together and publishes their mean first-passage times."""

from __future__ import annotations

import math
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from biped_mfpt_msgs.msg import MeshInfo, MeshStates, MeshTransitions, MfptEstimate
from biped_mfpt_msgs.srv import ComputeMfpt
from rclpy.node import Node

from biped_mfpt_ros.chain.markov import TOLERANCE, ChainError, metastabilities
from biped_mfpt_ros.chain.mesh import NOT_SIMULATED, Mesh
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.nodes.assembly import IncompleteMesh, MeshAssembly
from biped_mfpt_ros.nodes.fair_service import FairService
from biped_mfpt_ros.nodes.messages import estimate_message, unpacked
from biped_mfpt_ros.nodes.parameters import Declared, NodeParameters, parameter
from biped_mfpt_ros.nodes.publishers import CountedPublisher
from biped_mfpt_ros.nodes.qos import RESULTS
from biped_mfpt_ros.nodes.spin import run_node
from biped_mfpt_ros.nodes.warm_up import compiled
from biped_mfpt_ros.walker.robot import STATE_SIZE
from biped_mfpt_ros.walker.terrain import SLOPE_LIMIT_DEG

_MOST_UNFINISHED = 64  # meshes being put together, before the oldest is given up
_MOST_REASONS = 256  # remembered, why meshes cannot be used
_MOST_WAITING = 64  # requests
_MOST_SIGMAS = 10_000  # in one request
_PROGRESS_EVERY = 5.0  # s
_SIGMAS_AT_ONCE = 64
_PATIENCE = 10.0  # s, for messages of a mesh that was closed
_MOST_CORRELATION = 0.999  # of the parameter: its range includes the ends, and 1 is not allowed


@dataclass(frozen=True)
class AnalysisParameters(NodeParameters):
    """Parameters of the analysis."""

    sigma_s_deg: tuple[float, ...] = parameter(
        (1.0, 2.0), "degrees, standard deviations of the slope to publish MFPT for", 1e-3, 90.0
    )
    mu_s_deg: float = parameter(
        0.0, "degrees, mean slope to publish MFPT for", -SLOPE_LIMIT_DEG, SLOPE_LIMIT_DEG
    )
    correlation: float = parameter(
        0.0,
        "correlation of each slope with the one before to publish MFPT for; 0: independent",
        -_MOST_CORRELATION,
        _MOST_CORRELATION,
    )
    keep_meshes: int = parameter(4, "complete meshes kept for compute_mfpt", 1, 10_000)
    keep_states: int = parameter(
        2_000_000, "states of all kept meshes together; the newest is kept anyway", 1, 2**31 - 1
    )


@dataclass(frozen=True)
class _Known:
    mesh: Mesh
    controller: str


def warm_up() -> None:
    """Solve chains of one state, so that what solves them is compiled."""
    slopes, outcomes = np.array([0.0, 0.1]), np.array([[NOT_SIMULATED] * 2, [0, 1]])
    states = np.zeros((2, STATE_SIZE))
    index, targets = np.zeros(2, np.uint32), np.array([[0, 0], [1, 0]])
    mesh = Mesh(slopes, states, index, index, targets, outcomes, np.ones(STATE_SIZE), 1.0, True)
    metastabilities(mesh, 0.0, [0.1])


class Analysis(Node):
    """Publishes `MfptEstimate` for every mesh, and serves `ComputeMfpt` for the last few.

    Chains are built and solved in a thread of their own, so that no message has to wait.
    """

    def __init__(self) -> None:
        super().__init__("analysis")
        self._declared = Declared(self, AnalysisParameters)
        with compiled(self.get_logger().info, "chain"):
            warm_up()
        self._estimates = CountedPublisher(self, MfptEstimate, "mfpt", RESULTS)
        self._unfinished: dict[str, MeshAssembly] = {}
        self._due: dict[str, float] = {}
        self._finishing: set[str] = set()
        self._known: dict[str, _Known] = {}
        self._unusable: dict[str, str] = {}
        self._lock = threading.Lock()
        self._thread = ThreadPoolExecutor(1, "chain")
        self.create_subscription(
            MeshInfo, "mesh/info", lambda m: self._add(m, MeshAssembly.add_info), RESULTS
        )
        self.create_subscription(
            MeshStates, "mesh/states", lambda m: self._add(m, MeshAssembly.add_states), RESULTS
        )
        self.create_subscription(
            MeshTransitions,
            "mesh/transitions",
            lambda m: self._add(m, MeshAssembly.add_transitions),
            RESULTS,
        )
        self.create_timer(1.0, self._give_up_overdue)
        FairService(self, ComputeMfpt, "compute_mfpt", _MOST_WAITING, self._thread, self._compute)
        self.get_logger().info("ready")

    def close(self) -> None:
        """Stop computing."""
        self._thread.shutdown(wait=True, cancel_futures=True)

    def _add(self, message: Any, add: Callable[[MeshAssembly, Any], None]) -> None:
        mesh_id = message.mesh_id
        if mesh_id in self._unusable or mesh_id in self._known or mesh_id in self._finishing:
            return
        assembly = self._unfinished.get(mesh_id)
        if assembly is None:
            assembly = self._unfinished[mesh_id] = MeshAssembly(mesh_id)
            if len(self._unfinished) > _MOST_UNFINISHED:
                oldest = next(iter(self._unfinished.values()))
                self._give_up(
                    oldest, f"{oldest.missing}; {_MOST_UNFINISHED} others were begun after it"
                )
        add(assembly, message)
        if assembly.problem:
            self._give_up(assembly, assembly.problem)
        elif assembly.complete:
            del self._unfinished[mesh_id]
            self._due.pop(mesh_id, None)
            self._finishing.add(mesh_id)
            self._thread.submit(self._finish, assembly, self._declared.now)
        elif assembly.status == MeshInfo.COMPLETE:
            self._due[mesh_id] = time.monotonic() + _PATIENCE

    def _finish(self, assembly: MeshAssembly, parameters: AnalysisParameters) -> None:
        """Put a mesh together and publish its estimates; in the thread of chains."""
        mesh_id = assembly.mesh_id
        try:
            assert assembly.settings is not None
            known = _Known(assembly.mesh(), assembly.settings.controller.name)
            self._keep(mesh_id, known, parameters)
            sigmas = [math.radians(sigma_deg) for sigma_deg in parameters.sigma_s_deg]
            mu_s = math.radians(parameters.mu_s_deg)
            found = self._solve(mesh_id, known, mu_s, sigmas, parameters.correlation)
            for sigma_deg, estimate in zip(parameters.sigma_s_deg, found, strict=True):
                if isinstance(estimate, ChainError):
                    self.get_logger().error(
                        f"{mesh_id}: no MFPT at sigma_s {sigma_deg:g} degrees: {estimate}"
                    )
                    continue
                self._estimates.publish(estimate)
                self.get_logger().info(
                    f"{mesh_id}: MFPT {estimate.mfpt:.6g} steps at sigma_s {sigma_deg:g} degrees"
                )
        except IncompleteMesh as error:
            self._remember(mesh_id, str(error))
            self.get_logger().error(str(error))
        except InputError as error:
            self.get_logger().error(f"{mesh_id}: no MFPT: {error}")
        except Exception:
            if self.context.ok():
                self.get_logger().error(f"{mesh_id}: no MFPT\n{traceback.format_exc()}")
        self._finishing.discard(mesh_id)

    def _keep(self, mesh_id: str, known: _Known, parameters: AnalysisParameters) -> None:
        """Keep a mesh, and let go of the oldest ones that there is no room for."""
        self._known[mesh_id] = known
        while len(self._known) > 1 and (
            len(self._known) > parameters.keep_meshes
            or sum(len(k.mesh.states) for k in self._known.values()) > parameters.keep_states
        ):
            oldest = next(iter(self._known))
            self._remember(
                oldest,
                f"only the last {parameters.keep_meshes} meshes are kept, of at most "
                f"{parameters.keep_states} states together",
            )
            del self._known[oldest]

    def _solve(
        self, mesh_id: str, known: _Known, mu_s: float, sigmas: list[float], correlation: float
    ) -> Iterator[MfptEstimate | ChainError]:
        """Estimates for several sigma_s, with progress in the log if that takes long."""
        start = said = time.perf_counter()
        # What a result brings with it is as long as the mesh: not too many at once.
        for first in range(0, len(sigmas), _SIGMAS_AT_ONCE):
            batch = sigmas[first : first + _SIGMAS_AT_ONCE]

            def on_progress(solved: int, steps: int, missing: float, first: int = first) -> None:
                nonlocal said
                now = time.perf_counter()
                if now - said > _PROGRESS_EVERY:
                    said = now
                    self.get_logger().info(
                        f"{mesh_id}: chain of {len(known.mesh.states)} states, {first + solved} of "
                        f"{len(sigmas)} sigma_s done in {now - start:.0f} s; {steps} steps of the "
                        f"next, {missing:.0e} to go, ends at {TOLERANCE:.0e}"
                    )

            begun = time.perf_counter()
            try:
                found = metastabilities(
                    known.mesh, mu_s, batch, correlation=correlation, on_progress=on_progress
                )
            except InputError as error:
                if error.field.startswith("sigma_s["):
                    index = int(error.field[len("sigma_s[") : -1])
                    raise InputError(
                        f"sigma_s[{first + index}]", error.value, error.allowed
                    ) from None
                raise
            seconds = (time.perf_counter() - begun) / len(batch)
            for sigma_s, result in zip(batch, found, strict=True):
                yield (
                    result
                    if isinstance(result, ChainError)
                    else estimate_message(
                        mesh_id,
                        known.controller,
                        known.mesh,
                        mu_s,
                        sigma_s,
                        correlation,
                        result,
                        seconds,
                    )
                )

    def _give_up(self, assembly: MeshAssembly, reason: str) -> None:
        del self._unfinished[assembly.mesh_id]
        self._due.pop(assembly.mesh_id, None)
        self._remember(assembly.mesh_id, reason)
        text = f"mesh {assembly.mesh_id} cannot be used: {reason}"
        # Two calls: rclpy wants each to keep its severity.
        if assembly.status in (MeshInfo.FAILED, MeshInfo.CANCELLED):
            self.get_logger().info(text)
        else:
            self.get_logger().error(text)

    def _remember(self, mesh_id: str, reason: str) -> None:
        with self._lock:
            self._unusable[mesh_id] = reason
            if len(self._unusable) > _MOST_REASONS:
                del self._unusable[next(iter(self._unusable))]

    def _give_up_overdue(self) -> None:
        for mesh_id, due in list(self._due.items()):
            if time.monotonic() > due:
                assembly = self._unfinished[mesh_id]
                self._give_up(assembly, f"{assembly.missing}; messages were lost")

    def _compute(
        self, request: ComputeMfpt.Request, response: ComputeMfpt.Response
    ) -> ComputeMfpt.Response:
        """Answer a request; in the thread of chains."""
        estimates: list[MfptEstimate] = []
        try:
            mesh_id, known = self._find(request.mesh_id)
            sigmas = unpacked(request.sigma_s, "d").tolist()
            if not 1 <= len(sigmas) <= _MOST_SIGMAS:
                raise InputError(
                    "sigma_s", f"{len(sigmas)} numbers", f"1 to {_MOST_SIGMAS} numbers"
                )
            found = self._solve(mesh_id, known, request.mu_s, sigmas, request.correlation)
            for i, estimate in enumerate(found):
                if isinstance(estimate, ChainError):
                    raise ChainError(f"sigma_s[{i}]: {estimate}")
                estimates.append(estimate)
            response.estimates = estimates
            response.success = True
        except (InputError, ChainError) as error:
            response.message = str(error)
        except Exception as error:
            self.get_logger().error(f"compute_mfpt failed\n{traceback.format_exc()}")
            response.message = f"internal error of the analysis: {error!r}"
        return response

    def _find(self, mesh_id: str) -> tuple[str, _Known]:
        if not mesh_id and self._known:
            mesh_id = next(reversed(self._known))
        if mesh_id in self._known:
            return mesh_id, self._known[mesh_id]
        why = self._unusable.get(mesh_id, "")
        if not why and mesh_id in self._unfinished:
            why = self._unfinished[mesh_id].missing
        complete = ", ".join(reversed(self._known)) or "none is complete yet"
        allowed = f"a complete mesh: {complete}"
        raise InputError("mesh_id", mesh_id, f"{allowed} (this one: {why})" if why else allowed)


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit code."""
    return run_node(Analysis, args)
