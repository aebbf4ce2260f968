"""Worker processes: they end with their block, and with their parent however that ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest
from ros_graph import PATIENCE

from biped_mfpt_ros.cli import CommandError
from biped_mfpt_ros.cli.workers import workers

# A worker that takes longer than any test, in a process that says who its workers are.
PARENT = """
import os, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # it may have been ignored, and inherited
from biped_mfpt_ros.cli.workers import workers
with workers(2) as pool:
    pids = {f.result() for f in [pool.submit(os.getpid)] * 2}
    job = pool.submit(time.sleep, 3600)
    # Not before: where Python runs a callback, it drops a KeyboardInterrupt.
    print(*pids, flush=True)
    job.result()
"""


def alive(pid):
    """Whether a process is there and not a zombie."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_until_gone(pids):
    deadline = time.monotonic() + PATIENCE
    while any(map(alive, pids)):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_jobs_are_done_elsewhere():
    with workers(2) as pool:
        pids = {pool.submit(os.getpid).result() for _ in range(4)}
        assert os.getpid() not in pids
        with pytest.raises(ZeroDivisionError):
            pool.submit(divmod, 1, 0).result()
    wait_until_gone(pids)


def test_a_killed_worker_is_an_error():
    def kill_itself():
        with workers(1) as pool:
            pool.submit(os.kill, pool.submit(os.getpid).result(), signal.SIGKILL).result()

    with pytest.raises(CommandError, match="killed"):
        kill_itself()


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_their_parent(how):
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    pids = [int(pid) for pid in parent.stdout.readline().split()]
    assert pids
    assert all(map(alive, pids))
    parent.send_signal(how)
    parent.wait(PATIENCE)  # its job takes longer
    wait_until_gone(pids)
    parent.stdout.close()
