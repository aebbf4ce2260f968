"""Long tests of what the project promises under faults, bad input and long use: `make soak`.

Each subject breaks things on purpose and counts what came of it. The exit code is 1 if a promise
was broken. The same seed does the same again, as far as the timing of processes allows.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from collections.abc import Callable

from biped_mfpt_ros.cli import leave_graph
from biped_mfpt_ros.report.progress import Progress
from biped_mfpt_ros.report.tables import table
from biped_mfpt_ros.soak.result import Row

SUBJECTS = ("fuzz", "meshes", "simulators")
"""Modules of this package, each with a function `run`."""

Run = Callable[[bool, int, Progress], list[Row]]
"""Of a subject: whether it is to be short, a seed, and where to tell how far it is."""


def main(arguments: list[str] | None = None) -> int:
    """Run the subjects and print what came of it."""
    parser = argparse.ArgumentParser(prog="make soak", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--short", action="store_true", help="a small part of it, for a quick look")
    parser.add_argument("--only", choices=SUBJECTS, nargs="+", help="run these subjects alone")
    parser.add_argument("--seed", type=int, default=1, help="of all that is random (default: 1)")
    args = parser.parse_args(arguments)
    rows: list[Row] = []
    with Progress() as progress:
        for name in args.only or SUBJECTS:
            progress.say(f"make soak: {name} ...")
            run: Run = importlib.import_module(f"biped_mfpt_ros.soak.{name}").run
            rows += run(args.short, args.seed, progress)
    failures = sum(row.failures for row in rows)
    if args.json:
        found = [row.to_dict() for row in rows]
        print(json.dumps({"seed": args.seed, "rows": found, "failures": failures}, indent=2))
    else:
        print(_text(rows))
    code = int(failures > 0)
    leave_graph(code)
    return code


def _text(rows: list[Row]) -> str:
    lines = [
        table(
            ("subject", "what", "count", "failures", "s"),
            [(r.subject, r.what, r.count, r.failures, r.seconds) for r in rows],
        )
    ]
    facts = [(r.subject, r.what, key, value) for r in rows for key, value in r.facts.items()]
    if facts:
        lines.append(table(("subject", "what", "fact", "value"), facts))
    lines += [f"FAILED {r.subject}, {r.what}: {text}" for r in rows for text in r.examples]
    return "\n\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
