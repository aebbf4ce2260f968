"""What every node's ``main`` does: start, spin, stop cleanly."""

from __future__ import annotations

import ctypes
import gc
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

import rclpy
from rclpy.context import Context
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.signals import (
    SignalHandlerOptions,
    install_signal_handlers,
    uninstall_signal_handlers,
)

from biped_mfpt_ros.errors import InputError

LAST_SECONDS = 3
"""s, for the middleware to end in."""

_BAD_ARGUMENTS = (_rclpy.RCLError, _rclpy.RCLInvalidROSArgsError, _rclpy.UnknownROSArgsError)

# M_MMAP_THRESHOLD, M_TRIM_THRESHOLD and M_TOP_PAD of malloc.h. The first is the most that glibc
# takes; the others bound what a heap keeps.
_MALLOC = ((-3, 32 << 20), (-1, 64 << 20), (-2, 4 << 20))


def prepare_environment() -> None:
    """Set what must be decided before rclpy starts: who is discovered, and who gets in.

    Discovery stays on this machine unless ROS_AUTOMATIC_DISCOVERY_RANGE says otherwise.

    Raises
    ------
    InputError
        If security is asked for in a way that would go on without it.
    """
    # Set to nothing it would be ROS 2's own default, which is the subnet.
    if not os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE"):
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    enabled = os.environ.get("ROS_SECURITY_ENABLE", "false").lower() == "true"
    strategy = os.environ.get("ROS_SECURITY_STRATEGY", "Permissive")
    # Permissive, the default, goes on unsecured without a word where the middleware has no
    # security or the keystore no enclave. Enforce fails then.
    if enabled and strategy != "Enforce":
        raise InputError(
            "ROS_SECURITY_STRATEGY", strategy, "Enforce, when ROS_SECURITY_ENABLE is true"
        )


def keep_freed_memory() -> None:
    """Have the C library keep memory that is freed, within bounds, for the next message.

    By default glibc gives each buffer of some 100 kB and more back to the kernel, and pays a page
    fault for every 4 kB of the next one. With several buffers to a message that is half of what
    a message of 1 MB costs (`docs/scale.md`). Another C library is left as it is.
    """
    allocator = getattr(ctypes.CDLL(None), "mallopt", None)
    if allocator is not None:
        for option, size in _MALLOC:
            allocator(option, size)


class _Event(ctypes.Structure):
    """``sigevent`` of signal.h, of 64 bytes."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signal", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("rest", ctypes.c_char * 40),
    )


def end_within(seconds: int, code: int = 0) -> Callable[[], object]:
    """End the process after a time, whatever it does then.

    Fast DDS can lock itself up while it leaves the graph, when others leave at the same moment:
    its participant waits, busily, for a callback that waits for the participant. It holds the
    interpreter's lock meanwhile, so no thread of Python can help, and no handler of a signal. A
    timer of the C library calls ``_exit`` from a thread of its own.

    Parameters
    ----------
    seconds : int
        s, from now.
    code : int, optional
        Exit code.

    Returns
    -------
    callable
        Calls it off.
    """
    library = ctypes.CDLL(None)
    try:
        create, start, delete = library.timer_create, library.timer_settime, library.timer_delete
    except AttributeError:
        return lambda: None
    sigev_thread, monotonic = 2, 1
    function = ctypes.cast(library._exit, ctypes.c_void_p)
    # The value is what the function is called with.
    event = _Event(value=code, notify=sigev_thread, function=function)
    timer = ctypes.c_void_p()
    if create(monotonic, ctypes.byref(event), ctypes.byref(timer)) != 0:
        return lambda: None
    # Interval and first expiry, each in s and ns.
    start(timer, 0, (ctypes.c_long * 4)(0, 0, seconds, 0), None)
    return lambda: delete(timer)


@contextmanager
def security_explained() -> Iterator[None]:
    """Start rclpy or a node inside this: InputError if security is asked for and not there."""
    try:
        yield
    except (InputError, KeyboardInterrupt):
        raise
    except Exception as error:
        if os.environ.get("ROS_SECURITY_ENABLE", "").lower() != "true":
            raise
        raise InputError(
            "ROS_SECURITY_ENABLE",
            "true",
            f"false, unless this ROS 2 has DDS security and the enclave exists ({error})",
        ) from error


def initialise(args: list[str] | None = None, context: Context | None = None) -> None:
    """Start rclpy without its signal handlers.

    Parameters
    ----------
    args : list of str, optional
        Arguments with ROS remappings and parameters; the command line by default.
    context : rclpy.context.Context, optional
        What to start; the default one by default.

    Raises
    ------
    InputError
        If the arguments, or a file of parameters that they name, cannot be read.
    """
    try:
        rclpy.init(args=args, context=context, signal_handler_options=SignalHandlerOptions.NO)
    except _BAD_ARGUMENTS as error:
        if os.environ.get("ROS_SECURITY_ENABLE", "").lower() == "true":
            raise  # `security_explained`
        # After what is wrong rcl tells the line of its own source that found it.
        problem = re.sub(r",?\s+at /\S+:\d+", "", str(error)).strip()
        found = re.search(r"'--params-file (.*?)'\. Error: (.*)", problem, re.DOTALL)
        if found is not None:
            file, problem = found.groups()
            raise InputError(
                "--params-file", file, f"a YAML file of parameters as ROS 2 reads it ({problem})"
            ) from error
        given = sys.argv[1:] if args is None else args
        raise InputError("--ros-args", given, f"what ROS 2 takes ({problem})") from error


class _Interrupt:
    """Signal handler that raises KeyboardInterrupt until it is told to hold."""

    def __init__(self) -> None:
        self.received = False
        self.hold = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal."""
        self.received = True
        if not self.hold:
            raise KeyboardInterrupt


def run_node(make: Callable[[], Node], args: list[str] | None = None) -> int:
    """Run one node until SIGINT, SIGTERM, or the end of its context.

    A node with a method ``close()`` has it called before it is destroyed, to end its threads.

    Parameters
    ----------
    make : callable
        Makes the node, after rclpy has started. It may take long.
    args : list of str, optional
        Arguments with ROS remappings and parameters; the command line by default.

    Returns
    -------
    int
        Exit code: 0 after a clean stop, 2 if the node could not start as configured.
    """
    # rclpy's own handlers wake a node that spins, and call these. Before, these alone are there.
    interrupt = _Interrupt()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupt)
    node: Node | None = None
    executor: SingleThreadedExecutor | None = None
    try:
        prepare_environment()
        keep_freed_memory()
        with security_explained():
            initialise(args)
            node = make()
        executor = SingleThreadedExecutor()
        install_signal_handlers(SignalHandlerOptions.ALL)
        # What is raised inside a callback of the compiler is swallowed there.
        if not interrupt.received:
            _spin(node, executor)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (InputError, ParameterException) as error:
        print(f"{sys.argv[0]}: {error}", file=sys.stderr)
        return 2
    finally:
        interrupt.hold = True  # cleaning up is not to be cut off
        # A thread of rclpy tells of the signal, to the executor among others, and may be slower
        # than what it woke: this waits for its end. Only then may anything be destroyed.
        uninstall_signal_handlers()
        if node is not None:
            close = getattr(node, "close", None)
            if close is not None:
                close()
            end_within(LAST_SECONDS)
        if executor is not None:
            executor.shutdown()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        # Else the interpreter looks through all of numba's objects once more before it ends.
        gc.freeze()
    return 0


def _spin(node: Node, executor: SingleThreadedExecutor) -> None:
    """Spin until the context ends. What goes wrong with one caller must not end the node."""
    executor.add_node(node)
    while node.context.ok():
        try:
            executor.spin()
        except (KeyboardInterrupt, ExternalShutdownException):
            raise
        except Exception:
            if not node.context.ok():
                return  # a callback that ran into the shutdown
            # A client that has gone before its answer, a message that cannot be converted.
            node.get_logger().error(f"a callback failed; going on\n{traceback.format_exc()}")
