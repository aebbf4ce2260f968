"""What pictures have in common: colours, sizes, and what a finished picture is.

Pictures are narrow, so that their text can still be read at the width of a phone: in a figure 5.2
inches wide, the 10 points of the default font are 10 pixels of 375.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure

from biped_mfpt_ros.walker.outcome import Outcome

WIDTH, DPI = 5.2, 220  # inches, dots per inch

# Told apart by readers with any colour vision: blue and orange first, then by lightness.
OURS, PAPER, STANCE, SWING, BODY, GROUND, GRID = (
    "#1f5fa8", "#d1495b", "#1f5fa8", "#e08e1b", "#333a45", "#8a7f72", "#d9dde3",
)  # fmt: skip

OUTCOME_COLOURS: dict[Outcome, str] = {
    Outcome.STANCE_LIFTS: "#56b4e9",
    Outcome.STANCE_SLIPS: "#0072b2",
    Outcome.SWING_SCUFFS: "#e69f00",
    Outcome.FOOT_BEHIND: "#f0e442",
    Outcome.IMPACT_PULLS: "#cc79a7",
    Outcome.IMPACT_SLIPS: "#d55e00",
    Outcome.NO_LIFT_OFF: "#009e73",
    Outcome.BODY_TOUCHES: "#333a45",
    Outcome.TIME_LIMIT: "#8d949e",
    Outcome.NOT_FINITE: "#c9cdd3",
}
"""Colour of each way to fall, the same in every picture (palette of Okabe and Ito)."""

SLOPES: Colormap = LinearSegmentedColormap.from_list(
    "slopes", ["#0b3c7a", "#2f7fc4", "#a9adb3", "#e08e1b", "#9c4f00"]
)
"""Downhill blue, flat grey, uphill orange: no end fades into the white of the page."""


@dataclass(frozen=True)
class Picture:
    """A finished picture.

    Attributes
    ----------
    title : str
        A line.
    caption : str
        What it shows, in sentences that can stand alone.
    data : bytes
        The file.
    mime : str
        ``"image/png"`` or ``"image/gif"``.
    """

    title: str
    caption: str
    data: bytes
    mime: str = "image/png"

    def save(self, path: str | Path) -> None:
        """Write the file anew; FileExistsError if there is one."""
        with open(path, "xb") as file:
            file.write(self.data)


def new_figure(height: float, width: float = WIDTH) -> Figure:
    """An empty figure, inches, drawn without a display."""
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def png(figure: Figure) -> bytes:
    """A figure as PNG, the same bytes for the same picture."""
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": None}, pil_kwargs={"optimize": True})
    return file.getvalue()


def tidy(axes: Axes, grid: str = "both") -> None:
    """Take away what carries no data, and put a faint grid behind (``"x"``, ``"y"``, ...)."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis=grid, which="major", color=GRID, linewidth=0.8)  # type: ignore[arg-type]
    axes.set_axisbelow(True)


def slope_norm(slopes_deg: np.ndarray) -> Normalize:
    """Range of colours for slopes in degrees, flat in the middle."""
    largest = float(np.abs(slopes_deg).max(initial=0.0)) or 1.0
    return Normalize(-largest, largest)
