"""The command line, `biped-mfpt`."""

from __future__ import annotations

import argparse
import atexit
import importlib
import os
import signal
import sys
from collections.abc import Callable, Sequence

from biped_mfpt_ros.cli.parser import make_parser
from biped_mfpt_ros.errors import InputError

_OWN = __name__.partition(".")[0] + "."

leaving: list[Callable[[], object]] = []
"""What leaves the ROS graph, when a command has said and written all that it had to: the middleware
may lock up the process then, for good."""

EXIT_FAILED, EXIT_BAD_INPUT, EXIT_STOPPED = 1, 2, 130


class CommandError(Exception):
    """A command could not do what it was asked to; the message says why."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Parameters
    ----------
    arguments : sequence of str, optional
        Without the program's name; those of this process by default.

    Returns
    -------
    int
        Exit code: 0 done, 1 could not be done, 2 bad input, 130 stopped by SIGINT or SIGTERM.
    """
    code = _main(arguments)
    leave_graph(code)
    return code


def leave_graph(code: int) -> None:
    """Leave the ROS graph, if this process is on it; or, within 3 s, the process with this code."""
    if not leaving:
        return
    from biped_mfpt_ros.nodes.spin import LAST_SECONDS, end_within

    sys.stdout.flush()  # what is left in there would be lost
    call_off = end_within(LAST_SECONDS, code)
    try:
        while leaving:
            leaving.pop()()
    finally:
        call_off()


def _main(arguments: Sequence[str] | None) -> int:
    try:
        args = make_parser().parse_args(arguments)
    except SystemExit as end:  # --help, --version, or bad input that has been reported
        return int(end.code or 0)
    stopped = False

    def stop(number: int, frame: object) -> None:
        nonlocal stopped
        if stopped:  # threads that compute are waited for, unless one insists
            os._exit(EXIT_STOPPED)
        stopped = True
        raise KeyboardInterrupt

    # A stop by SIGTERM is to be as orderly as one by Ctrl-C.
    handlers = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        return _run(args)
    except KeyboardInterrupt:
        return EXIT_STOPPED
    except BrokenPipeError:
        # The reader of stdout is gone, as with `| head`. Python would notice it again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_FAILED
    except Exception:
        # A callback from C code swallows KeyboardInterrupt; what it came from then fails.
        if stopped:
            return EXIT_STOPPED
        raise
    finally:
        for number, handler in handlers.items():
            if stopped:  # the process ends, and may be told to once more, to the last moment
                atexit.register(signal.signal, number, signal.SIG_IGN)
            else:
                signal.signal(number, handler)


def _run(args: argparse.Namespace) -> int:
    """Import the function of a command and call it; report the errors that are meant for users."""
    module, name = args.function.split(":")
    try:
        code = getattr(importlib.import_module(module), name)(args)
        sys.stdout.flush()
        return code or 0
    except BrokenPipeError:
        raise
    except InputError as error:
        problem = str(error).removeprefix(error.field)
        option = option_of(error.field, vars(args))
        print(f"{args.parser.prog}: error: {option}{problem}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except Exception as error:
        # Errors of our own classes, and those of files, say what is wrong. Any other is a bug.
        if not isinstance(error, OSError) and not type(error).__module__.startswith(_OWN):
            raise
        print(f"{args.parser.prog}: {error}", file=sys.stderr)
        return EXIT_FAILED


# Fields of the core that are not called as the options that set them.
_OPTIONS = {
    "bag": "BAG",
    "fixed": "--fix",
    "limits": "--limit",
    "mu_s": "--mean",
    "sigma_s": "--sigma",
    "mu_s_deg": "--mean",
    "objectives": "--objective",
    "sigma_s_deg": "--sigma",
    "states": "--state",
    "slope_step_deg": "--slope-step",
    "slope_limit_deg": "--slope-limit",
}


def option_of(field: str, options: dict[str, object]) -> str:
    """Name of the option that sets a field, or the field itself if there is none."""
    base = field.partition("[")[0]
    if base in _OPTIONS:
        return _OPTIONS[base]
    return "--" + base.replace("_", "-") if base in options else field
