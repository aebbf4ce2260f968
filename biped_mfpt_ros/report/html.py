"""The study as one HTML file that needs nothing else."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from biped_mfpt_ros.jit import STEP_MAP
from biped_mfpt_ros.report import figures
from biped_mfpt_ros.report.progress import duration_text
from biped_mfpt_ros.report.style import Picture
from biped_mfpt_ros.report.tables import difference, number, plural
from biped_mfpt_ros.study.curves import Curve
from biped_mfpt_ros.study.plan import scheme_of
from biped_mfpt_ros.study.results import Results
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
from biped_mfpt_ros.study.verdicts import DIFFERS, HOLDS

_STYLE = """
:root { --ink: #1d232c; --soft: #5b6673; --line: #dde2e8; --wash: #f5f7fa; --blue: #1f5fa8;
  --good: #1d7a4d; --bad: #b3303f; --so: #96650f; }
* { box-sizing: border-box; }
html { scroll-behavior: smooth; -webkit-text-size-adjust: 100%; }
body { margin: 0; color: var(--ink); background: #fff;
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
header { background: #17406f; color: #fff; padding: 2.4rem 0 2rem; }
header p { margin: .4rem 0 0; opacity: .88; max-width: 46rem; }
.page { max-width: 68rem; margin: 0 auto; padding: 0 1.1rem; }
h1 { font-size: clamp(1.5rem, 5vw, 2.2rem); line-height: 1.2; margin: 0; }
h2 { font-size: 1.45rem; margin: 3rem 0 .6rem; padding-top: .6rem; border-top: 1px solid var(--line); }
h3 { font-size: 1.1rem; margin: 1.8rem 0 .5rem; }
p { max-width: 46rem; }
a { color: var(--blue); }
nav { background: var(--wash); border-bottom: 1px solid var(--line); }
nav ul { list-style: none; margin: 0; padding: .7rem 0; display: flex; flex-wrap: wrap; gap: .25rem 1.1rem; }
nav a { text-decoration: none; font-size: .93rem; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(9rem, 1fr)); gap: .8rem; margin: 1.6rem 0; }
.tile { border: 1px solid var(--line); border-radius: .6rem; padding: .8rem 1rem; background: var(--wash); }
.tile b { display: block; font-size: 1.7rem; line-height: 1.15; font-variant-numeric: tabular-nums; }
.tile span { color: var(--soft); font-size: .86rem; }
.scroll { overflow-x: auto; margin: .7rem 0 .4rem; border: 1px solid var(--line); border-radius: .5rem; }
table { border-collapse: collapse; width: 100%; font-size: .88rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; padding: .5rem .7rem; font-weight: 600; }
th { background: var(--wash); text-align: left; font-weight: 600; vertical-align: bottom; color: var(--soft);
  min-width: 5.2rem; }
sub, sup { font-size: .75em; line-height: 0; }
th, td { padding: .38rem .7rem; border-bottom: 1px solid var(--line); }
td { white-space: nowrap; vertical-align: top; }
td.long { white-space: normal; min-width: 15rem; }
tr:last-child td { border-bottom: 0; }
tr.first td { border-top: 2px solid var(--line); }
td.n, th.n { text-align: right; }
td.ours { font-weight: 600; }
.note { color: var(--soft); font-size: .86rem; margin: .2rem 0 1rem; }
.badge { display: inline-block; padding: .05rem .55rem; border-radius: 1rem; font-size: .8rem; font-weight: 600;
  color: #fff; background: var(--so); }
.badge.holds { background: var(--good); } .badge.differs { background: var(--bad); }
figure { margin: 1rem 0 1.4rem; }
figure img { display: block; width: 100%; max-width: 44rem; height: auto; border: 1px solid var(--line);
  border-radius: .5rem; background: #fff; }
figcaption { color: var(--soft); font-size: .88rem; max-width: 44rem; margin-top: .4rem; }
figcaption b { color: var(--ink); }
.pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 27rem), 1fr)); gap: 0 1.4rem; }
details { margin: .8rem 0; } summary { cursor: pointer; color: var(--blue); font-weight: 600; }
footer { margin: 3rem 0 2rem; color: var(--soft); font-size: .86rem; border-top: 1px solid var(--line); padding-top: 1rem; }
@media print { nav { display: none; } .scroll { overflow: visible; } h2 { break-after: avoid; } }
"""  # noqa: E501


def page(
    results: Results,
    tables: Sequence[Table],
    curves: Sequence[Curve],
    pictures: Mapping[str, Sequence[Picture]],
    seconds: Mapping[str, float],
) -> str:
    """The report.

    Parameters
    ----------
    results : Results
        Of the study.
    tables : sequence of Table
        As `study.tables.tables` makes them.
    curves : sequence of Curve
        Of Figures 2 and 3.
    pictures : mapping
        Further pictures of each controller, by its name.
    seconds : mapping
        Times that the study took, by what took them, s.

    Returns
    -------
    str
        HTML with style and pictures in it, that refers to nothing outside.
    """
    by = {table.name: table for table in tables}
    sections: list[tuple[str, str, str]] = []

    def add(anchor: str, title: str, *parts: str) -> None:
        body = "\n".join(part for part in parts if part)
        if body:
            sections.append((anchor, title, body))

    def shown(name: str) -> str:
        return _table(by[name]) if name in by else ""

    def curve(figure: int, scheme: str) -> str:
        mine = [c for c in curves if scheme_of(c.controller) == scheme]
        return _figure(figures.mfpt_curves(figure, mine)) if mine else ""

    add("holds", "What holds", _tiles(results, by), shown("holds"))
    if "table2" in by or "table1" in by:
        add(
            "hzd", "First scheme: hybrid zero dynamics", shown("table2"), curve(2, "hzd"),
            shown("table1_gaits"), _invariance(by.get("table1")),
            _folded("Table 1 in full", shown("table1")),
        )  # fmt: skip
    if "table4" in by or "table3" in by:
        add(
            "smc", "Second scheme: sliding mode control", shown("table4"), curve(3, "smc"),
            shown("table3_gaits"), _folded("Table 3 in full", shown("table3")),
        )  # fmt: skip
    add("comparison", "Comparison of the schemes", shown("table5"))
    if "convergence" in by:
        parts = []
        for name in results.plan.controllers:
            if results.meshes(name):
                parts.append(f"<h3>{escape(name)}</h3>")
                parts.append(_figure(figures.convergence(name, results), titled=False))
                parts.append(_table(_only(by["convergence"], name)))
        add("convergence", "Convergence", _CONVERGENCE, *parts)
    add("unsaid", "What the paper leaves unsaid", shown("readings"), shown("slopes"))
    if "tolerance" in by:
        rows = by["tolerance"].rows
        ratios = [
            found["cost_ratio"]
            for name in results.plan.controllers
            if (found := results.tolerance(name)) and found["cost_ratio"] is not None
        ]
        add(
            "tolerance", "Is the sliding mode resolved?", _resolved(rows, ratios),
            shown("tolerance"),
        )  # fmt: skip
    for name in results.plan.controllers:
        if pictures.get(name):
            drawn = "".join(_figure(picture) for picture in pictures[name])
            add(
                f"pictures-{name.replace('/', '-')}", f"{name}: gait and mesh",
                f'<div class="pictures">{drawn}</div>',
            )  # fmt: skip
    add("times", "How it was computed", _computed(results, seconds))

    contents = "".join(f'<li><a href="#{a}">{_text(title)}</a></li>' for a, title, _ in sections)
    body = "\n".join(
        f'<section id="{anchor}"><h2>{_text(title)}</h2>\n{text}</section>'
        for anchor, title, text in sections
    )
    quick = (
        "<p><b>This is the quick study: coarser meshes and fewer walks.</b></p>"
        if results.plan.quick
        else ""
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Robustness of bipedal walking on rough terrain, reproduced</title>
<style>{_STYLE}</style>
</head>
<body>
<header><div class="page">
<h1>How many steps until it falls?</h1>
<p>The tables and figures of Saglam and Byl, <i>Quantifying and Optimizing Robustness of Bipedal
Walking Gaits on Rough Terrain</i>, computed again, with every number beside the paper's. MFPT is
the mean first-passage time to a fall, in steps; σ<sub>s</sub> the standard deviation of the slope
that each step meets, with mean 0.</p>{quick}
</div></header>
<nav><div class="page"><ul>{contents}</ul></div></nav>
<main class="page">
{body}
</main>
<footer class="page"><p>biped_mfpt_ros, step map {escape(STEP_MAP)}. The same numbers are in
report.json and in a .csv file for each table and figure; every mesh is in a bag of its own.</p>
</footer>
</body>
</html>
"""


_CONVERGENCE = """<p>The MFPT of a mesh is that of the walker only when the mesh is fine enough:
d<sub>thr</sub>, the distance from which on a state is a new one, and d<sub>s</sub>, the spacing of
the slopes, are made smaller until it settles. Where walks are short enough, Monte Carlo is the
judge: its walks meet any slope, not only those of the set, and no state is replaced by a near one.
It is compared with what the same chain says of such walks, from the limit cycle and without their
first step. Where falls are frequent that is up to some per cent from eq. (34), which is about a
walker that has not fallen for long.</p>"""


def _tiles(results: Results, by: Mapping[str, Table]) -> str:
    """The study in a few numbers."""
    tiles = []
    if "holds" in by:
        verdicts = [row["verdict"] for row in by["holds"].rows]
        judged = sum(v in (HOLDS, DIFFERS) for v in verdicts)
        tiles.append((f"{verdicts.count(HOLDS)} of {judged}", "of the paper's numbers hold"))
    meshes = [mesh for name in results.plan.controllers for mesh in results.meshes(name)]
    if meshes:
        tiles.append((str(len(meshes)), "meshes, each with a bag"))
        tiles.append((_thousands(max(m["states"] for m in meshes)), "states in the largest"))
        tiles.append((_thousands(sum(m["swings"] for m in meshes)), "swings simulated for them"))
    walked = [
        walk
        for name in results.plan.controllers
        for job in results.plan.of("walks", name)
        if (walk := results.walks(name, job.settings["at_deg"])) is not None
    ]
    if walked:
        tiles.append((_thousands(sum(w["steps"] for w in walked)), "steps walked in Monte Carlo"))
    return (
        '<div class="tiles">'
        + "".join(f'<div class="tile"><b>{a}</b><span>{b}</span></div>' for a, b in tiles)
        + "</div>"
    )


def _thousands(value: int) -> str:
    return f"{value:,}".replace(",", "\u202f")


def _invariance(table: Table | None) -> str:
    """Table 1 in a sentence."""
    if table is None:
        return ""
    largest = max(abs(row["difference"]) for row in table.rows if row["difference"] is not None)
    return (
        "<p>The first two coefficients of every joint follow from the last two through the "
        "impact map (hybrid invariance). Computed so, those printed in Table 1 come out with "
        f"differences of at most {largest:.1e} rad, which the four printed decimals explain.</p>"
        if largest < 2e-3
        else "<p>The first two coefficients of every joint follow from the last two through the "
        f"impact map (hybrid invariance). The largest difference is {largest:.1e} rad.</p>"
    )


def _resolved(rows: Sequence[dict[str, Any]], ratios: Sequence[float]) -> str:
    """What the walks with several tolerances tell, in a paragraph."""
    least: dict[str, float] = {}
    cost: dict[str, list[float]] = {}
    for row in rows:
        scheme = scheme_of(row["controller"])
        least[scheme] = min(least.get(scheme, 1.0), row["same"])
        cost.setdefault(scheme, []).append(row["milliseconds"])
    text = (
        "Near σ = 0 the second scheme's law is steeper than any integrator can follow to the "
        "letter, with exponents 2α − 1 from 0.6 down to −0.03. Its slope is bounded there, far "
        "above the rates of the gait. The same walks, with tolerances of the integrator that "
        "differ by orders of magnitude, show whether that is resolved."
    )
    if "smc" in least:
        text += f" At least {100.0 * least['smc']:.1f} % of them end with the same step and fall"
        text += f" ({100.0 * least['hzd']:.1f} % in the smooth scheme)." if "hzd" in least else "."
    if ratios:
        least_ratio, most = min(ratios), max(ratios)
        text += (
            f" A step costs {least_ratio:.1f} to {most:.1f} times the evaluations of the closed "
            "loop that the same gait takes with α = 1, where the law is smooth: "
            + ("no more than ten times." if most <= 10.0 else "more than ten times.")
        )
    if len(cost) == 2:
        ratio = np.mean(cost["smc"]) / np.mean(cost["hzd"])
        text += f" A swing costs {ratio:.1f} times as much as one of the smooth scheme."
    return f"<p>{text}</p>"


def _only(table: Table, name: str) -> Table:
    """The rows of a table that are about a controller."""
    rows = [row for row in table.rows if row["controller"] == name]
    columns = tuple(column for column in table.columns if column.key != "controller")
    return Table(table.name, "", columns, rows)


def _table(table: Table) -> str:
    """A table; columns without any cell are left out."""
    columns = [c for c in table.columns if any(r.get(c.key) is not None for r in table.rows)]
    head = "".join(
        f"<th{_class(c)} scope=col>{_text(c.heading)}</th>" for c in columns
    )  # fmt: skip
    body, before = [], None
    for row in table.rows:
        cells = "".join(_cell(row.get(c.key), c) for c in columns)
        group = row.get("controller")
        first = before is not None and group != before
        body.append(f"<tr{' class=first' if first else ''}>{cells}</tr>")
        before = group
    caption = f"<caption>{_text(table.title)}</caption>" if table.title else ""
    notes = "".join(f'<p class="note">{_text(note)}</p>' for note in table.notes)
    return (
        f'<div class="scroll"><table>{caption}<thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>{notes}"
    )


def _class(column: Column) -> str:
    return "" if column.kind == TEXT else ' class="n"'


def _cell(value: Any, column: Column) -> str:
    if column.key == "verdict":
        kind = {HOLDS: " holds", DIFFERS: " differs"}.get(value, "")
        return f'<td><span class="badge{kind}">{escape(str(value))}</span></td>'
    if column.kind == TEXT:
        text = "" if value is None else str(value)
        return f"<td{' class=long' if len(text) > 45 else ''}>{_text(text)}</td>"
    kind = "n ours" if column.key == "here" else "n"
    return f'<td class="{kind}">{_value(value, column.kind)}</td>'


def _value(value: Any, kind: str) -> str:
    """A number for a reader."""
    if value is None:
        return "–"
    if kind == INTERVAL:
        return "–" if None in value else f"{number(value[0])} to {number(value[1])}"
    value = float(value)
    if not math.isfinite(value):
        return "∞" if value > 0.0 else "–"
    if kind == COUNT:
        return _thousands(round(value))
    if kind == FIXED:
        return f"{value:.4f}".replace("-", "−")
    if kind == DIFFERENCE:
        return difference(1.0 + value / 100.0, 1.0).replace("-", "−").replace("x ", "× ")
    if kind == SECONDS:
        return duration_text(value)
    if kind == SHARE:
        return f"{100.0 * value:.1f} %"
    text = number(value)
    if "e" in text:
        digits, _, exponent = text.partition("e")
        return f"{float(digits):.2f}·10<sup>{int(exponent)}</sup>".replace("-", "−")
    return text.replace("-", "−")


def _text(text: str) -> str:
    """Text with its symbols' indices set as such."""
    found = re.sub(r"\b(σ|d|α|K)_(s|thr|[0-6PD])(?![a-z])", r"\1<sub>\2</sub>", escape(text))
    return re.sub(r"(?<=</sub>)\^(\d)", r"<sup>\1</sup>", found)


def _figure(picture: Picture, titled: bool = True) -> str:
    data = base64.b64encode(picture.data).decode()
    title = f"<b>{_text(picture.title)}.</b> " if titled else ""
    return (
        f'<figure><img alt="{escape(picture.title)}" src="data:{picture.mime};base64,{data}">'
        f"<figcaption>{title}{_text(picture.caption)}</figcaption></figure>"
    )


def _folded(summary: str, text: str) -> str:
    return f"<details><summary>{_text(summary)}</summary>{text}</details>" if text else ""


def _computed(results: Results, seconds: Mapping[str, float]) -> str:
    rows = [{"what": what, "seconds": value} for what, value in seconds.items()]
    columns = (Column("what", "what", TEXT), Column("seconds", "time", SECONDS))
    return (
        "<p>Meshes were grown by ROS 2 nodes: a mesher that keeps all simulators busy, an analysis "
        "that solves the chain, and a recorder for each mesh. Limit cycles, walks and pictures "
        "were computed by one process for each core. Monte Carlo of Tables 2 and 4: "
        f"{plural(results.plan.walks, 'walk')} of each controller.</p>"
        + _table(Table("times", "Times of this run, jobs side by side added up; what was there "
                       "already took none", columns, rows))
    )  # fmt: skip
