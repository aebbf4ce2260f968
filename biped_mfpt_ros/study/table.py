"""A table of a study."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from typing import Any

COUNT, NUMBER, FIXED, DIFFERENCE, INTERVAL, TEXT, SECONDS, SHARE = (
    "count", "number", "fixed", "difference", "interval", "text", "seconds", "share",
)  # fmt: skip
"""Kinds of columns: a whole number, one to five digits, one to four decimals, a difference in per
cent, an interval ``[low, high]``, text, seconds, a share from 0 to 1."""


@dataclass(frozen=True)
class Column:
    """A column of a table: key, heading, and how its cells are shown."""

    key: str
    heading: str
    kind: str = NUMBER


@dataclass(frozen=True)
class Table:
    """A table of the study.

    Attributes
    ----------
    name : str
        By which files and JSON know it.
    title : str
        What it shows.
    columns : tuple of Column
    rows : list of dict
        Cells by the columns' keys; None where there is nothing.
    notes : tuple of str
        What has to be said about it.
    """

    name: str
    title: str
    columns: tuple[Column, ...]
    rows: list[dict[str, Any]]
    notes: tuple[str, ...] = ()

    def csv(self) -> str:
        """The rows as CSV; numbers read back exactly, an interval takes two columns."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        names: list[str] = []
        for column in self.columns:
            two = column.kind == INTERVAL
            names += [f"{column.key}_low", f"{column.key}_high"] if two else [column.key]
        writer.writerow(names)
        for row in self.rows:
            cells: list[Any] = []
            for column in self.columns:
                value = row.get(column.key)
                cells += (value or [None, None]) if column.kind == INTERVAL else [value]
            writer.writerow(["" if cell is None else cell for cell in cells])
        return out.getvalue()

    def to_dict(self) -> dict[str, Any]:
        """Name, title, rows and notes, for JSON."""
        return {"title": self.title, "rows": self.rows, "notes": list(self.notes)}
