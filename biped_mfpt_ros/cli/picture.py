"""`biped-mfpt picture`: one picture into a file."""

from __future__ import annotations

import argparse
from pathlib import Path

from biped_mfpt_ros.chain.markov import metastability
from biped_mfpt_ros.cli import options
from biped_mfpt_ros.cli.kernels import work
from biped_mfpt_ros.cli.meshes import grow
from biped_mfpt_ros.cli.output import json_text
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.trace import trace_swing
from biped_mfpt_ros.report import gaits, mesh_pictures
from biped_mfpt_ros.report.style import Picture

_OF_MESHES = ("mesh", "distribution", "falls")


def picture(args: argparse.Namespace) -> None:
    """Draw one picture."""
    output, ending = Path(args.output), ".gif" if args.kind == "animation" else ".png"
    if output.suffix.lower() != ending:
        raise InputError("--output", args.output, f"a file that ends in {ending}")
    if output.exists():
        raise InputError("--output", args.output, "a file that does not exist yet")
    if not output.parent.is_dir():
        raise InputError("--output", args.output, "a file in a directory that exists")
    made = _of_mesh(args) if args.kind in _OF_MESHES else _of_walk(args)
    made.save(output)
    if not args.json:
        print(f"{made.title}\n{made.caption}\nwritten to {output}")
        return
    controller, model = options.walker_of(args)
    print(
        json_text(
            options.described(controller, model)
            | {"kind": args.kind, "title": made.title, "caption": made.caption}
            | {"mime": made.mime, "bytes": len(made.data), "output": args.output}
        )
    )


def _of_walk(args: argparse.Namespace) -> Picture:
    controller, model = options.walker_of(args)
    mean, sigma = options.slope("--mean", args.mean), options.spread("--sigma", args.sigma)
    correlation = options.correlation_of(args)
    with work(args.quiet):
        cycle = find_limit_cycle(controller, 0.0, model)
        walk = gaits.rough_walk(
            controller,
            sigma,
            mu_s=mean,
            correlation=correlation,
            seed=args.seed,
            number=args.number,
            last_steps=args.last_steps,
            model=model,
            state=cycle.state,
        )
        if args.kind == "phase":
            return gaits.phase_portraits(walk, cycle)
        if args.kind == "torques":
            flat = trace_swing(controller, cycle.state, 0.0, 0.0, model)
            swings = {
                "flat limit cycle": flat,
                f"last step: {walk.outcome.label}": walk.swings[-1],
            }
            return gaits.torques(swings, model, controller.name)
        return gaits.animation(walk) if args.kind == "animation" else gaits.gait(walk)


def _of_mesh(args: argparse.Namespace) -> Picture:
    mean, sigma = options.mean_of(args), options.spread("--sigma", args.sigma)
    correlation = options.correlation_of(args)
    mesh, _ = grow(args)
    if args.kind == "mesh":
        return mesh_pictures.mesh_plane(mesh, args.controller)
    with work(args.quiet):
        found = metastability(mesh, mean, sigma, correlation)
    draw = mesh_pictures.where_it_falls if args.kind == "falls" else mesh_pictures.mesh_distribution
    return draw(mesh, found, mean, sigma, args.controller, correlation)
