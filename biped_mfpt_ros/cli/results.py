"""Results of walks and meshes: for JSON and for readers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from biped_mfpt_ros.gait.monte_carlo import MonteCarlo
from biped_mfpt_ros.report import paper
from biped_mfpt_ros.report.tables import difference, number, table
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.terrain import spread_given_last


def monte_carlo_result(result: MonteCarlo) -> dict[str, Any]:
    """What a Monte Carlo found, for JSON."""
    return {
        "mean_steps": result.mean_steps,
        "standard_error": result.standard_error,
        "confidence_interval": result.confidence_interval,
        "counted_walks": result.counted.size,
        "falls": result.falls,
        "stopped_walks": int((result.outcomes == Outcome.STEP).sum()),
        "failure_shares": shares(result.failure_shares),
    }


def shares(values: Mapping[Any, float]) -> dict[str, float]:
    """Failure shares (by outcome code) by the outcome's name, for JSON, the largest first."""
    ordered = sorted(values.items(), key=lambda item: -item[1])
    return {Outcome(code).name.lower(): share for code, share in ordered if share > 0.0}


def shares_table(values: Mapping[Any, float]) -> str:
    """Failure shares for readers."""
    rows = [
        (name.replace("_", " "), f"{100.0 * share:.1f} %") for name, share in shares(values).items()
    ]
    return table(("fall", "share"), rows)


def estimate_row(
    controller: str,
    mean_deg: float,
    sigma_deg: float,
    correlation: float,
    found: Any,
    falls: Mapping[Any, float],
) -> dict[str, Any]:
    """An estimate of the MFPT, for JSON; ``found`` has mfpt, failure_probability, lambda_2."""
    return {
        "sigma_s": math.radians(sigma_deg),
        "sigma_s_deg": sigma_deg,
        "mfpt": found.mfpt,
        "failure_probability": found.failure_probability,
        "lambda_2": found.lambda_2,
        "failure_shares": shares(falls),
        "paper": paper.mfpt(controller, mean_deg, sigma_deg, correlation),
    }


def mfpt_table(estimates: Sequence[dict[str, Any]]) -> str:
    """MFPT beside the paper's, with what the robot falls of, for readers."""
    rows = []
    for row in estimates:
        falls = [f"{name.replace('_', ' ')} {100.0 * share:.0f} %"
                 for name, share in list(row["failure_shares"].items())[:3]
                 if share >= 0.005]  # fmt: skip
        reference = row["paper"]
        rows.append(
            (
                f"{row['sigma_s_deg']:g} deg",
                row["mfpt"],
                reference,
                "" if reference is None else difference(row["mfpt"], reference),
                ", ".join(falls),
            )
        )
    return table(*beside_paper(("sigma", "MFPT in steps", "paper", "difference", "falls"), rows))


def slope_set_notes(
    estimates: Sequence[dict[str, Any]],
    step_deg: float,
    limit_deg: float,
    mean_deg: float,
    correlation: float,
) -> list[str]:
    """What estimates lack because their slope set is too coarse or too narrow."""
    notes = []
    for row in estimates:
        sigma_deg = row["sigma_s_deg"]
        spread, scale = spread_given_last(sigma_deg, correlation), math.sqrt(2.0) * sigma_deg
        beyond = 0.5 * sum(math.erfc((limit_deg + m) / scale) for m in (mean_deg, -mean_deg))
        if spread < step_deg:
            known = ", given the slope before," if correlation else ""
            notes.append(
                f"sigma {sigma_deg:g} deg{known} is finer than the slope set: take a --slope-step "
                f"of at most {number(spread)} deg"
            )
        elif beyond * max(row["mfpt"], 100.0) > 1.0:  # sooner than a fall, or common
            notes.append(
                f"sigma {sigma_deg:g} deg has a slope beyond --slope-limit {limit_deg:g} once in "
                f"{number(1.0 / beyond)} steps, which the mesh leaves out: take a larger limit"
            )
    return notes


def beside_paper(
    header: Sequence[str], rows: Sequence[Sequence[Any]]
) -> tuple[Sequence[str], Sequence[Sequence[Any]]]:
    """Header and rows of a table, without the paper's columns where it has no number."""
    at = header.index("paper")
    if any(row[at] is not None for row in rows):
        return header, rows
    kept = [i for i, name in enumerate(header) if name not in ("paper", "difference")]
    return [header[i] for i in kept], [[row[i] for i in kept] for row in rows]
