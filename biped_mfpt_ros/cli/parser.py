"""The parser of `biped-mfpt`. Imports nothing but argparse: `--help` has to be quick.

Each subcommand names the function that does it as ``"module:function"``, which `main` imports when
it is wanted.
"""

from __future__ import annotations

import argparse

from biped_mfpt_ros import __version__
from biped_mfpt_ros.cli.arguments import meshes, optimise, paper, walks
from biped_mfpt_ros.cli.arguments.shared import Parser, shared_options

CLI = "biped_mfpt_ros.cli"
NODES = ("simulator", "mesher", "analysis", "recorder", "optimiser")

_DESCRIPTION = """\
How many steps does a walking robot take on rough ground before it falls?

biped-mfpt walks a five-link biped, RABBIT or your own, on slopes drawn from a normal distribution,
meshes the states that it can reach, makes a Markov chain of them and computes the mean
first-passage time (MFPT) to a fall, in steps.
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


def make_parser() -> Parser:
    """The parser of `biped-mfpt` with all its subcommands."""
    parser = Parser(prog="biped-mfpt", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument("--version", action="version", version=f"biped-mfpt {__version__}")
    commands = parser.add_subparsers(
        title="commands", metavar="COMMAND", dest="command", required=True, parser_class=Parser
    )
    shared = shared_options()

    def add(name: str, function: str, summary: str, details: str, *groups: str) -> Parser:
        description, _, examples = details.strip().partition("\nexamples:\n")
        command = commands.add_parser(
            name,
            help=summary,
            description=f"{summary[0].upper()}{summary[1:]}.\n\n{description}",
            epilog=f"examples:\n{examples}" if examples else None,
            parents=[shared[group] for group in groups],
        )
        command.set_defaults(function=f"{CLI}.{function}", parser=command)
        return command

    meshes.add_run(add)
    meshes.add_mfpt(add)
    meshes.add_mesh(add)
    walks.add_monte_carlo(add)
    walks.add_cycle(add)
    walks.add_step(add)
    paper.add_reproduce(add)
    paper.add_calibrate(add)
    optimise.add_optimise(add)
    optimise.add_study(add)
    walks.add_picture(add)
    meshes.add_inspect(add)
    walks.add_controllers(add)

    node = commands.add_parser(
        "node",
        help="start one node of the pipeline",
        description="Start one node of the pipeline, like `ros2 run biped_mfpt_ros NAME`, where "
        "there is no ros2\ncommand. What follows NAME goes to the node.",
        epilog="examples:\n"
        "  biped-mfpt node simulator\n"
        "  biped-mfpt node mesher --ros-args -r __ns:=/rough --log-level debug",
    )
    node.set_defaults(function=f"{CLI}.node:node", parser=node)
    node.add_argument(
        "--end-with", type=int, metavar="PID", help=argparse.SUPPRESS
    )  # of a parent that may be killed
    node.add_argument("name", choices=NODES, metavar="NAME", help=", ".join(NODES))
    rest = node.add_argument("arguments", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    rest.required = False  # is no part of the error when NAME is missing

    add(
        "compile",
        "kernels:compile_kernels",
        "compile the numeric kernels, so that nothing has to wait for that later",
        "Done once for a version of the sources; after that it takes a second and changes nothing.",
        "output",
    )
    return parser
