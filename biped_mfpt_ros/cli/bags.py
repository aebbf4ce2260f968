"""`biped-mfpt inspect`: what a bag holds, and its MFPT from the bag alone."""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from biped_mfpt_ros.cli import EXIT_FAILED, options
from biped_mfpt_ros.cli.node import require_ros
from biped_mfpt_ros.cli.output import json_text
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.report.progress import duration_text
from biped_mfpt_ros.report.tables import plural, table

if TYPE_CHECKING:
    from biped_mfpt_ros.bag.report import BagReport, MeshReport


def inspect(args: argparse.Namespace) -> int:
    """Report on a bag; fails if anything in it is missing or does not come out again."""
    sigmas = args.sigma and [options.spread("--sigma", sigma) for sigma in args.sigma]
    mean = None if args.mean is None else options.slope("--mean", args.mean)
    for option, value in (("--mean", mean), ("--correlation", args.correlation)):
        if value is not None and not sigmas:
            allowed = f"at least one standard deviation to go with {option}"
            raise InputError("--sigma", None, allowed)
    if (Path(args.bag) / "bag").is_dir():  # the directory of a run
        args.bag = str(Path(args.bag) / "bag")
    require_ros("biped_mfpt_msgs.msg")
    from biped_mfpt_ros.bag.repair import salvage
    from biped_mfpt_ros.bag.report import inspect_bag

    if args.repair is None:
        report = inspect_bag(args.bag, sigmas, mean, args.correlation)
    else:
        saved = salvage(args.bag, args.repair)
        if not args.quiet:
            count = plural(sum(saved.counts.values()), "message")
            print(f"saved {count} of {saved.source} in {saved.path}", file=sys.stderr)
        report = inspect_bag(saved.path, sigmas, mean, args.correlation)
        report.problems[:0] = [f"not saved of {saved.source}: {text}" for text in saved.missing]
    print(json_text(report.to_dict()) if args.json else _text(report))
    return EXIT_FAILED if report.problems or not report.identical else 0


def _text(report: BagReport) -> str:
    recorded = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(report.start))
    parts = [
        f"{report.path}: {plural(report.messages, 'message')} in {duration_text(report.duration)}, "
        f"{report.bytes / 1e6:.3g} MB, recorded {recorded}",
        table(
            ("topic", "messages", "missing", "repeated"),
            [(t.name, t.messages, t.missing, t.repeated) for t in report.topics],
        ),
        *map(_mesh_text, report.meshes),
    ]
    if report.problems:
        parts.append("\n".join(["not as it should be:", *(f"- {p}" for p in report.problems)]))
    return "\n\n".join(parts)


def _mesh_text(mesh: MeshReport) -> str:
    parts = [f"mesh {mesh.mesh_id}: {mesh.status}"]
    if mesh.problem:
        return f"{parts[0]}, cannot be rebuilt: {mesh.problem}"
    parts.append(
        f"{mesh.controller}, {plural(mesh.states, 'state')} in "
        f"{plural(mesh.generations, 'generation')}, "
        f"{plural(mesh.slopes, 'slope')}, threshold {mesh.threshold:g}"
        f"{'' if mesh.clustered else ', unclustered'}, {duration_text(mesh.seconds)}"
    )
    rows = [
        (
            f"{math.degrees(e.mu_s):g} deg",
            f"{math.degrees(e.sigma_s):g} deg",
            f"{e.correlation:g}",
            repr(e.mfpt),
            "-" if e.published is None else repr(e.published.mfpt),
            {True: "yes", False: "no", None: "-"}[e.identical],
        )
        for e in mesh.estimates
    ]
    if rows:
        header = ("mean", "sigma", "correlation", "MFPT from the bag", "as published", "same")
        parts.append(table(header, rows))
    return "\n".join(parts)
