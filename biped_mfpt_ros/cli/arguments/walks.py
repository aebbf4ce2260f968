"""Arguments of `monte-carlo`, `cycle`, `step`, `picture` and `controllers`."""

from __future__ import annotations

from biped_mfpt_ros.cli.arguments.shared import Add, number, typed, whole

PICTURES = ("gait", "animation", "phase", "torques", "mesh", "distribution", "falls")


def _state(text: str) -> list[float]:
    values = [float(part) for part in text.split(",")]
    if len(values) != 10:
        raise ValueError
    return values


def add_monte_carlo(add: Add) -> None:
    """Add `monte-carlo`."""
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
  biped-mfpt monte-carlo --controller hzd/cot --sigma 2 --correlation -0.5
  biped-mfpt monte-carlo --controller hzd/base --sigma 2 --torque-limit none --json
""",
        "walker",
        "terrain",
        "output",
    )
    monte_carlo.add_argument(
        "--sigma",
        type=number,
        required=True,
        metavar="DEG",
        help="degrees, standard deviation of the slope",
    )
    monte_carlo.add_argument(
        "--walks", type=whole, default=10_000, metavar="N", help="(default: %(default)s)"
    )
    monte_carlo.add_argument(
        "--seed", type=whole, default=1, metavar="N", help="of all walks (default: %(default)s)"
    )
    monte_carlo.add_argument(
        "--max-steps",
        type=whole,
        default=10_000,
        metavar="N",
        help="stop a walk that has not fallen after N steps (default: %(default)s)",
    )


def add_cycle(add: Add) -> None:
    """Add `cycle`."""
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
        type=number,
        default=0.0,
        metavar="DEG",
        help="degrees, constant slope, negative is downhill (default: 0)",
    )


def add_step(add: Add) -> None:
    """Add `step`."""
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
        type=typed(_state, "ten numbers q1,..,q5,dq1,..,dq5 in rad and rad/s"),
        required=True,
        metavar="Q1,..,DQ5",
        help="rad and rad/s, just after impact",
    )
    step.add_argument(
        "--previous-slope",
        type=number,
        default=0.0,
        metavar="DEG",
        help="degrees, ground behind the stance foot (default: 0)",
    )
    step.add_argument(
        "--slope",
        type=number,
        default=0.0,
        metavar="DEG",
        help="degrees, ground ahead, negative is downhill (default: 0)",
    )


def add_picture(add: Add) -> None:
    """Add `picture`."""
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
        type=number,
        default=2.0,
        metavar="DEG",
        help="degrees, standard deviation of the slope (default: %(default)g)",
    )
    picture.add_argument(
        "--seed", type=whole, default=1, metavar="N", help="of all walks (default: %(default)s)"
    )
    picture.add_argument(
        "--number", type=whole, default=0, metavar="N", help="of the walk (default: %(default)s)"
    )
    picture.add_argument(
        "--last-steps",
        type=whole,
        default=8,
        metavar="N",
        help="how much of the walk to draw (default: %(default)s)",
    )


def add_controllers(add: Add) -> None:
    """Add `controllers`."""
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
