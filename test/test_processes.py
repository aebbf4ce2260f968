"""The nodes as processes: the same mesh from any number of simulators, faults, clean stops."""

import os
import signal
import subprocess
import sys
import time

import pytest
from action_msgs.msg import GoalStatus
from biped_mfpt_msgs.msg import MfptEstimate
from ros_graph import DOMAIN, PATIENCE, Client, ros_graph, wait_for

from biped_mfpt_ros import cli
from biped_mfpt_ros.chain.mesh import grow_mesh
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.step import simulate_steps
from biped_mfpt_ros.nodes.messages import MeshSettings
from biped_mfpt_ros.nodes.qos import RESULTS
from biped_mfpt_ros.walker.robot import WalkerModel
from biped_mfpt_ros.walker.terrain import slope_set


@pytest.fixture(scope="module")
def graph():
    with ros_graph() as graph:
        yield graph


@pytest.fixture(scope="module")
def client(graph):
    return graph.start(Client)


def settings(name, threshold):
    return MeshSettings(controller(name), WalkerModel(), slope_set(0.5), threshold)


def grown_here(settings):
    return grow_mesh(
        lambda states, previous: simulate_steps(
            settings.controller, states, previous, settings.slopes, settings.model
        ),
        find_limit_cycle(settings.controller).state,
        settings.slopes,
        settings.threshold,
    )


def assert_same_mesh(a, b):
    for name in ("states", "preceding", "generation", "targets", "outcomes", "scales"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name


def stop(process, number):
    """Exit code and what was written to stderr, after a signal."""
    process.send_signal(number)
    try:
        _, written = process.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        pytest.fail(f"still running {PATIENCE} s after signal {number}: {process.communicate()[1]}")
    return process.returncode, written


def simulators(graph, client, count):
    """Start simulators until there are so many; all processes that have been started."""
    before = len(client.simulators())
    started = [graph.launch("simulator") for _ in range(count - before)]
    wait_for(lambda: len(client.simulators()) == count, f"{count} simulators")
    return started


# Small chunks, so that small meshes keep several simulators busy.
MESHER = ("--ros-args", "-p", "chunk_seconds:=0.001", "-p", "simulator_timeout:=0.3",
          "-p", "progress_period:=0.05", "-p", f"simulator_wait_seconds:={PATIENCE}")  # fmt: skip


def test_pipeline_of_processes(graph, client):
    """One story, since starting processes takes seconds."""
    estimates = []
    client.create_subscription(MfptEstimate, "mfpt", estimates.append, RESULTS)
    others = [
        graph.launch("mesher", *MESHER),
        graph.launch("analysis", "--ros-args", "-p", "sigma_s_deg:=[1]"),
    ]
    client.wait_for_mesher()
    base = settings("hzd/base", 0.3)
    here = grown_here(base)
    started = []
    published = []
    for count in (1, 2, 4):
        started += simulators(graph, client, count)
        seen = []

        # The mesher looks for simulators on its own; a mesh may begin before it has found all.
        def grown_by_all(count=count, seen=seen):
            seen.clear()
            status, result = client.grow(base, seen.append)
            assert status == GoalStatus.STATUS_SUCCEEDED, result.message
            published.append(result.mesh_id)
            assert_same_mesh(client.mesh(result.mesh_id), here)
            return seen and seen[-1].simulators == count

        wait_for(grown_by_all, f"a mesh grown by {count} simulators")
    wait_for(lambda: len(estimates) == len(published), "an estimate for every mesh")
    # An analysis that starts late gets what was published meanwhile in any order.
    assert sorted(estimate.mesh_id for estimate in estimates) == sorted(published)
    assert len({estimate.mfpt for estimate in estimates}) == 1

    # A simulator that is stopped takes requests and does not answer; then it is killed.
    finer = settings("hzd/base", 0.03)
    victim, woken, *_ = started
    victim.send_signal(signal.SIGSTOP)
    woken.send_signal(signal.SIGSTOP)
    seen = []
    handle = client.send_goal(finer, seen.append)
    wait_for(lambda: seen and seen[-1].chunks_repeated, "chunks to be handed on")
    victim.kill()
    woken.send_signal(signal.SIGCONT)
    status, result = client.outcome(handle)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert result.chunks_repeated > 0
    assert result.swings == result.states - 1
    assert_same_mesh(client.mesh(result.mesh_id), grown_here(finer))

    # A mesh that is being grown does not keep anyone from stopping cleanly.
    seen = []
    handle = client.send_goal(settings("hzd/mfpt", 1e-5), seen.append)
    wait_for(lambda: seen and seen[-1].swings > 100, "the mesh to grow")
    running = [*others, *(process for process in started if process is not victim)]
    for number, process in zip((signal.SIGTERM, signal.SIGINT) * 3, running, strict=False):
        code, written = stop(process, number)
        assert code == 0, written
        assert "Traceback" not in written


def test_nodes_that_cannot_start_say_why(graph, tmp_path):
    """Bad parameters and files of them, and security that is asked for where there is none."""
    files = {"garbage": "a: [1, 2\n b: {", "nan": "/**: {ros__parameters: {max_states: .nan}}"}
    for name, text in files.items():
        (tmp_path / name).write_text(text)

    def with_file(name):
        return graph.launch("simulator", "--ros-args", "--params-file", str(tmp_path / name))

    cases = [
        (graph.launch("simulator", "--ros-args", "-p", "max_states:=0"), "max_states: 0 is not"),
        (graph.launch("analysis", "--ros-args", "-p", "sigma_s_deg:=[0.0]"), "sigma_s_deg[0]: 0.0"),
        (with_file("garbage"), "--params-file: "),
        (with_file("nan"), "max_states: nan is not"),
        (with_file("missing"), "--params-file: "),
        (graph.launch("simulator", "--ros-args", "-r", "x"), "--ros-args: "),
        (graph.launch("mesher", ROS_SECURITY_ENABLE="true"), "ROS_SECURITY_STRATEGY: 'Permissive'"),
        (
            graph.launch("mesher", ROS_SECURITY_ENABLE="true", ROS_SECURITY_STRATEGY="Enforce"),
            "ROS_SECURITY_ENABLE: 'true' is not allowed",
        ),
    ]
    for process, said in cases:
        _, written = process.communicate(timeout=PATIENCE)
        assert process.returncode == 2
        assert said in written
        assert "; allowed: " in written
        assert "Traceback" not in written


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_the_start_stops_cleanly(graph, client, number):
    process = graph.launch("simulator")
    # The node is on the graph before its kernels are loaded, or compiled.
    name = f"_{process.pid}"
    wait_for(lambda: any(node.endswith(name) for node in client.get_node_names()), "the node")
    code, written = stop(process, number)
    assert code == 0, written


def test_a_process_ends_in_time_whatever_holds_the_interpreter():
    # The search holds the interpreter's lock, and would take years.
    code = (
        "import re; from biped_mfpt_ros.nodes.spin import end_within; end_within(1); "
        "re.match('(a+)+b', 'a' * 60)"
    )
    start = time.monotonic()
    ended = subprocess.run([sys.executable, "-c", code], timeout=PATIENCE, check=False)
    assert ended.returncode == 0
    assert time.monotonic() - start > 1.0


@pytest.mark.parametrize(
    ("ending", "code"),
    [
        ("return 0", 0),
        ("raise cli.CommandError('in vain')", cli.EXIT_FAILED),
        ("raise KeyboardInterrupt", cli.EXIT_STOPPED),
    ],
)
def test_a_command_ends_as_it_should_although_leaving_the_graph_takes_for_ever(ending, code):
    program = f"""
import re, sys
from rclpy.node import Node
from biped_mfpt_ros import cli
from biped_mfpt_ros.cli import single
from biped_mfpt_ros.cli.client import Client
from biped_mfpt_ros.nodes import spin

def command(args):
    with Client("/alone", lambda: None):
        pass
    print("all of it")
    {ending}

single.cycle = command
spin.LAST_SECONDS = 1  # it is waited for
Node.destroy_node = lambda self: re.match("(a+)+b", "a" * 60)
sys.exit(cli.main(["cycle"]))
"""
    ended = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "ROS_DOMAIN_ID": str(DOMAIN), "PYTHONUNBUFFERED": ""},
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert ended.returncode == code, ended.stderr
    assert ended.stdout == "all of it\n"
    assert ("in vain" in ended.stderr) == (code == cli.EXIT_FAILED)


@pytest.mark.slow
def test_compile_leaves_nothing_to_be_compiled(tmp_path):
    def run(*arguments):
        command = [sys.executable, "-m", "biped_mfpt_ros.cli", *arguments, "--quiet"]
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
        subprocess.run(command, env=environment, check=True, timeout=300)
        return {file.name for file in tmp_path.rglob("*.nbc")}

    compiled = run("compile")
    assert compiled
    chain = ("mfpt", "--sigma", "1", "2", "--slope-step", "1", "--threshold", "1")
    assert run(*chain, "--scale-refresh", "addition") == compiled
    assert run("monte-carlo", "--sigma", "2", "--walks", "10") == compiled
