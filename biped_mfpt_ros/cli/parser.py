"""What `biped-mfpt` accepts. Imports nothing but argparse: `--help` has to be quick.

Each subcommand names the function that does it as ``"module:function"``, which `main` imports when
it is wanted. Options that several commands share are in parent parsers, written once.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from typing import Any, NoReturn

from biped_mfpt_ros import __version__

CLI = "biped_mfpt_ros.cli"
PICTURES = ("gait", "animation", "phase", "torques", "mesh", "distribution", "falls")
NODES = ("simulator", "mesher", "analysis", "recorder", "optimiser")

DEFAULT_CONTROLLER = "hzd/mfpt"

_DESCRIPTION = """\
How many steps does a walking robot take on rough ground before it falls?

biped-mfpt walks the five-link biped RABBIT on slopes drawn from a normal distribution, meshes the
states that it can reach, makes a Markov chain of them and computes the mean first-passage time
(MFPT) to a fall, in steps.
"""

_EPILOG = """\
examples:
  biped-mfpt run                                  the pipeline over ROS 2, recorded, with a picture
  biped-mfpt mfpt --controller hzd/mfpt --sigma 1 2 --slope-step 0.5 --threshold 0.3
  biped-mfpt monte-carlo --controller hzd/cot --sigma 2 --walks 10000 --seed 1
  biped-mfpt cycle --controller hzd/base --json   one JSON object on stdout, for scripts

units:
  On the command line slopes and their spread are in degrees (negative is downhill), states in rad
  and rad/s, everything else in SI units. JSON is in SI units and radians throughout; the few keys
  that are in degrees end in _deg. An infinite value is the string "inf", an undefined one null.

exit codes:
  0  done    1  could not be done (no limit cycle, a node died, ...)    2  bad input    130  stopped

`biped-mfpt COMMAND --help` tells more.
"""


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


def _value(convert: Callable[[str], Any], allowed: str) -> Callable[[str], Any]:
    """Type of an option whose text is converted, with a message that says what is allowed."""

    def parse(text: str) -> Any:
        try:
            return convert(text)
        except ValueError:
            raise argparse.ArgumentTypeError(
                f"{text!r} is not allowed; allowed: {allowed}"
            ) from None

    return parse


def _limit(text: str) -> float:
    return float("inf") if text == "none" else float(text)


def _state(text: str) -> list[float]:
    values = [float(part) for part in text.split(",")]
    if len(values) != 10:
        raise ValueError
    return values


# The grid of `calibrate`.
_PAPER_CONTROLLERS = ("hzd/base", "hzd/cot", "hzd/mfpt", "smc/base", "smc/cot", "smc/mfpt")
_TORQUE_LIMITS = (40.0, 45.0, 50.0, 55.0, 60.0, 80.0, 100.0, 120.0, 150.0, float("inf"))
_FRICTIONS = (0.55, 0.6, 0.65, 0.7, 0.8)
_SLIP_DURATIONS = (0.0, 0.003, 0.005, 0.008, 0.012)
_FRICTION_FRAMES = ("slope", "vertical")


def _mesh_stage(text: str) -> tuple[float, ...]:
    parts = [float(part) for part in text.split(":")]
    if not 2 <= len(parts) <= 4:
        raise ValueError
    return tuple(parts)


def _assignment(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    return name, float(value or "1")


_number = _value(float, "a number")
_whole = _value(int, "a whole number")


def _parents() -> dict[str, Parser]:
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
    walker.add_argument(
        "--controller",
        default=DEFAULT_CONTROLLER,
        metavar="NAME",
        help="what walks, see `biped-mfpt controllers` (default: %(default)s)",
    )
    walker.add_argument(
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
        type=_value(_limit, "a number (N m) or none"),
        metavar="NM",
        help="N m on every joint, or none (default: 50)",
    )
    walker.add_argument(
        "--friction",
        type=_value(_limit, "a number or none"),
        metavar="MU",
        help="coefficient between foot and ground, or none for no slip (default: 0.6)",
    )
    walker.add_argument(
        "--friction-frame",
        choices=_FRICTION_FRAMES,
        help="what friction at impact is judged against: the slope ahead, or level ground "
        "(default: slope)",
    )
    walker.add_argument(
        "--slip-duration",
        type=_number,
        metavar="S",
        help="s, how long the stance foot must slip before it counts as a fall (default: 0)",
    )
    walker.add_argument(
        "--time-limit",
        type=_number,
        metavar="S",
        help="s, a swing that lasts longer is a fall (default: 3)",
    )
    walker.add_argument(
        "--tolerance",
        type=_number,
        metavar="TOL",
        help="local error of the integrator, rad and rad/s (default: 2e-8)",
    )

    terrain = group("terrain", "terrain")
    terrain.add_argument(
        "--mean",
        type=_number,
        default=0.0,
        metavar="DEG",
        help="degrees, mean slope (default: 0)",
    )

    mesh = group("mesh", "mesh")
    mesh.add_argument(
        "--slope-step",
        type=_number,
        default=0.25,
        metavar="DEG",
        help="degrees between the slopes of the set, d_s of the paper (default: 0.25)",
    )
    mesh.add_argument(
        "--slope-limit",
        type=_number,
        default=20.0,
        metavar="DEG",
        help="degrees, steepest slope of the set (default: 20)",
    )
    mesh.add_argument(
        "--threshold",
        type=_number,
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
        type=_whole,
        metavar="N",
        help="give up when the mesh grows beyond N states (default: 100000)",
    )
    return groups


_STORE = "runs/studies.sqlite"


def _add_optimise(add: Callable[..., Parser]) -> None:
    optimise = add(
        "optimise",
        "optimise:optimise",
        "search for a controller that takes more steps before it falls",
        """
Over ROS 2, like `biped-mfpt run`: simulators, mesher, analysis, optimiser and recorder as processes
of their own, started again if they die; with --local in this process.

Starts at --controller. Each candidate is scored in stages: limit cycle and constraints on flat
ground, a coarse mesh, finer ones if it is close to the best so far, and Monte Carlo at a larger
sigma. Only what came through all of them is called the best.

Trials are kept in --store. The same command again goes on where it was stopped, or killed; several
at the same time share the work. The trials depend on the settings and the seed alone, not on how
many workers score them. `biped-mfpt study` lists, shows, plots and exports studies.

examples:
  biped-mfpt optimise --controller hzd/mfpt --sigma 1 --trials 4000
  biped-mfpt optimise --controller smc/base --sigma 2 --searcher pattern --fix 'k*' \\
      --seconds 3600 --slip-duration 0.008 --torque-limit 45 --mesh 1:1 1:0.3:-0.02
  biped-mfpt optimise --controller hzd/robust --as-spline --sigma 5 --slope-limit 45
  biped-mfpt optimise --controller hzd/base --objective mfpt cot=20 --searcher nsga2 \\
      --limit speed_min=0.6 clearance_min=0.02 --trials 2000 --study front
  biped-mfpt optimise --confirm front --mesh 0.25:0.03:inf:2000000 --seed 2
""",
        "walker",
        "output",
    )
    optimise.add_argument(
        "--study", metavar="NAME", help="its name (default: controller, searcher, sigma and seed)"
    )
    optimise.add_argument(
        "--store", default=_STORE, metavar="FILE", help="of the trials (default: %(default)s)"
    )
    optimise.add_argument(
        "--confirm",
        metavar="STUDY",
        help="no search: score the front of another study of the store again, that is, its "
        "confirmed trials that no other one beats in MFPT and cost of transport. --mesh, "
        "--slope-limit, --check-walks, --trial-seconds, --tolerance and --seed are as given, all "
        "else is as in STUDY",
    )
    optimise.add_argument(
        "--searcher",
        default="cma-es",
        metavar="NAME",
        help="cma-es, nelder-mead, pattern or nsga2 (default: %(default)s)",
    )
    optimise.add_argument(
        "--objective",
        type=_value(_assignment, "NAME or NAME=WEIGHT"),
        nargs="+",
        default=[("mfpt", 1.0)],
        metavar="NAME=W",
        help="mfpt (in decades), cot (less is better), speed (m/s), with weights of 1 unless "
        "given; nsga2 takes several for a front, the others add them up (default: mfpt)",
    )
    optimise.add_argument(
        "--limit",
        type=_value(_assignment, "NAME=VALUE"),
        nargs="+",
        default=[],
        metavar="NAME=X",
        help="constraints on flat ground: speed_min, speed_max (m/s), clearance_min, "
        "step_length_min, step_length_max (m), torque_max (N m)",
    )
    optimise.add_argument(
        "--as-spline",
        action="store_true",
        help="start at B-spline references fitted to those of the controller, which must be hzd",
    )
    optimise.add_argument(
        "--fix",
        nargs="+",
        default=[],
        metavar="PATTERN",
        help="parameters that stay as they are, such as kp or 'alpha_*^3'",
    )
    optimise.add_argument(
        "--sigma",
        type=_number,
        default=1.0,
        metavar="DEG",
        help="degrees, standard deviation of the slope (default: %(default)g)",
    )
    optimise.add_argument(
        "--mean", type=_number, default=0.0, metavar="DEG", help="degrees, mean slope (default: 0)"
    )
    optimise.add_argument(
        "--mesh",
        type=_value(_mesh_stage, "D_S:D_THR, D_S:D_THR:MARGIN or D_S:D_THR:MARGIN:MAX_STATES"),
        nargs="+",
        metavar="D_S:D_THR:MARGIN:N",
        help="meshes, coarse to fine: degrees between slopes, threshold, decades of MFPT below the "
        "best at which a candidate still gets this mesh (negative: above it), most states "
        "(default: 0.5:0.3 0.5:0.1:1 0.25:0.03:-0.02)",
    )
    optimise.add_argument(
        "--slope-limit",
        type=_number,
        default=20.0,
        metavar="DEG",
        help="degrees, steepest slope of the sets (default: 20)",
    )
    optimise.add_argument(
        "--check-walks",
        type=_whole,
        default=100,
        metavar="N",
        help="Monte Carlo walks that have to agree with the last mesh; 0: no such check "
        "(default: %(default)s)",
    )
    optimise.add_argument(
        "--step",
        type=_number,
        default=1.0,
        metavar="X",
        help="first steps of the search, as a multiple of the usual ones (default: 1)",
    )
    optimise.add_argument(
        "--population",
        type=_whole,
        default=0,
        metavar="N",
        help="candidates in a generation (default: the searcher's own)",
    )
    optimise.add_argument(
        "--runs",
        type=_whole,
        default=0,
        metavar="N",
        help="runs of cma-es from the same start, each with random numbers of its own; they take "
        "turns, and the worse half ends again and again (default: 4; 1 is better for less than "
        "3000 trials)",
    )
    optimise.add_argument(
        "--trials", type=_whole, metavar="N", help="stop when the study has N trials"
    )
    optimise.add_argument(
        "--seconds", type=_number, metavar="S", help="s, begin no trial after that"
    )
    optimise.add_argument(
        "--trial-seconds",
        type=_number,
        default=600.0,
        metavar="S",
        help="s, after which a trial is given up (default: %(default)g)",
    )
    optimise.add_argument(
        "--seed", type=_whole, default=1, metavar="N", help="of the search (default: 1)"
    )
    optimise.add_argument(
        "--workers",
        type=_whole,
        metavar="N",
        help="simulators, or with --local trials at the same time (default: one for each core)",
    )
    optimise.add_argument(
        "--local",
        action="store_true",
        help="in this process, without ROS: the same trials, bit for bit",
    )
    optimise.add_argument(
        "--no-record", dest="record", action="store_false", help="keep no bag of what is published"
    )


def _add_study(add: Callable[..., Parser]) -> None:
    study = add(
        "study",
        "study:study",
        "list, show, plot or export studies of `biped-mfpt optimise`",
        """
  list     all studies of a store                show    the trials of one, and its best
  plot     best score over trials, as a PNG      export  its best controller, as JSON
  front    cost of transport against MFPT of one or more studies, with the paper's controllers

What `export` writes is taken by --controller-file of the other commands, and its "catalogue" can
be put into data/controllers.json.

examples:
  biped-mfpt study list
  biped-mfpt study show hzd-mfpt-cma-es-1 --top 20
  biped-mfpt study export hzd-mfpt-cma-es-1 --output best.json
  biped-mfpt study front front-hzd front-smc --output front.png
""",
        "output",
    )
    study.add_argument("what", choices=("list", "show", "plot", "export", "front"), metavar="WHAT")
    study.add_argument("study", nargs="*", metavar="STUDY", help="name of a study")
    study.add_argument(
        "--store", default=_STORE, metavar="FILE", help="of the trials (default: %(default)s)"
    )
    study.add_argument("--output", metavar="FILE", help="new file, for plot, export and front")
    study.add_argument(
        "--trial", type=_whole, metavar="N", help="export this trial instead of the best"
    )
    study.add_argument(
        "--top", type=_whole, default=10, metavar="N", help="trials to show (default: %(default)s)"
    )


def _add_run(add: Callable[..., Parser]) -> None:
    run = add(
        "run",
        "pipeline:run",
        "run the whole pipeline over ROS 2 and compare the result with the paper",
        """
Starts simulators, mesher, analysis and recorder as processes of their own, grows the mesh of a
controller with all simulators, has the analysis compute the MFPT, and ends all processes again.
A directory keeps the bag with everything that was published, the logs, a picture and the result.

Each run has a ROS namespace of its own, so runs side by side do not mix. Simulators of other
machines join a run when they are started in its namespace:
  ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET biped-mfpt run --namespace rough
  ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET biped-mfpt node simulator --ros-args -r __ns:=/rough

examples:
  biped-mfpt run
  biped-mfpt run --controller hzd/base --threshold 0.1 --sigma 1 2
  biped-mfpt run --workers 8 --output runs/fine --threshold 0.03 --walks 0
""",
        "walker",
        "mesh",
        "terrain",
        "output",
    )
    run.add_argument(
        "--sigma",
        type=_number,
        nargs="+",
        default=[1.0, 2.0],
        metavar="DEG",
        help="degrees, standard deviations of the slope (default: 1 2)",
    )
    run.add_argument(
        "--walks",
        type=_whole,
        default=2000,
        metavar="N",
        help="Monte Carlo walks for each sigma at which the robot falls soon; 0: none "
        "(default: %(default)s)",
    )
    run.add_argument(
        "--seed", type=_whole, default=1, metavar="N", help="of the walks (default: 1)"
    )
    run.add_argument(
        "--workers",
        type=_whole,
        metavar="N",
        help="simulator processes to start here (default: one for each core)",
    )
    run.add_argument(
        "--namespace", metavar="NAME", help="ROS namespace of the nodes (default: unique)"
    )
    run.add_argument(
        "--on-record-error",
        choices=("stop", "go_on"),
        default="stop",
        help="what to do when the bag cannot be written any more, as on a full disk "
        "(default: %(default)s)",
    )
    run.add_argument(
        "--output",
        metavar="DIR",
        help="new directory for bag, picture and logs (default: runs/TIME-CONTROLLER)",
    )


def _add_mfpt(add: Callable[..., Parser]) -> None:
    mfpt = add(
        "mfpt",
        "meshes:mfpt",
        "mesh a controller and compute its mean first-passage time to a fall",
        """
The mesh does not depend on the distribution of the slopes, so that any number of standard
deviations costs one mesh. In this process, without ROS.

examples:
  biped-mfpt mfpt --controller hzd/mfpt --sigma 1 2 --slope-step 0.5 --threshold 0.3
  biped-mfpt mfpt --controller hzd/cot --sigma 0.5 1 1.5 2 --mean -1 --json
""",
        "walker",
        "mesh",
        "terrain",
        "output",
    )
    mfpt.add_argument(
        "--sigma",
        type=_number,
        nargs="+",
        required=True,
        metavar="DEG",
        help="degrees, standard deviations of the slope",
    )


def _add_mesh(add: Callable[..., Parser]) -> None:
    mesh = add(
        "mesh",
        "meshes:mesh",
        "mesh the states that a controller can reach",
        """
Algorithm 1 of the paper, in this process, without ROS. With --output the mesh is written to a
file of numpy arrays (.npz): slopes, states, preceding, generation, targets, outcomes, scales.

examples:
  biped-mfpt mesh --controller hzd/base --threshold 0.1
  biped-mfpt mesh --controller hzd/cot --slope-step 1 --output cot.npz --json
""",
        "walker",
        "mesh",
        "output",
    )
    mesh.add_argument("--output", metavar="FILE", help="write the mesh to this new .npz file")


def _add_monte_carlo(add: Callable[..., Parser]) -> None:
    monte_carlo = add(
        "monte-carlo",
        "single:monte_carlo",
        "walk on random slopes until the fall, many times",
        """
As for Table 2 of the paper: the first step is dropped, walks that fell in it are not counted.
Each walk has a random generator of its own: the result depends on the seed alone, not on the
number of cores. Slopes beyond 45 degrees are cut to that.

examples:
  biped-mfpt monte-carlo --controller hzd/cot --sigma 2 --walks 10000 --seed 1
  biped-mfpt monte-carlo --controller hzd/base --sigma 2 --torque-limit none --json
""",
        "walker",
        "terrain",
        "output",
    )
    monte_carlo.add_argument(
        "--sigma",
        type=_number,
        required=True,
        metavar="DEG",
        help="degrees, standard deviation of the slope",
    )
    monte_carlo.add_argument(
        "--walks", type=_whole, default=10_000, metavar="N", help="(default: %(default)s)"
    )
    monte_carlo.add_argument(
        "--seed", type=_whole, default=1, metavar="N", help="of all walks (default: %(default)s)"
    )
    monte_carlo.add_argument(
        "--max-steps",
        type=_whole,
        default=10_000,
        metavar="N",
        help="stop a walk that has not fallen after N steps (default: %(default)s)",
    )


def _add_cycle(add: Callable[..., Parser]) -> None:
    cycle = add(
        "cycle",
        "single:cycle",
        "find a controller's limit cycle, its speed, cost of transport and eigenvalues",
        """
Newton's method on the step map; the eigenvalues are those of its Jacobian at the cycle.

examples:
  biped-mfpt cycle --controller hzd/base
  biped-mfpt cycle --controller smc/mfpt --slope -1 --json
""",
        "walker",
        "output",
    )
    cycle.add_argument(
        "--slope",
        type=_number,
        default=0.0,
        metavar="DEG",
        help="degrees, constant slope, negative is downhill (default: 0)",
    )


def _add_step(add: Callable[..., Parser]) -> None:
    step = add(
        "step",
        "single:step",
        "simulate one step from a state",
        """
A state is q1,..,q5,dq1,..,dq5 just after impact, in rad and rad/s: stance femur, swing femur
(relative to the torso), stance tibia, swing tibia (relative to their femurs), torso (absolute);
counter-clockwise is positive and the robot walks towards +x. `biped-mfpt cycle` prints one.

examples:
  biped-mfpt step --controller hzd/base --previous-slope 0 --slope -2 \\
      --state 3.6151,3.0349,-0.4162,-0.3200,-0.0158,0.3741,-1.9168,-3.5620,1.0227,0.1408
""",
        "walker",
        "output",
    )
    step.add_argument(
        "--state",
        type=_value(_state, "ten numbers q1,..,q5,dq1,..,dq5 in rad and rad/s"),
        required=True,
        metavar="Q1,..,DQ5",
        help="rad and rad/s, just after impact",
    )
    step.add_argument(
        "--previous-slope",
        type=_number,
        default=0.0,
        metavar="DEG",
        help="degrees, ground behind the stance foot (default: 0)",
    )
    step.add_argument(
        "--slope",
        type=_number,
        default=0.0,
        metavar="DEG",
        help="degrees, ground ahead, negative is downhill (default: 0)",
    )


def _add_reproduce(add: Callable[..., Parser]) -> None:
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
        type=_whole,
        metavar="N",
        help="Monte Carlo walks of Tables 2 and 4 (default: 10000, with --quick 500)",
    )
    reproduce.add_argument(
        "--workers",
        type=_whole,
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


def _add_calibrate(add: Callable[..., Parser]) -> None:
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
numbers determine them. Stopped and started again it goes on where it was.

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
        shown = " ".join("none" if value == float("inf") else f"{value:g}" for value in values)
        calibrate.add_argument(
            option,
            type=_value(_limit, "numbers or none"),
            nargs="+",
            default=values,
            metavar="X",
            help=f"{what} (default: {shown})",
        )
    calibrate.add_argument(
        "--friction-frame",
        nargs="+",
        choices=_FRICTION_FRAMES,
        default=_FRICTION_FRAMES,
        help="what friction at impact is judged against (default: both)",
    )
    calibrate.add_argument(
        "--walks", type=_whole, default=400, metavar="N", help="(default: %(default)s)"
    )
    calibrate.add_argument(
        "--seed", type=_whole, default=1, metavar="N", help="of all walks (default: %(default)s)"
    )
    calibrate.add_argument(
        "--tolerance",
        type=_number,
        default=1e-6,
        metavar="TOL",
        help="local error of the integrator, rad and rad/s (default: %(default)s)",
    )
    calibrate.add_argument(
        "--workers", type=_whole, metavar="N", help="processes (default: one for each core)"
    )
    calibrate.add_argument(
        "--output",
        default="runs/calibrate",
        metavar="DIR",
        help="where results are kept; those that are there are not computed again "
        "(default: %(default)s)",
    )


def _add_picture(add: Callable[..., Parser]) -> None:
    picture = add(
        "picture",
        "picture:picture",
        "draw a gait, an animation, phases, torques, a mesh or falls",
        """
Of a walk on random slopes, its last steps and its fall; the walk is one of those of `biped-mfpt
monte-carlo` with the same seed:
  gait          stick figures                       animation     the same as a GIF
  phase         rates over angles, limit cycle      torques       of the joints, and ground forces
Of a mesh and the Markov chain over it:
  mesh          its states on the principal plane   distribution  the metastable one, over the mesh
  falls         where and why the controller falls

examples:
  biped-mfpt picture animation --controller hzd/mfpt --sigma 2 --number 3 --output walk.gif
  biped-mfpt picture falls --controller hzd/base --sigma 1 --threshold 0.02 --output falls.png
""",
        "walker",
        "terrain",
        "mesh",
        "output",
    )
    picture.add_argument("kind", choices=PICTURES, metavar="KIND", help=", ".join(PICTURES))
    picture.add_argument(
        "--output", required=True, metavar="FILE", help="new file, .gif for an animation, or .png"
    )
    picture.add_argument(
        "--sigma",
        type=_number,
        default=2.0,
        metavar="DEG",
        help="degrees, standard deviation of the slope (default: %(default)g)",
    )
    picture.add_argument(
        "--seed", type=_whole, default=1, metavar="N", help="of all walks (default: %(default)s)"
    )
    picture.add_argument(
        "--number", type=_whole, default=0, metavar="N", help="of the walk (default: %(default)s)"
    )
    picture.add_argument(
        "--last-steps",
        type=_whole,
        default=8,
        metavar="N",
        help="how much of the walk to draw (default: %(default)s)",
    )


def _add_inspect(add: Callable[..., Parser]) -> None:
    inspect = add(
        "inspect",
        "bags:inspect",
        "read a recorded bag, rebuild its meshes and compute their MFPT again",
        """
The bag alone holds all that is needed: nothing is simulated, and the numbers equal those of the
run bit for bit.

examples:
  biped-mfpt inspect runs/20250131-120000-hzd-mfpt/bag
  biped-mfpt inspect runs/20250131-120000-hzd-mfpt/bag --sigma 0.5 1 1.5 2 --mean -1 --json
  biped-mfpt inspect runs/20250131-120000-hzd-mfpt/bag --repair saved
""",
        "output",
    )
    inspect.add_argument("bag", metavar="BAG", help="directory of a bag, or its .mcap file")
    inspect.add_argument(
        "--sigma",
        type=_number,
        nargs="+",
        metavar="DEG",
        help="degrees, standard deviations of the slope (default: those that were published)",
    )
    inspect.add_argument(
        "--mean",
        type=_number,
        metavar="DEG",
        help="degrees, mean slope to go with --sigma (default: 0)",
    )

    inspect.add_argument(
        "--repair",
        metavar="NEW",
        help="first copy what can be read of a bag that was cut off to this new directory, as a "
        "whole bag, and read that; BAG stays as it is",
    )


def _add_controllers(add: Callable[..., Parser]) -> None:
    controllers = add(
        "controllers",
        "single:controllers",
        "list the controllers: those of the paper with its figures, and others",
        """
With NAME print one of them as --controller-file takes it, to be changed. With the robot that it is
for, coefficients alpha_0 and alpha_1 of hzd are those of hybrid invariance on it.

examples:
  biped-mfpt controllers
  biped-mfpt controllers hzd/mfpt --robot-file robot.json > mine.json
""",
        "output",
    )
    controllers.add_argument("name", nargs="?", metavar="NAME", help="print this one as JSON")
    controllers.add_argument("--robot-file", metavar="FILE", help="print it for this robot")


def make_parser() -> Parser:
    """The parser of `biped-mfpt` with all its subcommands."""
    parser = Parser(prog="biped-mfpt", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument("--version", action="version", version=f"biped-mfpt {__version__}")
    commands = parser.add_subparsers(
        title="commands", metavar="COMMAND", dest="command", required=True, parser_class=Parser
    )
    parents = _parents()

    def add(name: str, function: str, summary: str, details: str, *groups: str) -> Parser:
        description, _, examples = details.strip().partition("\nexamples:\n")
        command = commands.add_parser(
            name,
            help=summary,
            description=f"{summary[0].upper()}{summary[1:]}.\n\n{description}",
            epilog=f"examples:\n{examples}" if examples else None,
            parents=[parents[group] for group in groups],
        )
        command.set_defaults(function=f"{CLI}.{function}", parser=command)
        return command

    _add_run(add)
    _add_mfpt(add)
    _add_mesh(add)
    _add_monte_carlo(add)
    _add_cycle(add)
    _add_step(add)
    _add_reproduce(add)
    _add_calibrate(add)
    _add_optimise(add)
    _add_study(add)
    _add_picture(add)
    _add_inspect(add)
    _add_controllers(add)

    node = commands.add_parser(
        "node",
        help="start one node of the pipeline",
        description="Start one node of the pipeline, like `ros2 run biped_mfpt_ros NAME`, where "
        "there is no ros2\ncommand. All that follows NAME goes to the node.",
        epilog="examples:\n"
        "  biped-mfpt node simulator\n"
        "  biped-mfpt node mesher --ros-args -r __ns:=/rough --log-level debug",
    )
    node.set_defaults(function=f"{CLI}.node:node", parser=node)
    node.add_argument(
        "--end-with", type=int, metavar="PID", help=argparse.SUPPRESS
    )  # of a parent that may be killed
    node.add_argument("name", choices=NODES, metavar="NAME", help=", ".join(NODES))
    node.add_argument("arguments", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)

    add(
        "compile",
        "kernels:compile_kernels",
        "compile the numeric kernels, so that nothing has to wait for that later",
        "Done once for a version of the sources; after that it takes a second and changes nothing.",
        "output",
    )
    return parser
