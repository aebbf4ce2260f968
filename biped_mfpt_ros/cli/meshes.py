"""Commands that mesh a controller in this process, without ROS."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

from biped_mfpt_ros.chain.mesh import Mesh, grow_mesh
from biped_mfpt_ros.cli import options
from biped_mfpt_ros.cli.growth import Growth
from biped_mfpt_ros.cli.kernels import work
from biped_mfpt_ros.cli.output import json_text
from biped_mfpt_ros.cli.results import estimate_row, mfpt_table, slope_set_notes
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.files import whole_file
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.report.progress import duration_text
from biped_mfpt_ros.report.tables import ground_text, plural

_MESH_ARRAYS = (
    "slopes", "states", "preceding", "generation", "targets", "outcomes", "scales",
)  # fmt: skip


def mesh(args: argparse.Namespace) -> None:
    """Mesh a controller's reachable states."""
    if args.output is not None and Path(args.output).exists():
        raise InputError("--output", args.output, "a file that does not exist yet")
    grown, result = grow(args)
    if args.output is not None:
        # Under the name that was given: numpy would add an ending to a name.
        with whole_file(args.output, new=True) as file:
            np.savez_compressed(
                file,
                **{name: getattr(grown, name) for name in _MESH_ARRAYS},
                threshold=grown.threshold,
                clustered=grown.clustered,
            )
        result["output"] = args.output
    if args.json:
        print(json_text(result))
        return
    print(_mesh_text(result))
    if args.output is not None:
        print(f"written to {args.output}")


def mfpt(args: argparse.Namespace) -> None:
    """Mesh a controller and compute its MFPT."""
    from biped_mfpt_ros.chain.markov import ChainError, metastabilities

    mean = options.mean_of(args)
    sigmas = [options.spread("--sigma", sigma) for sigma in args.sigma]
    correlation = options.correlation_of(args)
    grown, result = grow(args)
    start = time.perf_counter()
    estimates = []
    with work(args.quiet):
        solved = metastabilities(grown, mean, sigmas, correlation=correlation)
    for sigma_deg, found in zip(args.sigma, solved, strict=True):
        if isinstance(found, ChainError):
            raise found
        estimates.append(
            estimate_row(
                args.controller, args.mean, sigma_deg, correlation, found, found.failure_shares
            )
        )
    result |= {
        "mu_s": mean,
        "correlation": correlation,
        "estimates": estimates,
        "notes": slope_set_notes(
            estimates, args.slope_step, args.slope_limit, args.mean, correlation
        ),
        "chain_seconds": time.perf_counter() - start,
    }
    if args.json:
        print(json_text(result))
        return
    print(_mesh_text(result) + ground_text(args.mean, correlation))
    print()
    print(mfpt_table(estimates))
    if result["notes"]:
        print("\n" + "\n".join(result["notes"]))


def grow(args: argparse.Namespace) -> tuple[Mesh, dict[str, Any]]:
    """Grow the mesh that the options ask for; also what describes it, for JSON."""
    controller, model = options.walker_of(args)
    slopes = options.slopes_of(args)
    settings = options.mesh_settings(args)
    with work(args.quiet) as progress, Growth(controller, slopes, model, progress) as by:
        initial = find_limit_cycle(controller, 0.0, model).state
        start = time.perf_counter()
        grown = grow_mesh(
            by.simulate, initial, slopes, args.threshold, on_generation=by.on_generation, **settings
        )
        seconds = time.perf_counter() - start
    return grown, options.described(controller, model) | {
        "slope_step_deg": args.slope_step,
        "slope_limit_deg": args.slope_limit,
        "slopes": len(slopes),
        "threshold": grown.threshold,
        "clustered": grown.clustered,
        "scale_refresh": args.scale_refresh or "generation",
        "states": len(grown.states),
        "generations": int(grown.generation.max()) + 1,
        "swings": by.swings,
        "seconds": seconds,
        "step_map_seconds": by.seconds,
    }


def _mesh_text(result: dict[str, Any]) -> str:
    return (
        f"{result['controller']}: {plural(result['states'], 'state')} in "
        f"{plural(result['generations'], 'generation')}, "
        f"{plural(result['slopes'], 'slope')}, {duration_text(result['seconds'])}"
    )
