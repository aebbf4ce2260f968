"""Plain text tables and the numbers in them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence


def table(headers: Sequence[str], rows: Iterable[Sequence[object]], indent: str = "") -> str:
    """Lay out a table with aligned columns.

    Parameters
    ----------
    headers : sequence of str
        One for each column.
    rows : iterable of sequence
        Cells; anything but a string is shown with `number`. A column whose cells are all strings
        is aligned left, every other one right.
    indent : str, optional
        Put before every line.

    Returns
    -------
    str
        Lines without a newline at the end.
    """
    cells = [list(row) for row in rows]
    for row in cells:
        if len(row) != len(headers):
            raise ValueError(f"a row of {len(row)} cells under {len(headers)} headers: {row}")
    left = [all(isinstance(row[i], str) for row in cells) for i in range(len(headers))]
    lines = [list(headers)]
    lines += [[cell if isinstance(cell, str) else number(cell) for cell in row] for row in cells]
    widths = [max(len(line[i]) for line in lines) for i in range(len(headers))]
    lines.insert(1, ["-" * width for width in widths])
    return "\n".join(
        (
            indent
            + "  ".join(
                cell.ljust(width) if to_left else cell.rjust(width)
                for cell, width, to_left in zip(line, widths, left, strict=True)
            )
        ).rstrip()
        for line in lines
    )


def number(value: object) -> str:
    """A number for a reader: five significant digits, ``"-"`` for None."""
    if value is None:
        return "-"
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)
    if isinstance(value, int) or math.isinf(value) or math.isnan(value):
        return str(value)
    return f"{value:.5g}" if 1e-3 <= abs(value) < 1e5 or value == 0.0 else f"{value:.3e}"


def plural(number: int, noun: str) -> str:
    """How many there are of something, such as ``"1 state"`` or ``"2 states"``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def difference(value: float, reference: float) -> str:
    """Difference from a reference, such as ``"+3.2 %"``, or ``"x 1500"`` beyond a factor of 10."""
    ratio = value / reference
    return f"{100.0 * (ratio - 1.0):+.1f} %" if 0.1 <= ratio <= 10.0 else f"x {number(ratio)}"


def correlation_text(correlation: float) -> str:
    """What follows the standard deviation of slopes in a text; nothing for independent ones."""
    return f", correlation {correlation:g}" if correlation else ""


def ground_text(mean_deg: float, correlation: float) -> str:
    """What sets ground apart from the paper's; nothing for independent slopes of mean 0."""
    if not (mean_deg or correlation):
        return ""
    return f"; slopes with mean {mean_deg:g} deg{correlation_text(correlation)}"
