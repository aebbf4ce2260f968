"""Two hosts, made of network namespaces on this machine, and a link between them that is cut.

All traffic stays within the two namespaces. Run as a program, this file is what asks for meshes
on the first host.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

A, B = (f"biped_{os.getpid()}_{name}" for name in "ab")
LINK = "veth0"
REMOTE = "import sys; from biped_mfpt_ros.nodes.{} import main; sys.exit(main())"


def ip(*words):
    return subprocess.run(["ip", *words], capture_output=True, text=True)


@contextmanager
def two_hosts():
    """Two network namespaces with a link; skipped where that is not allowed."""
    setup = [
        ("netns", "add", A),
        ("netns", "add", B),
        ("-n", A, "link", "add", LINK, "type", "veth", "peer", "name", LINK, "netns", B),
        *(("-n", host, "link", "set", device, "up") for host in (A, B) for device in ("lo", LINK)),
        ("-n", A, "addr", "add", "10.213.77.1/30", "dev", LINK),
        ("-n", B, "addr", "add", "10.213.77.2/30", "dev", LINK),
    ]
    try:
        for words in setup:
            try:
                done = ip(*words)
            except FileNotFoundError:
                pytest.skip("there is no ip (package iproute2)")
            if done.returncode:
                pytest.skip(f"network namespaces are not allowed here: {done.stderr.strip()}")
        yield
    finally:
        for host in (A, B):
            ip("netns", "del", host)


def start(host, code, *arguments, **environment):
    command = ["ip", "netns", "exec", host, sys.executable, "-c", code, *arguments]
    return subprocess.Popen(
        command, env={**os.environ, **environment}, stdout=subprocess.PIPE, text=True
    )


def test_mesh_is_the_same_although_the_link_between_two_hosts_is_cut(tmp_path):
    network = {"ROS_DOMAIN_ID": "7", "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
    at_home = {"ROS_DOMAIN_ID": "7", "ROS_AUTOMATIC_DISCOVERY_RANGE": ""}
    with two_hosts():
        nodes = [
            start(A, REMOTE.format("simulator"), **network),
            start(B, REMOTE.format("simulator"), **network),
            # With the default range, nobody on the other host is to see it.
            start(B, REMOTE.format("simulator"), **at_home),
            start(
                A, REMOTE.format("mesher"), "--ros-args", "-p", "chunk_seconds:=0.001",
                "-p", "simulator_timeout:=0.3", "-p", "progress_period:=0.05",
                "-p", "simulator_wait_seconds:=600.0", **network,
            ),
        ]  # fmt: skip
        try:
            command = ["ip", "netns", "exec", A, sys.executable, __file__]
            asked = subprocess.run(
                command,
                env={**os.environ, **network, "PYTHONPATH": str(Path(__file__).parents[1])},
                stdout=subprocess.PIPE,
                text=True,
                timeout=1200.0,
            )
        finally:
            for node in nodes:
                node.terminate()
            for node in nodes:
                node.communicate(timeout=120.0)
    assert asked.returncode == 0
    result = json.loads(asked.stdout)
    assert result["simulators_seen"] == 2
    assert result["identical"] == result["meshes"] > 0
    # The link was cut while the other host was at work, and it was at work again afterwards.
    assert result["cut_during"] > 0
    assert result["chunks_repeated"] > 0
    assert result["back"]


def ask():
    """On host A: grow meshes, cut the link meanwhile, and restore it, until that was seen."""
    import rclpy
    from action_msgs.msg import GoalStatus
    from ros_graph import Client, Graph, wait_for
    from test_processes import assert_same_mesh, grown_here, settings

    rclpy.init()
    graph = Graph()
    client = graph.start(Client)
    wait_for(lambda: len(client.simulators()) >= 2, "simulators on both hosts")
    client.wait_for_mesher()
    time.sleep(1.0)  # for one that should not be found to be found
    seen = len(client.simulators())
    wanted = settings("hzd/mfpt", 0.003)
    here = grown_here(wanted)
    result = {"simulators_seen": seen, "meshes": 0, "identical": 0, "cut_during": 0}
    result |= {"chunks_repeated": 0, "back": False}
    history = []
    for _ in range(10):
        counts = []
        cut = threading.Event()

        def feedback(progress, counts=counts, cut=cut):
            counts.append(progress.simulators)
            if progress.simulators == 2 and progress.states > 50 and not cut.is_set():
                cut.set()
                ip("link", "set", LINK, "down")
                threading.Timer(1.0, ip, ("link", "set", LINK, "up")).start()

        handle = client.send_goal(wanted, feedback)
        status, grown = client.outcome(handle)
        assert status == GoalStatus.STATUS_SUCCEEDED, grown.message
        assert_same_mesh(client.mesh(grown.mesh_id), here)
        result["meshes"] += 1
        result["identical"] += 1
        result["cut_during"] += cut.is_set()
        result["chunks_repeated"] += grown.chunks_repeated
        history += counts
        result["back"] = 1 in history and 2 in history[history.index(1) :]
        time.sleep(1.5)
        if result["chunks_repeated"] and result["back"]:
            break
    graph.close()
    rclpy.shutdown()
    print(json.dumps(result))


if __name__ == "__main__":
    ask()
