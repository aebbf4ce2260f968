"""`biped-mfpt node`: one node of the pipeline in this process."""

from __future__ import annotations

import argparse
import ctypes
import importlib
import os
import signal
import sys

from biped_mfpt_ros.cli import CommandError
from biped_mfpt_ros.errors import InputError

ROS_MISSING = (
    "this command needs ROS 2 and the package biped_mfpt_msgs, and {module!r} cannot be imported. "
    "In the source tree `make setup` installs both into .venv, then use .venv/bin/biped-mfpt; "
    "with a ROS 2 of your own: colcon build --base-paths . msg_defs, then source "
    "install/setup.bash. The commands step, cycle, mesh, mfpt and monte-carlo need no ROS"
)


def node(args: argparse.Namespace) -> int:
    """Run a node's main function with the arguments that follow its name."""
    if args.end_with is not None:
        end_with(args.end_with)
    first = args.arguments[0] if args.arguments else "--ros-args"
    if first in ("-h", "--help"):
        args.parser.print_help()
        return 0
    if first != "--ros-args":
        raise InputError("argument", first, "--ros-args, and what ROS takes after that")
    require_ros()
    main = importlib.import_module(f"biped_mfpt_ros.nodes.{args.name}").main
    sys.argv = [args.name, *args.arguments]
    return main() or 0


def require_ros(*modules: str) -> None:
    """Raise CommandError, with the way to set them up, if rclpy or the messages are missing.

    Parameters
    ----------
    *modules : str
        The modules that are needed, if not both.
    """
    for module in modules or ("rclpy", "biped_mfpt_msgs.msg"):
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise CommandError(ROS_MISSING.format(module=error.name or module)) from error


def end_with(parent: int) -> None:
    """Have the kernel send SIGTERM to this process when its parent ends, however that ends.

    Parameters
    ----------
    parent : int
        Process id that the parent had when it started this process.
    """
    if sys.platform == "linux":
        set_parent_death_signal = 1  # PR_SET_PDEATHSIG of <linux/prctl.h>
        ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGTERM)
    if os.getppid() != parent:  # it ended before that
        sys.exit(1)
