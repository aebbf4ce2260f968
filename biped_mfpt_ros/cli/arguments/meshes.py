"""Arguments of `run`, `mfpt`, `mesh` and `inspect`."""

from __future__ import annotations

from biped_mfpt_ros.cli.arguments.shared import Add, number, whole


def add_run(add: Add) -> None:
    """Add `run`."""
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
        type=number,
        nargs="+",
        default=[1.0, 2.0],
        metavar="DEG",
        help="degrees, standard deviations of the slope (default: 1 2)",
    )
    run.add_argument(
        "--walks",
        type=whole,
        default=2000,
        metavar="N",
        help="Monte Carlo walks for each sigma at which the robot falls soon; 0: none "
        "(default: %(default)s)",
    )
    run.add_argument("--seed", type=whole, default=1, metavar="N", help="of the walks (default: 1)")
    run.add_argument(
        "--workers",
        type=whole,
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


def add_mfpt(add: Add) -> None:
    """Add `mfpt`."""
    mfpt = add(
        "mfpt",
        "meshes:mfpt",
        "mesh a controller and compute its mean first-passage time to a fall",
        """
The mesh does not depend on the distribution of the slopes, so that any number of standard
deviations costs one mesh. In this process, without ROS.

A coarse mesh errs: make --threshold and --slope-step smaller until the number settles, and compare
with `biped-mfpt monte-carlo` where the robot falls soon enough.

examples:
  biped-mfpt mfpt --controller hzd/mfpt --sigma 1 2 --slope-step 0.5 --threshold 0.3
  biped-mfpt mfpt --controller hzd/cot --sigma 0.5 1 1.5 2 --mean -1 --json
  biped-mfpt mfpt --controller hzd/mfpt --sigma 1 2 --correlation 0.8
""",
        "walker",
        "mesh",
        "terrain",
        "output",
    )
    mfpt.add_argument(
        "--sigma",
        type=number,
        nargs="+",
        required=True,
        metavar="DEG",
        help="degrees, standard deviations of the slope",
    )


def add_mesh(add: Add) -> None:
    """Add `mesh`."""
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


def add_inspect(add: Add) -> None:
    """Add `inspect`."""
    inspect = add(
        "inspect",
        "bags:inspect",
        "read a recorded bag, rebuild its meshes and compute their MFPT again",
        """
The bag alone holds all that is needed: nothing is simulated, and the numbers equal those of the
run bit for bit.

examples:
  biped-mfpt inspect runs/20250131-120000-hzd-mfpt
  biped-mfpt inspect runs/20250131-120000-hzd-mfpt --sigma 0.5 1 1.5 2 --mean -1 --json
  biped-mfpt inspect runs/20250131-120000-hzd-mfpt --repair saved
""",
        "output",
    )
    inspect.add_argument("bag", metavar="BAG", help="directory of a run or a bag, or an .mcap file")
    inspect.add_argument(
        "--sigma",
        type=number,
        nargs="+",
        metavar="DEG",
        help="degrees, standard deviations of the slope (default: those that were published)",
    )
    inspect.add_argument(
        "--mean",
        type=number,
        metavar="DEG",
        help="degrees, mean slope to go with --sigma (default: 0)",
    )
    inspect.add_argument(
        "--correlation",
        type=number,
        metavar="R",
        help="of each slope with the one before, to go with --sigma (default: 0)",
    )
    inspect.add_argument(
        "--repair",
        metavar="NEW",
        help="first copy what can be read of a bag that was cut off to this new directory, as a "
        "whole bag, and read that; BAG stays as it is",
    )
