"""What pictures have in common: colours, sizes, and what a finished picture is.

Pictures are narrow, so that their text can still be read at the width of a phone: in a figure 5.2
inches wide, the 10 points of the default font are 10 pixels of 375.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from PIL import Image

from biped_mfpt_ros.files import whole_file
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
        with whole_file(path, new=True) as file:
            file.write(self.data)


def new_figure(height: float, width: float = WIDTH) -> Figure:
    """An empty figure, inches; `pixels` draws it, without a display."""
    return Figure(figsize=(width, height), dpi=DPI, layout="constrained")


def legend_below(figure: Figure, handles: Sequence[Artist], labels: Sequence[str]) -> None:
    """Put a legend of three columns below all axes of a `new_figure`.

    As ``loc="outside lower center"`` does from matplotlib 3.7 on; Ubuntu 24.04 has 3.6.
    """
    legend = figure.legend(handles, labels, loc="lower center", ncols=3, frameon=False)
    height = legend.get_window_extent(FigureCanvasAgg(figure).get_renderer()).height
    share = height / figure.bbox.height
    figure.get_layout_engine().set(rect=(0.0, share, 1.0, 1.0 - share))


def pixels(figure: Figure) -> np.ndarray:
    """Draw a figure; RGB, uint8, shape (height, width, 3)."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def with_palette(frames: Sequence[np.ndarray], colours: int) -> list[Image.Image]:
    """Pictures with one palette for all, of their commonest colours, so that areas keep theirs.

    There is no dithering, so that in an animation what does not move costs nothing.

    Parameters
    ----------
    frames : sequence of numpy.ndarray
        As `pixels` returns them.
    colours : int
        At most, to 256.
    """

    def coarse(colour: np.ndarray) -> np.ndarray:
        """18 of the 24 bits of colours."""
        red, green, blue = np.moveaxis(colour >> 2, -1, 0).astype(np.int32)
        return red << 12 | green << 6 | blue

    cells = [coarse(frame) for frame in frames]
    # A few frames have all colours of an animation that are common.
    counted = np.zeros(1 << 18, np.intp)
    kinds = []
    for i in sorted({*range(0, len(frames), max(1, len(frames) // 5)), len(frames) - 1}):
        counted += np.bincount(cells[i].ravel(), minlength=1 << 18)
        kinds.append(frames[i].reshape(-1, 3))
    common = np.argsort(-counted, kind="stable")[: min(colours, np.count_nonzero(counted))]
    # Of each cell that is common the commonest colour itself.
    code = np.concatenate(kinds).astype(np.int32)
    code = code[:, 0] << 16 | code[:, 1] << 8 | code[:, 2]
    found, counts = np.unique(code, return_counts=True)
    found = found[np.argsort(-counts, kind="stable")]
    found = np.stack([found >> 16, found >> 8 & 255, found & 255], axis=1)
    where, first = np.unique(coarse(found), return_index=True)
    palette = found[first[np.searchsorted(where, common)]]

    is_used = np.zeros(1 << 18, np.bool_)
    for cell in cells:
        is_used[cell] = True
    (used,) = is_used.nonzero()
    centres = np.stack([used >> 12, used >> 6 & 63, used & 63], axis=1) * 4 + 2
    index = np.zeros(1 << 18, np.uint8)
    index[used] = np.square(centres[:, None] - palette).sum(axis=2).argmin(axis=1)
    index[common] = np.arange(len(common))
    out = []
    for cell in cells:
        image = Image.fromarray(index[cell])
        image.putpalette(palette.astype(np.uint8).tobytes())
        out.append(image)
    return out


def png(figure: Figure) -> bytes:
    """A figure as PNG, with a palette: half the size, and the same bytes for the same picture."""
    file = io.BytesIO()
    (image,) = with_palette([pixels(figure)], 256)
    image.save(file, "PNG", optimize=True, dpi=(DPI, DPI))
    return file.getvalue()


def tidy(axes: Axes, grid: str = "both") -> None:
    """Take away what carries no data, and put a faint grid behind (``"x"``, ``"y"``, ...)."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis=grid, which="major", color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)


def slope_norm(slopes_deg: np.ndarray) -> Normalize:
    """Range of colours for slopes in degrees, flat in the middle."""
    largest = float(np.abs(slopes_deg).max(initial=0.0)) or 1.0
    return Normalize(-largest, largest)
