"""Who gets in: policies name what the nodes have; no start without the security asked for."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
from rclpy.action import (
    get_action_client_names_and_types_by_node,
    get_action_server_names_and_types_by_node,
)
from rclpy.parameter import Parameter
from ros_graph import DOMAIN, ros_graph, wait_for
from test_package import NODES

from biped_mfpt_ros.cli import optimise_pipeline
from biped_mfpt_ros.nodes import recorder
from biped_mfpt_ros.nodes.analysis import Analysis
from biped_mfpt_ros.nodes.mesher import Mesher
from biped_mfpt_ros.nodes.optimiser import Optimiser
from biped_mfpt_ros.nodes.recorder import Recorder
from biped_mfpt_ros.nodes.simulator import Simulator
from biped_mfpt_ros.nodes.spin import prepare_environment

POLICIES = Path(__file__).parents[1] / "docs" / "security"
KINDS = ("publish", "subscribe", "reply", "request", "execute", "call")


def allowed(name):
    """Absolute names by kind, as SROS2 reads the policy of an enclave."""
    root = ElementTree.parse(POLICIES / f"{name}.policy.xml").getroot()
    assert (root.tag, root.attrib) == ("policy", {"version": "0.2.0"})
    (enclave,) = root.findall("enclaves/enclave")
    assert enclave.get("path") == f"/biped/{name}"
    (profile,) = enclave.findall("profiles/profile")
    found = {kind: set() for kind in KINDS}
    for rule in profile:
        ((kind, value),) = rule.attrib.items()
        assert value == "ALLOW"
        assert rule.tag == {"p": "topics", "s": "topics", "r": "services"}.get(kind[0], "actions")
        for item in rule:
            assert item.tag == rule.tag[:-1]
            text = item.text
            if text.startswith("~"):
                text = f"{profile.get('node')}{text[1:]}"
            found[kind].add(text if text.startswith("/") else profile.get("ns") + text)
    return found


def had(node, name):
    """Absolute names by kind that a node on the graph has."""

    def names(pairs):
        return {name for name, _ in pairs}

    def without_actions(names):
        return {name for name in names if "/_action/" not in name}

    key = (name, "/")
    found = {
        "publish": node.get_publisher_names_and_types_by_node(*key),
        "subscribe": node.get_subscriber_names_and_types_by_node(*key),
        "reply": node.get_service_names_and_types_by_node(*key),
        "request": node.get_client_names_and_types_by_node(*key),
        "execute": get_action_server_names_and_types_by_node(node, *key),
        "call": get_action_client_names_and_types_by_node(node, *key),
    }
    return {kind: without_actions(names(pairs)) for kind, pairs in found.items()}


def test_policies_allow_what_the_nodes_have_and_nothing_else(tmp_path):
    assert {path.name for path in POLICIES.iterdir()} == {
        f"{name}.policy.xml" for name in (*NODES, "run")
    }
    with ros_graph() as graph:
        simulator = graph.start(Simulator)
        mesher = graph.start(Mesher)
        graph.start(Analysis)
        graph.start(Optimiser)
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("ROS_DOMAIN_ID", str(DOMAIN))
            bag = Parameter("bag", value=str(tmp_path / "bag"))
            node = graph.start(lambda: Recorder(parameter_overrides=[bag]))
            run = optimise_pipeline.StudyClient("/", lambda: None)
        try:
            wait_for(lambda: mesher.simulators.found(), "the mesher to find the simulator")
            wait_for(
                lambda: len(node._recordings) == len(recorder.TOPICS) + 1,
                "the recorder to find the topics",
            )
            names = {"simulator": simulator.get_name()}
            everyone = {names.get(name, name) for name in (*NODES, "run")}
            wait_for(lambda: everyone <= set(run._node.get_node_names()), "all to see each other")
            for name in (*NODES, "run"):
                policy = allowed(name)

                def unmet(name=name, policy=policy):
                    real = had(run._node, names.get(name, name))
                    left = {(kind, p) for kind in KINDS for p in policy[kind]}
                    for kind in KINDS:
                        for topic in real[kind]:
                            matching = {(kind, p) for p in policy[kind] if fnmatchcase(topic, p)}
                            assert matching, f"{name} may not {kind} {topic}"
                            left -= matching
                    return left

                # A node is seen before all that it has is.
                wait_for(lambda unmet=unmet: not unmet(), f"{name} to need all that it may")
        finally:
            run.leave()
    assert {f"/{topic}" for topic in recorder.TOPICS} <= allowed("recorder")["subscribe"]


@pytest.mark.parametrize("name", sorted(NODES))
def test_every_node_refuses_to_start_without_the_security_asked_for(tmp_path, name):
    command = [sys.executable, "-m", "biped_mfpt_ros.cli", "node", name]
    package = str(Path(__file__).parents[1])
    started = []
    for strategy, said in (
        (None, "ROS_SECURITY_STRATEGY: 'Permissive' is not allowed; allowed: Enforce"),
        ("Permissive", "ROS_SECURITY_STRATEGY: 'Permissive' is not allowed; allowed: Enforce"),
        (
            "Enforce",
            "ROS_SECURITY_ENABLE: 'true' is not allowed; allowed: false, unless this ROS 2",
        ),
    ):
        asked = {"ROS_SECURITY_ENABLE": "true"}
        if strategy is not None:
            asked["ROS_SECURITY_STRATEGY"] = strategy
        node = subprocess.Popen(
            command, env=os.environ | asked | {"PYTHONPATH": package}, cwd=tmp_path,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        started.append((node, said))
    for node, said in started:
        _, written = node.communicate(timeout=600.0)
        assert node.returncode == 2
        assert said in written
        assert "Traceback" not in written
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("given", "taken"), [(None, "LOCALHOST"), ("", "LOCALHOST"), ("OFF", "OFF"), ("SUBNET",) * 2]
)
def test_discovery_stays_on_this_machine_unless_told_otherwise(monkeypatch, given, taken):
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE", raising=False)
    if given is not None:
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", given)
    prepare_environment()
    assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == taken


def test_the_page_on_security_names_every_policy():
    page = (POLICIES.parent / "security.md").read_text()
    assert set(re.findall(r"`/biped/(\w+)` \|", page)) == {*NODES, "run"}
