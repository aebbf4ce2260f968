"""Commands that work in this process, without ROS."""

from __future__ import annotations

import argparse
import math
from typing import Any

import numpy as np

from biped_mfpt_ros.cli import options
from biped_mfpt_ros.cli.kernels import work
from biped_mfpt_ros.cli.output import json_text
from biped_mfpt_ros.cli.results import monte_carlo_result, shares_table
from biped_mfpt_ros.control.controller import (
    SCHEMES,
    catalogue,
    confirmed,
    origin,
    paper_controller_names,
)
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.monte_carlo import monte_carlo as walk
from biped_mfpt_ros.gait.step import check_states, simulate_steps
from biped_mfpt_ros.models import model_values, robot_from_file
from biped_mfpt_ros.optimise.space import PARAMETRISATIONS
from biped_mfpt_ros.report import paper
from biped_mfpt_ros.report.tables import ground_text, number, plural, table
from biped_mfpt_ros.study.readings import readings
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import WalkerModel


def step(args: argparse.Namespace) -> None:
    """Simulate one step."""
    controller, model = options.walker_of(args)
    previous = options.slope("--previous-slope", args.previous_slope)
    slope = options.slope("--slope", args.slope)
    if np.abs(args.state[:5]).max() > 2.0 * np.pi:  # degrees, most likely
        raise InputError("--state", args.state, "angles within a turn, in rad")
    states = check_states([args.state])
    with work(args.quiet):
        steps = simulate_steps(controller, states, [previous], [slope], model)
    outcome = Outcome(int(steps.outcomes[0, 0]))
    result = options.described(controller, model) | {
        "state": states[0],
        "previous_slope": previous,
        "slope": slope,
        "outcome": outcome.name.lower(),
        "outcome_code": int(outcome),
        "next_state": steps.next_states[0] if outcome is Outcome.STEP else None,
        "duration": steps.durations[0, 0],
        "step_length": steps.step_lengths[0, 0],
        "energy": steps.energies[0, 0],
    }
    if args.json:
        print(json_text(result))
        return
    print(f"outcome      {outcome.label} (code {int(outcome)})")
    print(f"duration     {number(float(result['duration']))} s")
    if outcome is Outcome.STEP:
        print(f"step length  {number(float(result['step_length']))} m")
        print(f"energy       {number(float(result['energy']))} J")
        print(f"next state   {_state_text(steps.next_states[0])}")


def cycle(args: argparse.Namespace) -> None:
    """Find a limit cycle."""
    controller, model = options.walker_of(args)
    slope = options.slope("--slope", args.slope)
    with work(args.quiet):
        found = find_limit_cycle(controller, slope, model)
    magnitudes = np.abs(found.eigenvalues)
    if args.json:
        result = options.described(controller, model) | {
            "slope": slope,
            "state": found.state,
            "period": found.period,
            "step_length": found.step_length,
            "speed": found.speed,
            "cost_of_transport": found.cost_of_transport,
            "stable": found.stable,
            "eigenvalues": found.eigenvalues,
            "eigenvalue_magnitudes": magnitudes,
            "residual": found.residual,
        }
        print(json_text(result))
        return
    rows = [
        ("period", f"{found.period:.4f} s"),
        ("step length", f"{found.step_length:.4f} m"),
        ("speed", f"{found.speed:.4f} m/s{_beside(paper.speed(controller.name, args.slope))}"),
        (
            "cost of transport",
            f"{found.cost_of_transport:.4f}"
            f"{_beside(paper.cost_of_transport(controller.name, args.slope))}",
        ),
        ("eigenvalues", ", ".join(f"{m:.4f}" for m in magnitudes if m > 1e-4) + " in magnitude"),
        ("stable", "yes" if found.stable else "no"),
        ("state", _state_text(found.state)),
    ]
    print("\n".join(f"{name:<18} {value}" for name, value in rows))


def monte_carlo(args: argparse.Namespace) -> None:
    """Walk on random slopes until the fall."""
    controller, model = options.walker_of(args)
    mean, sigma = options.slope("--mean", args.mean), options.spread("--sigma", args.sigma)
    correlation = options.correlation_of(args)
    with work(args.quiet) as progress:
        result = walk(
            controller,
            sigma,
            args.walks,
            args.seed,
            mu_s=mean,
            correlation=correlation,
            model=model,
            max_steps=args.max_steps,
            progress=lambda done, total: progress.count("monte-carlo", done, total, "walks"),
        )
        seconds = progress.seconds
    reference = paper.monte_carlo(controller.name, args.mean, args.sigma, correlation)
    if args.json:
        print(
            json_text(
                options.described(controller, model)
                | {"mu_s": mean, "sigma_s": sigma, "correlation": correlation}
                | {"walks": args.walks, "seed": args.seed}
                | monte_carlo_result(result)
                | {"max_steps": args.max_steps, "seconds": seconds, "paper": reference}
            )
        )
        return
    low, high = result.confidence_interval
    confidence = f", 95 % confidence {number(low)} to {number(high)}" if result.falls > 1 else ""
    mean_steps = f"{number(result.mean_steps)} steps to a fall on average"
    if not result.counted.size:
        mean_steps = "all walks fell in the first step, which does not count"
    elif not result.falls:
        # Of a constant chance of falling p: (1 - p)^n = 5 % for n steps without a fall.
        least = result.counted.sum() / -math.log(0.05)
        mean_steps = f"no fall; 95 % confidence: more than {number(float(least))} steps to a fall"
    print(f"{controller.name}: {mean_steps}{_beside(reference)}{confidence}")
    ended = int((result.outcomes == Outcome.STEP).sum())
    stopped = f", {ended} stopped after {args.max_steps} steps" if ended else ""
    print(
        f"{plural(args.walks, 'walk')}, {result.counted.size} counted (more than one step), "
        f"{plural(result.falls, 'fall')}{stopped}{ground_text(args.mean, correlation)}"
    )
    if result.falls:
        print(shares_table(result.failure_shares))


def controllers(args: argparse.Namespace) -> None:
    """List the catalogue, or print one controller of it."""
    if args.robot_file is not None and args.name is None:
        raise InputError("--robot-file", args.robot_file, "given with NAME only")
    if args.name is not None:
        try:
            one = catalogue()[args.name]
        except KeyError:
            raise InputError("NAME", args.name, "one of " + ", ".join(catalogue())) from None
        values = one.parameters
        if args.robot_file is not None:
            # What follows from the others on this robot: hybrid invariance.
            made = PARAMETRISATIONS[one.scheme]
            values = made.parameters(made.free(values), values, robot_from_file(args.robot_file))
        parameters = dict(zip(SCHEMES[one.scheme].parameters, values, strict=True))
        # Not the catalogue's name: what is changed has none of the paper's numbers.
        print(json_text({"name": "mine", "scheme": one.scheme, "parameters": parameters}))
        return
    papers = paper_controller_names()
    rows = [paper.figures(name) | {"model": readings()[name].settings} for name in papers]
    others: list[dict[str, Any]] = [
        {"controller": n, "origin": origin(n), "confirmed": confirmed(n)}
        for n in catalogue()
        if n not in papers
    ]
    if args.json:
        print(json_text({"controllers": [*rows, *others]}))
        return
    print(
        table(
            ("controller", "speed", "cost of transport", "MFPT at 1 deg", "Monte Carlo", "at"),
            [
                (
                    row["controller"],
                    row["speed"],
                    row["cost_of_transport"],
                    row["mfpt"],
                    row["mean_steps"],
                    f"{row['mean_steps_sigma_deg']:g} deg",
                )
                for row in rows
            ],
        )
    )
    print("\nAs the paper gives them; speed in m/s, MFPT and Monte Carlo in steps. It states no")
    print("limits; those that serve its numbers best are the defaults for hzd, and for smc\n")
    for row in rows:
        if limits := _limits_text(row["model"]):
            print(f"{row['controller']:<10}  {limits}")
    print("\nFound here:\n")
    found = [(row["controller"], row["confirmed"]) for row in others if row["confirmed"]]
    print(
        table(
            ("controller", "speed", "cost of transport", "MFPT at 1 deg", "Monte Carlo", "at"),
            [
                (
                    name,
                    figures["speed"],
                    figures["cost_of_transport"],
                    figures["mesh"]["mfpt"]["1"],
                    figures["walks"]["mean_steps"]["5"],
                    "5 deg",
                )
                for name, figures in found
            ],
        )
    )
    print("\nWhere they come from:\n")
    for row in others:
        print(f"{row['controller']}: {row['origin']}")


def _limits_text(model: dict[str, Any]) -> str:
    """What sets a model apart from the default, as options."""
    default = model_values(WalkerModel())
    return " ".join(
        f"--{name.replace('_', '-')} {number(value)}"
        for name, value in model.items()
        if value != default[name]
    )


def _beside(reference: float | None) -> str:
    return "" if reference is None else f" (paper: {number(reference)})"


def _state_text(state: np.ndarray) -> str:
    """A state as `--state` takes it; rounded far below what a walk can feel."""
    return ",".join(f"{value:.9g}" for value in state)
