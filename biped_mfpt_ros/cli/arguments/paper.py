"""Arguments of `reproduce` and `calibrate`."""

from __future__ import annotations

from biped_mfpt_ros.cli.arguments.shared import FRICTION_FRAMES, Add, limit, number, typed, whole

# The grid of `calibrate`.
_PAPER_CONTROLLERS = ("hzd/base", "hzd/cot", "hzd/mfpt", "smc/base", "smc/cot", "smc/mfpt")
_TORQUE_LIMITS = (40.0, 45.0, 50.0, 55.0, 60.0, 80.0, 100.0, 120.0, 150.0, float("inf"))
_FRICTIONS = (0.55, 0.6, 0.65, 0.7, 0.8)
_SLIP_DURATIONS = (0.0, 0.003, 0.005, 0.008, 0.012)


def add_reproduce(add: Add) -> None:
    """Add `reproduce`."""
    reproduce = add(
        "reproduce",
        "reproduce:reproduce",
        "compute the paper's Tables 1 to 5 and Figures 2 and 3, each number beside the paper's",
        """
Meshes are grown by the ROS 2 pipeline with all simulators, with a bag for each; walks and limit
cycles are computed in this process. Each result is kept as soon as it is there: the same command
again goes on where it was stopped, and is done at once when nothing is missing. Results of other
settings, or of another step map, are computed anew.

The directory then holds report.html (one file, with all pictures), report.json, a .csv for each
table and figure, results/, bags/ and logs/. On two idle cores it takes 2 minutes, half of one with
--quick.

examples:
  biped-mfpt reproduce
  biped-mfpt reproduce --quick
  biped-mfpt reproduce --controllers hzd/base hzd/cot --output /tmp/report --json
""",
        "output",
    )
    reproduce.add_argument(
        "--quick", action="store_true", help="coarser meshes, fewer walks, no animations"
    )
    reproduce.add_argument(
        "--controllers",
        nargs="+",
        metavar="NAME",
        help="what to study, see `biped-mfpt controllers` (default: all six)",
    )
    reproduce.add_argument(
        "--walks",
        type=whole,
        metavar="N",
        help="Monte Carlo walks of Tables 2 and 4 (default: 10000, with --quick 500)",
    )
    reproduce.add_argument(
        "--workers",
        type=whole,
        metavar="N",
        help="simulator processes, and threads of the walks (default: one for each core)",
    )
    reproduce.add_argument(
        "--output",
        metavar="DIR",
        help="directory of the report and of all results; may exist (default: runs/reproduce, "
        "with --quick runs/reproduce-quick)",
    )
    reproduce.add_argument(
        "--no-pictures",
        dest="pictures",
        action="store_false",
        help="leave out the pictures of gaits and meshes",
    )


def add_calibrate(add: Add) -> None:
    """Add `calibrate`."""
    calibrate = add(
        "calibrate",
        "calibrate:calibrate",
        "fit what the paper leaves unsaid to its numbers",
        """
The paper states neither a torque limit nor a friction, nor whether a slip of a millisecond is a
fall, nor in which frame friction is judged at impact, nor when the scales r_i of a mesh are
refreshed. Every combination of the given values is judged by Tables 2 and 4, Monte Carlo and chain,
and has to fulfil what the paper claims: all controllers walk on flat ground; hzd/base falls down 1
degree, and walks on the flat and down 9 with no torque late in a step. Which values serve best is
told for one reading for all controllers, for one for each scheme, and so on, and how well the
numbers determine them. It takes about an hour of a core; stopped and started again it goes on where
it was.

examples:
  biped-mfpt calibrate                                    # the study that the defaults come from
  biped-mfpt calibrate --controllers hzd/base --torque-limit 45 50 55 --walks 2000
""",
        "output",
    )
    calibrate.add_argument(
        "--controllers",
        nargs="+",
        default=_PAPER_CONTROLLERS,
        metavar="NAME",
        help="what walks (default: the six of the paper)",
    )
    for option, values, what in (
        ("--torque-limit", _TORQUE_LIMITS, "N m, or none"),
        ("--friction", _FRICTIONS, "friction coefficients, or none"),
        ("--slip-duration", _SLIP_DURATIONS, "s, slips that do not count yet"),
    ):
        shown = " ".join("none" if x == float("inf") else f"{x:g}" for x in values)
        calibrate.add_argument(
            option,
            type=typed(limit, "numbers or none"),
            nargs="+",
            default=values,
            metavar="X",
            help=f"{what} (default: {shown})",
        )
    calibrate.add_argument(
        "--friction-frame",
        nargs="+",
        choices=FRICTION_FRAMES,
        default=FRICTION_FRAMES,
        help="what friction at impact is judged against (default: both)",
    )
    calibrate.add_argument(
        "--walks", type=whole, default=400, metavar="N", help="(default: %(default)s)"
    )
    calibrate.add_argument(
        "--seed", type=whole, default=1, metavar="N", help="of all walks (default: %(default)s)"
    )
    calibrate.add_argument(
        "--tolerance",
        type=number,
        default=1e-6,
        metavar="TOL",
        help="local error of the integrator, rad and rad/s (default: %(default)s)",
    )
    calibrate.add_argument(
        "--workers", type=whole, metavar="N", help="processes (default: one for each core)"
    )
    calibrate.add_argument(
        "--output",
        default="runs/calibrate",
        metavar="DIR",
        help="where results are kept; those that are there are not computed again "
        "(default: %(default)s)",
    )
