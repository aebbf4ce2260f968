"""Tables of a study, every number beside the paper's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from biped_mfpt_ros.control.controller import SCHEMES, controller
from biped_mfpt_ros.control.hzd import DEGREE, hybrid_invariant_start
from biped_mfpt_ros.report import paper
from biped_mfpt_ros.report.tables import plural
from biped_mfpt_ros.study.plan import SIGMA_DEG, TABLE_SIGMA_DEG, scheme_of
from biped_mfpt_ros.study.readings import readings
from biped_mfpt_ros.study.results import Results, mfpt_of, percent
from biped_mfpt_ros.study.table import (
    COUNT,
    DIFFERENCE,
    FIXED,
    INTERVAL,
    SECONDS,
    SHARE,
    TEXT,
    Column,
    Table,
)
from biped_mfpt_ros.study.verdicts import verdicts


def tables(results: Results) -> list[Table]:
    """Every table for which there is a result, in the order of a report."""
    names = {s: [n for n in results.plan.controllers if scheme_of(n) == s] for s in SCHEMES}
    found = [
        verdicts(results),
        _parameters_hzd(names["hzd"]),
        _gaits("table1_gaits", "Gaits of Table 1 on flat ground", results, names["hzd"]),
        _mfpt("table2", "Table 2: first scheme", results, names["hzd"]),
        _parameters_smc(names["smc"]),
        _gaits("table3_gaits", "Gaits of Table 3 on flat ground", results, names["smc"]),
        _mfpt("table4", "Table 4: second scheme", results, names["smc"]),
        _table5(results),
        _convergence(results),
        _readings(results.plan.controllers),
        _tolerance(results),
        _slopes(results),
    ]
    return [table for table in found if table.rows]


def _parameters_hzd(names: Sequence[str]) -> Table:
    """Table 1, with the first two coefficients of every joint as hybrid invariance has them."""
    rows = []
    for name in names:
        values = controller(name).parameters
        bezier = values[2:30].reshape(4, DEGREE + 1)
        start = hybrid_invariant_start(bezier[:, DEGREE - 1], bezier[:, DEGREE])
        rows += [_parameter(name, "K_P", values[0]), _parameter(name, "K_D", values[1])]
        for joint in range(4):
            for k in range(DEGREE + 1):
                again = float(start[k][joint]) if k < 2 else None
                rows.append(_parameter(name, f"α_{k}^{joint + 1}", bezier[joint, k], again))
    return Table(
        "table1",
        "Table 1: parameters of the first scheme",
        (
            Column("controller", "controller", TEXT),
            Column("parameter", "parameter", TEXT),
            Column("paper", "paper", FIXED),
            Column("recomputed", "by hybrid invariance", FIXED),
            Column("difference", "difference", FIXED),
        ),
        rows,
        (
            "α in rad. α₀ and α₁ follow from α₅ and α₆ through the impact map: that they come out "
            "as printed checks kinematics, inertia and impact of the model at once.",
        ),
    )


def _parameter(
    name: str, parameter: str, value: float, again: float | None = None
) -> dict[str, Any]:
    return {
        "controller": name,
        "parameter": parameter,
        "paper": float(value),
        "recomputed": again,
        "difference": None if again is None else again - float(value),
    }


def _parameters_smc(names: Sequence[str]) -> Table:
    labels = SCHEMES["smc"].parameters
    values = {name: controller(name).parameters for name in names}
    rows = []
    for i, label in enumerate(labels if names else ()):
        angle = "_ref" in label
        rows.append(
            {"parameter": f"{label}, degrees" if angle else label}
            | {n: float(np.degrees(v[i]) if angle else v[i]) for n, v in values.items()}
        )
    return Table(
        "table3",
        "Table 3: parameters of the second scheme",
        (Column("parameter", "parameter", TEXT), *(Column(n, n) for n in names)),
        rows,
    )


def _gaits(name: str, title: str, results: Results, names: Sequence[str]) -> Table:
    rows, notes = [], []
    for n in names:
        found = results.cycle(n)
        if found is None:
            continue
        row: dict[str, Any] = {"controller": n, "model": model_text(n)}
        if found["found"]:
            speed, cost = paper.speed(n), paper.cost_of_transport(n)
            row |= {
                "period": found["period"],
                "step_length": found["step_length"],
                "speed": found["speed"],
                "speed_paper": speed,
                "speed_difference": percent(found["speed"], speed),
                "cost_of_transport": found["cost_of_transport"],
                "cost_of_transport_paper": cost,
                "cost_of_transport_difference": percent(found["cost_of_transport"], cost),
                "largest_eigenvalue": found["largest_eigenvalue"],
            }
        else:
            notes.append(found["reason"])
        rows.append(row)
    return Table(
        name,
        title,
        (
            Column("controller", "controller", TEXT),
            Column("model", "walked with", TEXT),
            Column("period", "period, s", FIXED),
            Column("step_length", "step, m", FIXED),
            Column("speed", "speed, m/s", FIXED),
            Column("speed_paper", "paper", FIXED),
            Column("speed_difference", "difference", DIFFERENCE),
            Column("cost_of_transport", "cost of transport", FIXED),
            Column("cost_of_transport_paper", "paper", FIXED),
            Column("cost_of_transport_difference", "difference", DIFFERENCE),
            Column("largest_eigenvalue", "largest eigenvalue", FIXED),
        ),
        rows,
        (
            *notes,
            "The gait is stable where the largest eigenvalue of the step map is below 1.",
        ),
    )


def _settings_text(mesh: dict[str, Any] | None) -> str | None:
    if mesh is None:
        return None
    return f"{mesh['slope_step_deg']:g}°, {mesh['threshold']:g}, {mesh['states']} states"


def _mfpt(name: str, title: str, results: Results, names: Sequence[str]) -> Table:
    """Tables 2 and 4: the chain, coarse and fine, and Monte Carlo."""
    rows: list[dict[str, Any]] = []
    sigma = TABLE_SIGMA_DEG[scheme_of(names[0])] if names else 0.0
    for n in names:
        theirs = {"chain": paper.mfpt(n, 0.0, sigma), "walks": paper.monte_carlo(n, 0.0, sigma)}
        walked = results.walks(n, sigma)
        for what, mesh in (
            ("chain, the paper's d_s and d_thr", results.paper_mesh(n)),
            ("chain, finest mesh", results.finest(n)),
        ):
            value = mfpt_of(mesh, sigma)
            if value is None:
                continue
            rows.append(
                {
                    "controller": n,
                    "estimate": what,
                    "settings": _settings_text(mesh),
                    "paper": theirs["chain"],
                    "here": value,
                    "difference": percent(value, theirs["chain"]),
                    **_as_walks(mesh, walked, sigma),
                }
            )
        if walked is not None:
            value = float(walked["mean_steps"])
            rows.append(
                {
                    "controller": n,
                    "estimate": "Monte Carlo",
                    "settings": f"{plural(walked['walks'], 'walk')}, "
                    f"{walked['counted_walks']} counted",
                    "paper": theirs["walks"],
                    "here": value,
                    "interval": [walked["low"], walked["high"]],
                    "difference": percent(value, theirs["walks"]),
                }
            )
    return Table(
        name,
        f"{title}, MFPT at σ_s = {sigma:g}°",
        (
            Column("controller", "controller", TEXT),
            Column("estimate", "estimate", TEXT),
            Column("settings", "d_s, d_thr, size", TEXT),
            Column("paper", "paper"),
            Column("here", "here"),
            Column("interval", "95 % confidence", INTERVAL),
            Column("difference", "difference from the paper", DIFFERENCE),
            Column("counted", "counted as walks"),
            Column("bias", "difference from Monte Carlo", DIFFERENCE),
        ),
        rows,
        (
            "Monte Carlo as in the paper: from the limit cycle on flat ground, the first step "
            "dropped, walks that fell in it not counted. Eq. (34) is about the metastable walker "
            "instead; counted as walks, the same chain says what Monte Carlo would find.",
        ),
    )


def _as_walks(
    mesh: dict[str, Any] | None, walked: dict[str, Any] | None, sigma: float
) -> dict[str, float | None]:
    """What a mesh predicts for walks, and how far Monte Carlo is from it."""
    value = mesh["counted"].get(sigma) if mesh else None
    counted = None if value is None else float(value)
    mean = None if walked is None else float(walked["mean_steps"])
    return {"counted": counted, "bias": percent(counted, mean)}


def _table5(results: Results) -> Table:
    rows = []
    for n in results.plan.controllers:
        coarse, fine = (mfpt_of(m, 1.0) for m in (results.paper_mesh(n), results.finest(n)))
        walked = results.walks(n, 1.0)
        theirs = paper.mfpt(n, 0.0, 1.0)
        if coarse is None and fine is None:
            continue
        rows.append(
            {
                "controller": n,
                "paper": theirs,
                "coarse": coarse,
                "coarse_difference": percent(coarse, theirs),
                "fine": fine,
                "fine_settings": _settings_text(results.finest(n)),
                "fine_difference": percent(fine, theirs),
                "walks": walked and float(walked["mean_steps"]),
                "interval": walked and [walked["low"], walked["high"]],
                "walks_difference": walked and percent(float(walked["mean_steps"]), theirs),
            }
        )
    return Table(
        "table5",
        "Table 5: all controllers, MFPT at σ_s = 1°",
        (
            Column("controller", "controller", TEXT),
            Column("paper", "paper"),
            Column("coarse", "the paper's d_s and d_thr"),
            Column("coarse_difference", "difference", DIFFERENCE),
            Column("fine", "finest mesh"),
            Column("fine_settings", "d_s, d_thr, size", TEXT),
            Column("fine_difference", "difference", DIFFERENCE),
            Column("walks", "Monte Carlo"),
            Column("interval", "95 % confidence", INTERVAL),
            Column("walks_difference", "difference", DIFFERENCE),
        ),
        rows,
    )


def _convergence(results: Results) -> Table:
    """One row for each mesh."""
    rows = []
    sigmas = sorted({s for n in results.plan.controllers for s in SIGMA_DEG[scheme_of(n)]})
    for n in results.plan.controllers:
        for mesh in results.meshes(n):
            row = {
                "controller": n,
                **{k: mesh[k] for k in ("slope_step_deg", "threshold", "states", "generations")},
                **{k: mesh[k] for k in ("swings_per_second", "seconds")},
            }
            for sigma in sigmas:
                row[f"mfpt_{sigma:g}"] = mfpt_of(mesh, sigma)
                as_walks = _as_walks(mesh, results.walks(n, sigma), sigma)
                row |= {f"{key}_{sigma:g}": value for key, value in as_walks.items()}
            rows.append(row)
    return Table(
        "convergence",
        "Convergence in d_s and d_thr",
        (
            Column("controller", "controller", TEXT),
            Column("slope_step_deg", "d_s, °"),
            Column("threshold", "d_thr"),
            Column("states", "states", COUNT),
            *(
                column
                for sigma in sigmas
                for column in (
                    Column(f"mfpt_{sigma:g}", f"MFPT at {sigma:g}°"),
                    Column(f"counted_{sigma:g}", "counted as walks"),
                    Column(f"bias_{sigma:g}", "from Monte Carlo", DIFFERENCE),
                )
            ),
            Column("generations", "generations", COUNT),
            Column("seconds", "time", SECONDS),
            Column("swings_per_second", "swings/s", COUNT),
        ),
        rows,
        (
            "MFPT by eq. (34); counted as walks: what the same chain says of walks from the limit "
            "cycle, the first step dropped, which is what Monte Carlo is compared with.",
        ),
    )


def _readings(names: Sequence[str]) -> Table:
    return Table(
        "readings",
        "What the paper leaves unsaid: with what each controller is walked",
        (
            Column("controller", "controller", TEXT),
            Column("torque_limit", "torque limit, N m"),
            Column("friction", "friction"),
            Column("slip_duration", "slip allowed, s"),
            Column("reason", "why", TEXT),
            Column("source", "what speaks for it", TEXT),
        ),
        [
            {
                "controller": n,
                **{k: readings()[n].settings[k] for k in ("friction", "slip_duration")},
                "torque_limit": readings()[n].settings["torque_limit"],
                "reason": readings()[n].reason,
                "source": readings()[n].source,
            }
            for n in names
        ],
    )


def _tolerance(results: Results) -> Table:
    rows = []
    for n in results.plan.controllers:
        found = results.tolerance(n)
        if found is not None:
            about = {"controller": n} | {key: found[key] for key in ("sigma_deg", "walks")}
            rows += [about | row for row in found["rows"]]
    return Table(
        "tolerance",
        "Tolerance of the integrator",
        (
            Column("controller", "controller", TEXT),
            Column("sigma_deg", "σ_s, °"),
            Column("walks", "walks", COUNT),
            Column("tolerance", "tolerance"),
            Column("same", "walks with the same steps and fall", SHARE),
            Column("mean_steps", "Monte Carlo"),
            Column("milliseconds", "ms a swing and core"),
        ),
        rows,
        (
            "Each row repeats the same walks; they are compared with those of the finest "
            "tolerance. A walk in which a step passes a failure condition by a hair may end "
            "otherwise.",
        ),
    )


def _slopes(results: Results) -> Table:
    found = results.slopes()
    return Table(
        "slopes",
        "Section 6.3: hzd/base on constant slopes",
        (
            Column("slope_deg", "slope, °"),
            Column("torque_limit", "torque limit, N m"),
            Column("late", "torques off late in the step", TEXT),
            Column("steps", "steps", COUNT),
            Column("fell", "then", TEXT),
        ),
        [
            row | {"late": "yes" if row["torques_off_late"] else "no",
                   "fell": row["fell"] or "walks on"}
            for row in (found["rows"] if found else ())
        ],
        (
            "The paper: the controller cannot take more than several steps down 1°; with no "
            "torque where τ > 0.95 it still walks on flat ground, and down 9°. Here it comes from "
            "flat ground that gets steeper by 1° a step.",
        ),
    )  # fmt: skip


def model_text(name: str) -> str:
    """The model of a controller in a few words."""
    model = readings()[name].model
    limit = "no torque limit" if math.isinf(model.torque_limit) else f"{model.torque_limit:g} N m"
    text = f"{limit}, μ {model.friction:g}"
    return text + (f", slip {1e3 * model.slip_duration:g} ms" if model.slip_duration else "")
