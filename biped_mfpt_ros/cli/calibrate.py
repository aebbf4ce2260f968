"""`biped-mfpt calibrate`: the settings that the paper leaves unsaid, fitted to its numbers."""

from __future__ import annotations

import argparse
import itertools
import math
from typing import Any

from biped_mfpt_ros.cli.kernels import work
from biped_mfpt_ros.cli.output import json_text
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.report import paper
from biped_mfpt_ros.report.tables import number, table
from biped_mfpt_ros.study.calibrate import FREE_PARAMETERS, Fit, Target, calibrate, determined
from biped_mfpt_ros.walker.robot import WalkerModel


def run(args: argparse.Namespace) -> None:
    """Judge a grid of readings."""
    targets = []
    for name in args.controllers:
        control = controller(name)
        sigma_deg = paper.monte_carlo_sigma_deg(name)
        mean = None if sigma_deg is None else paper.monte_carlo(name, 0.0, sigma_deg)
        if sigma_deg is None or mean is None:
            raise InputError("--controllers", name, "controllers of the paper's Tables 2 and 4")
        targets.append(Target(control, math.radians(sigma_deg), mean))
    grid = itertools.product(args.torque_limit, args.friction, args.slip_duration)
    models = [
        WalkerModel(
            torque_limit=limit, friction=friction, slip_duration=slip, tolerance=args.tolerance
        )
        for limit, friction, slip in grid
    ]
    with work(args.quiet) as progress:
        fits = calibrate(
            models,
            targets,
            args.walks,
            args.seed,
            lambda done, total: progress.count("readings", done, total, "readings"),
        )
    ranges = determined(fits)
    if args.json:
        print(json_text({"readings": [_row(fit) for fit in fits], "determined": ranges}))
        return
    headers = ("N m", "friction", "slip s", "all flat", "misfit", "noise", *args.controllers)
    print(
        table(
            headers,
            [
                (
                    *(getattr(fit.model, name) for name in FREE_PARAMETERS),
                    "yes" if all(fit.flat.values()) else "no",
                    f"{fit.misfit:.3f}",
                    f"{fit.noise:.3f}",
                    *(_mean_text(fit, target) for target in targets),
                )
                for fit in fits
            ],
        )
    )
    print("\nMean steps, difference from the paper's; misfit is the root mean square of")
    print("ln(mean / paper). As good as the best, within noise:")
    for name, (low, high) in ranges.items():
        print(f"  {name:14s} {number(low)} to {number(high)}")


def _mean_text(fit: Fit, target: Target) -> str:
    name = target.controller.name
    if fit.residuals[name] == -math.inf:
        return "falls at once"
    return f"{number(fit.walks[name].mean_steps)} ({math.expm1(fit.residuals[name]):+.1%})"


def _row(fit: Fit) -> dict[str, Any]:
    return {
        "model": {name: getattr(fit.model, name) for name in FREE_PARAMETERS},
        "misfit": fit.misfit,
        "noise": fit.noise,
        "controllers": {
            name: {
                "mean_steps": walked.mean_steps,
                "standard_error": walked.standard_error,
                "residual": fit.residuals[name],
                "flat_limit_cycle": fit.flat[name],
            }
            for name, walked in fit.walks.items()
        },
    }
