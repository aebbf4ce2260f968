"""Arguments of `optimise` and `study`."""

from __future__ import annotations

from biped_mfpt_ros.cli.arguments.shared import Add, number, typed, whole

_STORE = "runs/studies.sqlite"


def _mesh_stage(text: str) -> tuple[float, ...]:
    parts = [float(part) for part in text.split(":")]
    if not 2 <= len(parts) <= 4:
        raise ValueError
    return tuple(parts)


def _assignment(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    return name, float(value or "1")


def add_optimise(add: Add) -> None:
    """Add `optimise`."""
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
        "terrain",
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
        "confirmed trials that no other one beats in MFPT, cost of transport and every other "
        "objective. --mesh, --slope-limit, --check-walks, --trial-seconds, --tolerance and --seed "
        "are as given, all else is as in STUDY",
    )
    optimise.add_argument(
        "--searcher",
        choices=("cma-es", "nelder-mead", "pattern", "nsga2"),
        default="cma-es",
        metavar="NAME",
        help="cma-es, nelder-mead, pattern or nsga2 (default: %(default)s)",
    )
    optimise.add_argument(
        "--objective",
        type=typed(_assignment, "NAME or NAME=WEIGHT"),
        nargs="+",
        default=[("mfpt", 1.0)],
        metavar="NAME=W",
        help="mfpt (in decades), cot (less is better), speed (m/s), with weights of 1 unless "
        "given; nsga2 takes several for a front, the others add them up (default: mfpt)",
    )
    optimise.add_argument(
        "--limit",
        type=typed(_assignment, "NAME=VALUE"),
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
        type=number,
        default=1.0,
        metavar="DEG",
        help="degrees, standard deviation of the slope (default: %(default)g)",
    )
    optimise.add_argument(
        "--mesh",
        type=typed(_mesh_stage, "D_S:D_THR, D_S:D_THR:MARGIN or D_S:D_THR:MARGIN:MAX_STATES"),
        nargs="+",
        metavar="D_S:D_THR:MARGIN:N",
        help="meshes, coarse to fine: degrees between slopes, threshold, decades of MFPT below the "
        "best at which a candidate still gets this mesh (negative: above it), most states "
        "(default: 0.5:0.3 0.5:0.1:1 0.25:0.03:-0.02)",
    )
    optimise.add_argument(
        "--slope-limit",
        type=number,
        default=20.0,
        metavar="DEG",
        help="degrees, steepest slope of the sets (default: 20)",
    )
    optimise.add_argument(
        "--check-walks",
        type=whole,
        default=100,
        metavar="N",
        help="Monte Carlo walks that have to agree with the last mesh; 0: no such check "
        "(default: %(default)s)",
    )
    optimise.add_argument(
        "--step",
        type=number,
        default=1.0,
        metavar="X",
        help="first steps of the search, as a multiple of the usual ones (default: 1)",
    )
    optimise.add_argument(
        "--population",
        type=whole,
        default=0,
        metavar="N",
        help="candidates in a generation (default: the searcher's own)",
    )
    optimise.add_argument(
        "--runs",
        type=whole,
        default=0,
        metavar="N",
        help="runs of cma-es from the same start, each with random numbers of its own; they take "
        "turns, and the worse half ends again and again (default: 4; 1 is better for short "
        "searches, see docs/optimise.md)",
    )
    optimise.add_argument(
        "--trials",
        type=whole,
        metavar="N",
        help="stop when the study has N trials (default: when it is stopped)",
    )
    optimise.add_argument(
        "--seconds", type=number, metavar="S", help="s, begin no trial after that"
    )
    optimise.add_argument(
        "--trial-seconds",
        type=number,
        default=600.0,
        metavar="S",
        help="s, after which a trial is given up (default: %(default)g)",
    )
    optimise.add_argument(
        "--seed", type=whole, default=1, metavar="N", help="of the search (default: 1)"
    )
    optimise.add_argument(
        "--workers",
        type=whole,
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


def add_study(add: Add) -> None:
    """Add `study`."""
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
  biped-mfpt study show hzd-mfpt-cma-es-1-1 --top 20
  biped-mfpt study export hzd-mfpt-cma-es-1-1 --output best.json
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
        "--trial", type=whole, metavar="N", help="export this trial instead of the best"
    )
    study.add_argument(
        "--top", type=whole, default=10, metavar="N", help="trials to show (default: %(default)s)"
    )
