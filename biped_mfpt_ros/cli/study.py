"""`biped-mfpt study`: what studies have found."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from biped_mfpt_ros.cli.output import json_text
from biped_mfpt_ros.control.controller import SCHEMES, Controller, catalogue_row
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.optimise.store import Store, Trial
from biped_mfpt_ros.optimise.study import Study, best_trial
from biped_mfpt_ros.report.tables import ground_text, plural, table


def study(args: argparse.Namespace) -> None:
    """List, show, plot or export studies."""
    path = Path(args.store)
    if not path.exists():
        raise InputError("--store", args.store, "a file that `biped-mfpt optimise` made")
    if args.output is not None and Path(args.output).exists():
        raise InputError("--output", args.output, "a file that does not exist yet")
    store = Store(path)
    if args.what == "list":
        _list(store, args)
        return
    if args.what == "front":
        from biped_mfpt_ros.report import studies

        opened = [Study(store, name) for name in _names(args, 1, 100)]
        _save(studies.front(opened), args)
        return
    (name,) = _names(args, 1, 1)
    opened_study = Study(store, name)
    if args.what == "show":
        _show(opened_study, args)
    elif args.what == "export":
        _export(opened_study, args)
    else:
        from biped_mfpt_ros.report import studies

        _save(studies.history(opened_study), args)


def _names(args: argparse.Namespace, least: int, most: int) -> list[str]:
    if not least <= len(args.study) <= most:
        wanted = "one name of a study" if most == 1 else "names of studies"
        raise InputError("STUDY", args.study or None, wanted)
    return list(args.study)


def _save(picture: Any, args: argparse.Namespace) -> None:
    if args.output is None or not args.output.lower().endswith(".png"):
        raise InputError("--output", args.output, "a new file that ends in .png")
    picture.save(args.output)
    if args.json:
        print(json_text({"output": args.output, "caption": picture.caption}))
    else:
        print(f"{picture.caption}\nwritten to {args.output}")


def trial_row(study: Study, trial: Trial) -> dict[str, Any]:
    """A trial for JSON."""
    row: dict[str, Any] = {
        "number": trial.number,
        "generation": trial.generation,
        "status": trial.status,
        "vector": trial.vector,
    }
    try:
        row["controller"] = described(study.controller(trial))
    except InputError as error:
        row["controller"] = None
        row["problem"] = str(error)
    if trial.found is not None:
        row |= vars(trial.found) | {"finished": trial.finished, "step_map": trial.step_map}
    return row


def described(controller: Controller) -> dict[str, Any]:
    """A controller for JSON: as --controller-file takes it, by name, and as in the catalogue."""
    names = SCHEMES[controller.scheme].parameters
    named = dict(zip(names, controller.parameters.tolist(), strict=False))
    return {
        "name": controller.name,
        "scheme": controller.scheme,
        "parameters": controller.parameters.tolist(),
        "named": named,
        "catalogue": catalogue_row(controller),
    }


def _list(store: Store, args: argparse.Namespace) -> None:
    rows: list[dict[str, Any]] = []
    for name in store.names():
        opened = Study(store, name)
        trials = opened.trials()
        best = best_trial(trials)
        rows.append(
            {
                "study": name,
                "start": opened.settings.start.name,
                "searcher": opened.settings.searcher,
                "objectives": opened.settings.objectives,
                "mu_s": opened.settings.mu_s,
                "sigma_s": opened.settings.sigma_s,
                "correlation": opened.settings.correlation,
                "trials": sum(t.found is not None for t in trials),
                "confirmed": sum(t.found is not None and t.found.confirmed for t in trials),
                "best": None if best is None or best.found is None else best.found.values,
            }
        )
    if args.json:
        print(json_text({"store": args.store, "studies": rows}))
        return
    headers = ("study", "start", "searcher", "mean", "sigma", "correlation", "trials", "confirmed",
               "best MFPT", "COT")  # fmt: skip
    print(
        table(
            headers,
            [
                (
                    row["study"],
                    row["start"],
                    row["searcher"],
                    f"{np.degrees(row['mu_s']):g} deg",
                    f"{np.degrees(row['sigma_s']):g} deg",
                    f"{row['correlation']:g}",
                    row["trials"],
                    row["confirmed"],
                    (row["best"] or {}).get("mfpt"),
                    (row["best"] or {}).get("cot"),
                )
                for row in rows
            ],
        )
    )


def _show(opened: Study, args: argparse.Namespace) -> None:
    trials = opened.trials()
    if args.json:
        print(
            json_text(
                {
                    "study": opened.name,
                    "settings": opened.settings.as_json(),
                    "space": opened.space.described(),
                    "trials": [trial_row(opened, t) for t in trials],
                }
            )
        )
        return
    print(summary_text(opened, trials, args.top))
    best = best_trial(trials)
    if best is not None:
        named = described(opened.controller(best))["named"]
        print(f"\nparameters of trial {best.number}:")
        print(table(("name", "start", "best", "steps away"), [
            (row["name"], row["start"], named[str(row["name"])], float(distance))
            for row, distance in zip(opened.space.described(), best.vector, strict=True)
        ]))  # fmt: skip


def summary_text(study: Study, trials: list[Trial], top: int = 5) -> str:
    """How far trials came, and the best of them, for readers."""
    done = [t for t in trials if t.found is not None]
    stages: dict[str, int] = {}
    for t in done:
        assert t.found is not None
        stages[t.found.stage] = stages.get(t.found.stage, 0) + 1
    counts = ", ".join(f"{count} {stage}" for stage, count in sorted(stages.items()))
    ground = ground_text(np.degrees(study.settings.mu_s), study.settings.correlation)
    lines = [f"study {study.name}: {plural(len(done), 'trial')} ({counts}){ground}"]
    if rows := run_rows(study, trials):
        left = study.runs_left()
        for row in rows:
            ended = "" if row["run"] in left else ", ended"
            lines.append(
                f"run {row['run']}: {plural(row['trials'], 'trial')}, "
                f"best score {score_text(row)}{ended}"
            )
        if len(left) > 1:
            lines.append(f"{len(left)} runs share the trials until one is left: that takes more")
    confirmed = sorted(
        ((t.number, t.found) for t in done if t.found is not None and t.found.confirmed),
        key=lambda trial: (-trial[1].score, trial[0]),
    )
    if not confirmed:
        return "\n".join([*lines, "nothing is confirmed yet"])
    sigma = np.degrees(study.settings.sigma_s)
    best = []
    for trial, found in confirmed[:top]:
        v = found.values
        check = ""
        if "check_steps" in v:
            check = (
                f"{v['check_steps']:.4g} (mesh {v['check_claimed']:.4g}) "
                f"at {np.degrees(v['check_sigma']):g} deg"
            )
        best.append((trial, found.score, v.get("mfpt"), found.states, v["cot"], v["speed"], check))
    headers = ("trial", "score", f"MFPT at {sigma:g} deg", "states", "COT", "m/s", "Monte Carlo")
    return "\n".join([*lines, "", "confirmed:", table(headers, best)])


def run_rows(study: Study, trials: list[Trial]) -> list[dict[str, Any]]:
    """How many trials each run of a search had, and their best score; empty if there is but one.

    A run that is behind gets no fine mesh, so that its score need not be a confirmed one.
    """
    count = study.settings.run_count
    if count == 1:
        return []
    rows: list[dict[str, Any]] = [
        {"run": number, "trials": 0, "score": None} for number in range(1, count + 1)
    ]
    for t in trials:
        if t.found is not None:
            add_to_run(rows[study.run_of(t.generation) - 1], t.found.score)
    return rows


def add_to_run(row: dict[str, Any], score: float) -> None:
    """Count a trial in the row of its run."""
    row["trials"] += 1
    row["score"] = score if row["score"] is None else max(score, row["score"])


def score_text(row: dict[str, Any]) -> str:
    """Best score of a run, for readers."""
    return "-" if row["score"] is None else f"{row['score']:.3g}"


def _export(opened: Study, args: argparse.Namespace) -> None:
    trials = opened.trials()
    if args.trial is None:
        trial = best_trial(trials)
        if trial is None:
            raise InputError("STUDY", opened.name, "one with a confirmed trial, or --trial")
    else:
        found = [t for t in trials if t.number == args.trial and t.found is not None]
        if not found:
            raise InputError("--trial", args.trial, "a finished trial of the study")
        trial = found[0]
    assert trial.found is not None
    text = json_text(
        described(opened.controller(trial))
        | {
            "study": opened.name,
            "trial": trial.number,
            "found": vars(trial.found),
            "settings": opened.settings.as_json(),
            "step_map": trial.step_map,
        }
    )
    if args.output is None:
        print(text)
        return
    with open(args.output, "x") as file:
        file.write(text + "\n")
    print(f"written to {args.output}")
