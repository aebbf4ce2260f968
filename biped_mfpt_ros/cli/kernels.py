"""`biped-mfpt compile`: the numeric kernels, before anything has to wait for them."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from scipy.sparse import csr_array

from biped_mfpt_ros.chain.aggregation import metastable_distribution
from biped_mfpt_ros.chain.markov import metastability
from biped_mfpt_ros.chain.mesh import grow_mesh
from biped_mfpt_ros.cli.output import json_text
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.gait.monte_carlo import monte_carlo
from biped_mfpt_ros.gait.step import simulate_steps
from biped_mfpt_ros.gait.trace import trace_swing
from biped_mfpt_ros.nodes.warm_up import announced, compiled
from biped_mfpt_ros.report.progress import Progress, duration_text
from biped_mfpt_ros.walker.robot import rabbit

_WHAT = "the numeric kernels"


@contextmanager
def work(quiet: bool) -> Iterator[Progress]:
    """A progress line for something that may have to compile kernels first, and says so then."""
    with Progress(quiet=quiet) as progress, announced(progress.say, _WHAT):
        yield progress


def compile_kernels(args: argparse.Namespace) -> None:
    """Compile every kernel."""
    start = time.perf_counter()
    with Progress(quiet=args.quiet) as progress:
        compile_all(progress.say)
    seconds = time.perf_counter() - start
    if args.json:
        print(json_text({"seconds": seconds}))
    else:
        print(f"all kernels are compiled, {duration_text(seconds)}")


def compile_all(say: Callable[[str], object]) -> None:
    """Run every kernel on something small; ``say`` is told when one has to be compiled."""
    walking, slopes = controller("hzd/base"), np.radians([-1.0, 0.0, 1.0])
    state = walking.reference_state(1.7, rabbit())
    with compiled(say, _WHAT):
        monte_carlo(walking, 0.1, 1, 0, state=state, threads=1)
        trace_swing(walking, state, 0.0, 0.0)
        for scale_refresh in ("generation", "addition"):
            mesh = grow_mesh(
                lambda states, previous: simulate_steps(walking, states, previous, slopes),
                state,
                slopes,
                1.0,
                scale_refresh=scale_refresh,
            )
        # Also what only few chains need: times from all states, and aggregation.
        _ = metastability(mesh, 0.0, 0.01).mfpt_from_state
        q = csr_array((np.full(4, 0.4), np.array([0, 1, 0, 1]), np.array([0, 2, 4])))
        metastable_distribution(q, np.full(2, 0.2), 1e-9)
