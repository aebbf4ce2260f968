"""Parser, types and the options that several commands share, written once."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from typing import Any, NoReturn

DEFAULT_CONTROLLER = "hzd/mfpt"
FRICTION_FRAMES = ("slope", "vertical")


class Parser(argparse.ArgumentParser):
    """An argument parser with one-line errors, that takes values such as ``-3.1,0.2`` as values."""

    def __init__(self, **settings: Any) -> None:
        settings.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(allow_abbrev=False, **settings)
        # Python before 3.14 takes only plain negative numbers for values, not -1e-3 or -1,2.
        self._negative_number_matcher = re.compile(r"-(\.?\d|inf|nan)")

    def error(self, message: str) -> NoReturn:
        """Print one line and exit with code 2."""
        message = re.sub(r"^argument (\S+?)(/\S+)?: ", r"\1: ", message)
        self.exit(2, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


Add = Callable[..., Parser]
"""Adds a command: its name, ``"module:function"``, summary, details and groups of options."""


def typed(convert: Callable[[str], Any], allowed: str) -> Callable[[str], Any]:
    """Type of an option whose text is converted, with a message that says what is allowed."""

    def parse(text: str) -> Any:
        try:
            return convert(text)
        except ValueError:
            raise argparse.ArgumentTypeError(
                f"{text!r} is not allowed; allowed: {allowed}"
            ) from None

    return parse


def limit(text: str) -> float:
    """A number, or infinity for ``none``."""
    return float("inf") if text == "none" else float(text)


number = typed(float, "a number")
whole = typed(int, "a whole number")


def shared_options() -> dict[str, Parser]:
    """The options that several commands share, by group."""
    groups = {}

    def group(name: str, title: str) -> argparse._ArgumentGroup:
        groups[name] = Parser(add_help=False)
        return groups[name].add_argument_group(title)

    output = group("output", "output")
    output.add_argument("--json", action="store_true", help="print one JSON object on stdout")
    output.add_argument("--quiet", action="store_true", help="show no progress on stderr")

    # Defaults of the model, and of all that the core checks itself, live in the core: an option
    # that is not given is None here and is not passed on.
    walker = group("walker", "walker")
    one_of = walker.add_mutually_exclusive_group()
    one_of.add_argument(
        "--controller",
        default=DEFAULT_CONTROLLER,
        metavar="NAME",
        help="what walks, see `biped-mfpt controllers` (default: %(default)s)",
    )
    one_of.add_argument(
        "--controller-file",
        metavar="FILE",
        help="take it from a JSON file instead, as `biped-mfpt controllers NAME` prints it",
    )
    walker.add_argument(
        "--robot-file",
        metavar="FILE",
        help="JSON file with masses, lengths and inertias, see docs/robot.md (default: RABBIT)",
    )
    walker.add_argument(
        "--torque-limit",
        type=typed(limit, "a number (N m) or none"),
        metavar="NM",
        help="N m on every joint, or none (default: 50)",
    )
    walker.add_argument(
        "--friction",
        type=typed(limit, "a number or none"),
        metavar="MU",
        help="coefficient between foot and ground, or none for no slip (default: 0.6)",
    )
    walker.add_argument(
        "--friction-frame",
        choices=FRICTION_FRAMES,
        help="what friction at impact is judged against: the slope ahead, or level ground "
        "(default: slope)",
    )
    walker.add_argument(
        "--slip-duration",
        type=number,
        metavar="S",
        help="s, how long the stance foot must slip before it counts as a fall (default: 0)",
    )
    walker.add_argument(
        "--time-limit",
        type=number,
        metavar="S",
        help="s, a swing that lasts longer is a fall (default: 3)",
    )
    walker.add_argument(
        "--tolerance",
        type=number,
        metavar="TOL",
        help="local error of the integrator, rad and rad/s (default: 4e-8)",
    )

    terrain = group("terrain", "terrain")
    terrain.add_argument(
        "--mean",
        type=number,
        default=0.0,
        metavar="DEG",
        help="degrees, mean slope (default: 0)",
    )
    terrain.add_argument(
        "--correlation",
        type=number,
        default=0.0,
        metavar="R",
        help="of each slope with the one before, above -1 and below 1; above 0 ground rolls, see "
        "docs/ground.md (default: 0, independent slopes)",
    )

    mesh = group("mesh", "mesh")
    mesh.add_argument(
        "--slope-step",
        type=number,
        default=0.25,
        metavar="DEG",
        help="degrees between the slopes of the set, d_s of the paper (default: 0.25)",
    )
    mesh.add_argument(
        "--slope-limit",
        type=number,
        default=20.0,
        metavar="DEG",
        help="degrees, steepest slope of the set (default: 20)",
    )
    mesh.add_argument(
        "--threshold",
        type=number,
        default=0.03,
        metavar="D",
        help="standardized squared distance from which on a state is a new one, d_thr of the "
        "paper (default: 0.03)",
    )
    mesh.add_argument(
        "--unclustered",
        action="store_true",
        help="look for the nearest state among all, not only among those after the same slope",
    )
    mesh.add_argument(
        "--scale-refresh",
        choices=("generation", "addition"),
        help="when the scales of the distance between states are computed anew: for each "
        "generation, or after each state that is added (default: generation)",
    )
    mesh.add_argument(
        "--max-states",
        type=whole,
        metavar="N",
        help="give up when the mesh grows beyond N states (default: 100000)",
    )
    return groups
