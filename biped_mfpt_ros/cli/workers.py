"""Worker processes for jobs that Python's lock would keep from running side by side."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

from biped_mfpt_ros.cli import CommandError
from biped_mfpt_ros.cli.node import end_with


@contextmanager
def workers(number: int) -> Iterator[ProcessPoolExecutor]:
    """Processes to submit jobs to; they end with the block, and with this process.

    Parameters
    ----------
    number : int
        How many processes, >= 1. They start with the first job.

    Raises
    ------
    CommandError
        If one of them is killed.
    """
    # Fresh processes: threads of this one, such as those of ROS, do not survive a fork.
    pool = ProcessPoolExecutor(
        number,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin,
        initargs=(os.getpid(),),
    )
    try:
        yield pool
    except BaseException as error:
        for child in multiprocessing.active_children():
            child.terminate()
        if isinstance(error, BrokenProcessPool):
            raise CommandError(f"a worker process was killed: {error}") from error
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _begin(parent: int) -> None:
    """Leave Ctrl-C to the parent, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with(parent)
