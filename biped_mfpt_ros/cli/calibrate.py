"""`biped-mfpt calibrate`: the settings that the paper leaves unsaid, fitted to its numbers."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable
from concurrent.futures import as_completed
from pathlib import Path
from typing import Any

from biped_mfpt_ros.chain.mesh import SCALE_REFRESHES
from biped_mfpt_ros.cli.kernels import compile_all
from biped_mfpt_ros.cli.output import json_text, plain
from biped_mfpt_ros.cli.workers import workers
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.report import paper
from biped_mfpt_ros.report.progress import Progress
from biped_mfpt_ros.report.tables import number, table
from biped_mfpt_ros.study.calibrate import (
    MODEL_PARAMETERS,
    Fit,
    Grid,
    Judged,
    fit,
    reading,
    reading_job,
    scatter,
    scatter_job,
    sharings,
)
from biped_mfpt_ros.study.plan import Job
from biped_mfpt_ros.study.readings import readings
from biped_mfpt_ros.study.store import Store


def calibrate(args: argparse.Namespace) -> None:
    """Judge a grid of readings by the paper's numbers."""
    names = tuple(dict.fromkeys(args.controllers))
    for name in names:
        controller(name)
        if paper.monte_carlo_sigma_deg(name) is None:
            raise InputError("--controllers", name, "controllers of the paper's Tables 2 and 4")
    if args.walks < 2:
        raise InputError("--walks", args.walks, "a whole number >= 2")
    number_of_workers = len(os.sched_getaffinity(0)) if args.workers is None else args.workers
    if number_of_workers < 1:
        raise InputError("--workers", number_of_workers, "a whole number >= 1")
    values = {name: tuple(sorted(set(getattr(args, name)))) for name in MODEL_PARAMETERS}
    grid = Grid(values | {"scale_refresh": SCALE_REFRESHES}, args.tolerance)
    models = list(grid.models())  # checks every value
    jobs = {
        (name, index): reading_job(name, model, args.walks, args.seed)
        for index, model in models
        for name in names
    }
    scatters = {name: scatter_job(name, readings()[name].model) for name in names}
    store = Store(Path(args.output) / "results")
    with Progress(quiet=args.quiet) as progress:
        results = _results(list(jobs.values()), reading, store, number_of_workers, progress)
        spread = _results(list(scatters.values()), scatter, store, number_of_workers, progress)
    judged = {
        name: Judged(
            name,
            grid,
            {index: results[jobs[name, index].name] for index, _ in models},
            spread[scatters[name].name]["scatter"],
        )
        for name in names
    }
    fits = [fit(judged, grid, sharing) for sharing in sharings(names)]
    print(json_text(_report(fits, judged, args)) if args.json else _text(fits, judged))


def _results(
    jobs: list[Job],
    do: Callable[[Job], dict[str, Any]],
    store: Store,
    number_of_workers: int,
    progress: Progress,
) -> dict[str, dict[str, Any]]:
    """Result of every job by its name; those that an earlier run left are not done again."""
    found = {job.name: result for job in jobs if (result := store.get(job)) is not None}
    missing = [job for job in jobs if job.name not in found]
    if found and missing:
        progress.say(f"{len(found)} of {len(jobs)} results are there from an earlier run")
    if not missing:
        return found
    compile_all(progress.say)
    with workers(min(number_of_workers, len(missing))) as pool:
        given = {pool.submit(do, job): job for job in missing}
        for done, future in enumerate(as_completed(given)):
            job = given[future]
            found[job.name] = plain(future.result())
            store.put(job, found[job.name])
            progress.count("readings", done + 1, len(missing), "readings of a controller")
    return found


def _value(value: Any) -> str:
    return value if isinstance(value, str) else number(value)


def _names(group: tuple[str, ...], names: tuple[str, ...]) -> str:
    return "all" if group == names else " ".join(group)


def _text(fits: list[Fit], judged: dict[str, Judged]) -> str:
    names = tuple(judged)
    parts = []
    for found in fits:
        lines = [found.sharing.title.upper()]
        if not found.readings:
            parts.append("\n".join([*lines, "No reading of the grid fulfils all that is claimed."]))
            continue
        rows = [
            (
                name,
                *(_value(v) for v in found.readings[name].values()),
                *(f"{100.0 * math.expm1(r):+.1f} %" for r in found.residuals[name]),
            )
            for name in names
        ]
        headers = ("", "N m", "friction", "slip s", "frame", "r_i", "Monte Carlo", "chain")
        freedom = max(1, found.numbers - found.free)
        lines += [
            table(headers, rows),
            f"chi squared {number(found.chi_squared)} for {found.numbers} numbers less "
            f"{found.free} parameters: {number(found.chi_squared / freedom)} each; Monte Carlo "
            f"is off by {100.0 * found.typical:.1f} % (root mean square)",
            table(
                ("parameter", "of", "best and as good", "chi squared at each value"),
                [
                    (
                        parameter,
                        _names(group, names),
                        ", ".join(_value(v) for v in found.as_good(profile)),
                        "  ".join(f"{_value(v)}: {number(c)}" for v, c in profile),
                    )
                    for parameter, group, profile in found.profiles
                    if len(profile) > 1
                ],
            ),
        ]
        parts.append("\n\n".join(lines))
    claims = [
        (name, count, what) for name in names for what, count in sorted(judged[name].failed.items())
    ]
    if claims:
        parts.append(
            "READINGS THAT BREAK WHAT THE PAPER CLAIMS\n\n" + table(("", "models", "what"), claims)
        )
    parts.append(
        "Differences are ours less the paper's. A residual ln(ours / paper) counts in units of "
        "what\nchance allows: the standard errors of both means, or how far the estimates of "
        "meshes as coarse\nas the paper's scatter. Values are as good as the best where chi "
        "squared is within 1 of it,\nor within its share for each degree of freedom if that is "
        "more."
    )
    return "\n\n\n".join(parts)


def _report(fits: list[Fit], judged: dict[str, Judged], args: argparse.Namespace) -> dict[str, Any]:
    return {
        "walks": args.walks,
        "seed": args.seed,
        "tolerance": args.tolerance,
        "fits": [
            {
                "title": found.sharing.title,
                "chi_squared": found.chi_squared,
                "numbers": found.numbers,
                "free": found.free,
                "readings": found.readings,
                "residuals": {
                    name: {"monte_carlo": mean, "chain": chain}
                    for name, (mean, chain) in found.residuals.items()
                },
                "profiles": [
                    {
                        "parameter": parameter,
                        "controllers": group,
                        "as_good": found.as_good(profile),
                        "profile": [{"value": v, "chi_squared": c} for v, c in profile],
                    }
                    for parameter, group, profile in found.profiles
                ],
            }
            for found in fits
        ],
        "failed": {name: found.failed for name, found in judged.items()},
    }
