"""Benchmarks, measured side by side in one run: `make bench`.

Times depend on the machine, ratios less so. Every figure is the median over repetitions, with the
smallest and the largest beside it. What is timed is checked first: a wrong result is an error.
"""

from __future__ import annotations

import argparse
import json
import sys

from biped_mfpt_ros.bench import chain, large, mesh, pipeline, scale, start, step_map
from biped_mfpt_ros.bench.measure import BenchError
from biped_mfpt_ros.report.tables import table

SECTIONS = {
    "step map": step_map.run,
    "mesh": mesh.run,
    "chain": chain.run,
    "pipeline": pipeline.run,
    "start": start.run,
    "large": large.run,
    "scale": scale.run,
}
ONLY_BY_NAME = ("large", "scale")
"""Sections that take minutes, and so run when they are named only."""


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmarks and print them."""
    parser = argparse.ArgumentParser(prog="make bench", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--short", action="store_true", help="fewer repetitions, smaller problems")
    parser.add_argument("--only", choices=[*SECTIONS], nargs="+", help="run these sections alone")
    args = parser.parse_args(arguments)
    found = {}
    for name in args.only or [name for name in SECTIONS if name not in ONLY_BY_NAME]:
        print(f"make bench: {name} ...", file=sys.stderr, flush=True)
        try:
            found[name] = SECTIONS[name](args.short)
        except BenchError as error:
            print(f"make bench: {name}: {error}", file=sys.stderr)
            return 1
    rows = [row for section in found.values() for row in section.rows]
    ratios = {key: ratio for section in found.values() for key, ratio in section.ratios.items()}
    facts = {key: fact for section in found.values() for key, fact in section.facts.items()}
    if args.json:
        print(json.dumps({"rows": rows, "ratios": ratios, "facts": facts}, indent=2))
        return 0
    print(
        table(
            ("what", "median", "low", "high", "unit"),
            [(r["what"], r["median"], r["low"], r["high"], r["unit"]) for r in rows],
        )
    )
    for title, values in (("ratio", ratios), ("fact", facts)):
        if values:
            print("\n" + table((title, "value"), [*values.items()]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
