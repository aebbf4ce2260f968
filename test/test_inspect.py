"""Meshes out of a bag: equal bit for bit, with the MFPT that was published, or a clear error."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from biped_mfpt_msgs import msg as messages
from rclpy.serialization import serialize_message
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_bag import QOS, add_topic, stated_hash

from biped_mfpt_ros.bag import BagError, BagWriter, inspect_bag, read_meshes, salvage
from biped_mfpt_ros.bag.definitions import message_definition
from biped_mfpt_ros.bag.metadata import STARTED_LATE
from biped_mfpt_ros.chain.markov import metastability
from biped_mfpt_ros.chain.mesh import Mesh, grow_mesh
from biped_mfpt_ros.cli import main
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.nodes import messages as conversion
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import WalkerModel
from biped_mfpt_ros.walker.terrain import slope_set

SETTINGS = conversion.MeshSettings(
    controller("hzd/base"), WalkerModel(), slope_set(2.0), 0.05, initial_state=np.full(10, 0.1)
)
SIGMAS = (math.radians(1.0), math.radians(2.0))


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    """A mesh over a step map that is made up, of a few hundred states."""

    def simulate(states, previous):
        mixed = np.sin(7.0 * states[:, None, :] + 20.0 * SETTINGS.slopes[:, None])
        outcomes = np.where(
            np.abs(SETTINGS.slopes) + 0.05 * mixed[..., 0] > 0.2,
            np.where(mixed[..., 1] > 0.0, Outcome.STANCE_SLIPS, Outcome.SWING_SCUFFS),
            Outcome.STEP,
        ).astype(np.uint8)
        return SimpleNamespace(outcomes=outcomes, next_states=mixed[outcomes == Outcome.STEP])

    made = grow_mesh(simulate, np.full(10, 0.1), SETTINGS.slopes, 0.05)
    assert 100 < len(made.states) < 5000
    return made


class Recording:
    """What a recorder would have heard of a mesh, to be spoilt before it is written."""

    def __init__(
        self, mesh: Mesh, mesh_id: str = "mesh-1", sigmas=SIGMAS, patience=40, correlations=(0.0,)
    ):
        def info(status, **fields):
            return messages.MeshInfo(
                mesh_id=mesh_id, status=status, step_map="1+abc", seconds=2.5,
                settings=conversion.settings_message(SETTINGS), **fields,
            )  # fmt: skip

        self.info = [
            info(messages.MeshInfo.GROWING, states=1),
            info(
                messages.MeshInfo.COMPLETE,
                states=len(mesh.states),
                generations=int(mesh.generation.max()) + 1,
                scales=conversion.packed(mesh.scales, "d"),
            ),
        ]
        self.states = conversion.all_states_messages(mesh_id, mesh)
        self.transitions = [
            messages.MeshTransitions(
                mesh_id=mesh_id,
                first_index=start,
                targets=conversion.packed(mesh.targets[start : start + patience], "I"),
                outcomes=conversion.packed(mesh.outcomes[start : start + patience], "B"),
            )
            for start in range(1, len(mesh.states), patience)
        ]
        self.mfpt = [
            conversion.estimate_message(
                mesh_id,
                "hzd/base",
                mesh,
                0.0,
                sigma,
                rho,
                metastability(mesh, 0.0, sigma, rho),
                0.01,
            )
            for rho in correlations
            for sigma in sigmas
        ]
        for topic in (self.info, self.states, self.transitions, self.mfpt):
            for sequence, message in enumerate(topic):
                message.sequence = sequence

    def write(self, path: Path, close: bool = True, **custom: str) -> Path:
        writer = BagWriter(path)
        writer.custom.update(custom)
        for topic, name in (
            ("mesh/info", "MeshInfo"),
            ("mesh/states", "MeshStates"),
            ("mesh/transitions", "MeshTransitions"),
            ("mfpt", "MfptEstimate"),
        ):
            add_topic(writer, f"/run/{topic}", name)
        # Topics may overtake one another: the end of the mesh comes before its transitions.
        spread = [("mesh/info", m) for m in self.info]
        spread += [("mesh/transitions", m) for m in self.transitions]
        spread[1:1] = [("mesh/states", m) for m in self.states]
        spread += [("mfpt", m) for m in self.mfpt]
        for i, (topic, message) in enumerate(spread):
            time = 10**18 + i * 10**6
            data = serialize_message(message)
            writer.write(f"/run/{topic}", data, time, time, message.sequence)
            writer.flush()
        if close:
            writer.close()
        return path


def assert_same(a: Mesh, b: Mesh) -> None:
    for field in dataclasses.fields(Mesh):
        one, other = getattr(a, field.name), getattr(b, field.name)
        if isinstance(one, np.ndarray):
            assert one.dtype == other.dtype
            assert one.tobytes() == other.tobytes()
        else:
            assert one == other


def test_mesh_comes_out_of_the_bag_bit_for_bit(tmp_path, mesh):
    recorded = read_meshes(Recording(mesh).write(tmp_path / "bag"))
    assert [*recorded] == ["mesh-1"]
    found = recorded["mesh-1"]
    assert_same(found.mesh, mesh)
    assert (found.status, found.problem, found.step_map) == ("complete", "", "1+abc")
    assert found.settings.controller.name == "hzd/base"
    assert found.settings.model == SETTINGS.model
    assert found.settings.initial_state.tobytes() == SETTINGS.initial_state.tobytes()


def test_report_has_the_mfpt_that_was_published(tmp_path, mesh):
    bag = Recording(mesh).write(tmp_path / "bag")
    report = inspect_bag(bag)
    assert report.problems == []
    assert report.identical
    (found,) = report.meshes
    assert [(e.mu_s, e.sigma_s) for e in found.estimates] == [(0.0, sigma) for sigma in SIGMAS]
    for estimate in found.estimates:
        expected = metastability(mesh, 0.0, estimate.sigma_s)
        assert estimate.identical
        assert estimate.mfpt == estimate.published.mfpt == expected.mfpt
        assert estimate.failure_probability == expected.failure_probability
        assert sum(estimate.failure_shares.values()) == pytest.approx(1.0, abs=1e-12)
        assert set(estimate.failure_shares) == {"stance_slips", "swing_scuffs"}
    assert (found.controller, found.scheme, found.slopes) == ("hzd/base", "hzd", 21)
    assert found.model["torque_limit"] == 50.0
    assert (found.states, found.generations) == (len(mesh.states), mesh.generation.max() + 1)
    assert sum(found.outcomes.values()) == (len(mesh.states) - 1) * 21
    assert found.outcomes["step"] == np.count_nonzero(mesh.targets)
    assert {topic.name: topic.type_name.split("/")[-1] for topic in report.topics} == {
        "/run/mesh/info": "MeshInfo",
        "/run/mesh/states": "MeshStates",
        "/run/mesh/transitions": "MeshTransitions",
        "/run/mfpt": "MfptEstimate",
    }
    assert report.messages == sum(topic.messages for topic in report.topics)
    assert report.duration == pytest.approx(1e-3 * (report.messages - 1), abs=1e-9)
    assert report.bytes == (bag / "bag_0.mcap").stat().st_size
    assert json.loads(json.dumps(report.to_dict()))["meshes"][0]["mesh_id"] == "mesh-1"


def test_report_for_other_distributions(tmp_path, mesh):
    bag = Recording(mesh).write(tmp_path / "bag")
    (found,) = inspect_bag(bag, sigmas=[SIGMAS[0], 0.05]).meshes
    assert [e.identical for e in found.estimates] == [True, None]
    assert found.estimates[1].mfpt == metastability(mesh, 0.0, 0.05).mfpt
    (found,) = inspect_bag(bag, sigmas=[SIGMAS[0]], mu=-0.02).meshes
    assert found.estimates[0].published is None
    assert found.estimates[0].mfpt == metastability(mesh, -0.02, SIGMAS[0]).mfpt
    for sigmas, mu, field in (([0.0], 0.0, "sigma_s"), ([math.nan], 0.0, "sigma_s"),
                              ([0.1], 1.0, "mu_s")):  # fmt: skip
        with pytest.raises(InputError, match=field):
            inspect_bag(bag, sigmas, mu)


def test_report_for_correlated_ground(tmp_path, mesh):
    bag = Recording(mesh, correlations=(0.0, -0.5)).write(tmp_path / "bag")
    report = inspect_bag(bag)
    assert report.identical
    (found,) = report.meshes
    assert [(e.sigma_s, e.correlation) for e in found.estimates] == [
        (sigma, rho) for rho in (0.0, -0.5) for sigma in SIGMAS
    ]
    (found,) = inspect_bag(bag, [SIGMAS[0]], correlation=-0.5).meshes
    assert found.estimates[0].identical
    (found,) = inspect_bag(bag, [SIGMAS[0]], -0.02, 0.7).meshes
    assert found.estimates[0].published is None
    assert found.estimates[0].mfpt == metastability(mesh, -0.02, SIGMAS[0], 0.7).mfpt
    with pytest.raises(InputError, match=r"^correlation: "):
        inspect_bag(bag, [SIGMAS[0]], correlation=1.0)


def test_estimates_that_know_no_correlation_are_of_independent_slopes(tmp_path, mesh):
    name = "biped_mfpt_msgs/msg/MfptEstimate"
    text = message_definition(name)
    older = re.sub(r"float64 correlation.*\n", "", text)
    stores = [get_typestore(Stores.EMPTY) for _ in range(2)]
    for store, definition in zip(stores, (text, older), strict=True):
        store.register(get_types_from_msg(definition, name))
    recording = Recording(mesh)
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/mfpt", name, older)
        for message in recording.mfpt:
            fields = vars(stores[0].deserialize_cdr(serialize_message(message), name))
            kept = {key: fields[key] for key in fields if key not in ("correlation", "__msgtype__")}
            old = stores[1].types[name](**kept)
            writer.write("/mfpt", bytes(stores[1].serialize_cdr(old, name)), 0, 0)
        for kind in ("info", "states", "transitions"):
            add_topic(writer, f"/mesh/{kind}", f"Mesh{kind.capitalize()}")
            for message in getattr(recording, kind):
                writer.write(f"/mesh/{kind}", serialize_message(message), 0, 0)
    report = inspect_bag(tmp_path / "bag")
    assert report.problems == []
    assert [(e.correlation, e.identical) for e in report.meshes[0].estimates] == [
        (0.0, True) for _ in SIGMAS
    ]


def test_other_number_than_published_is_reported(tmp_path, mesh):
    recording = Recording(mesh)
    recording.mfpt[1].mfpt = math.nextafter(recording.mfpt[1].mfpt, math.inf)
    report = inspect_bag(recording.write(tmp_path / "bag"))
    assert [e.identical for e in report.meshes[0].estimates] == [True, False]
    assert not report.identical
    assert any("was published" in problem for problem in report.problems)


def test_bag_of_several_meshes(tmp_path, mesh):
    writer = BagWriter(tmp_path / "bag")
    for name in ("MeshInfo", "MeshStates", "MeshTransitions"):
        add_topic(writer, f"/{name}", name)
    sequences = dict.fromkeys(("MeshInfo", "MeshStates", "MeshTransitions"), 0)
    failed = Recording(mesh, "failed")
    failed.info[1].status, failed.info[1].message = messages.MeshInfo.FAILED, "no simulator"
    cut = Recording(mesh, "cut")
    cut.info.pop()
    for recording in (Recording(mesh, "first"), failed, cut, Recording(mesh, "last")):
        for message in [*recording.info, *recording.states, *recording.transitions]:
            name = type(message).__name__
            message.sequence = sequences[name]
            sequences[name] += 1
            writer.write(f"/{name}", serialize_message(message), message.sequence, 0)
    writer.close()
    recorded = read_meshes(tmp_path / "bag")
    assert {m.mesh_id: (m.status, m.mesh is not None) for m in recorded.values()} == {
        "first": ("complete", True),
        "failed": ("failed", False),
        "cut": ("growing", False),
        "last": ("complete", True),
    }
    assert "no simulator" in recorded["failed"].problem
    assert_same(recorded["first"].mesh, recorded["last"].mesh)
    report = inspect_bag(tmp_path / "bag")
    # That a mesh failed is a result; that one never ended is a fault of the recording.
    assert [problem.split(":")[0] for problem in report.problems] == ["mesh cut"]


def test_counters_of_a_bag_that_leaves_out_what_was_before_begin_anywhere(tmp_path, mesh):
    recording = Recording(mesh)
    for topic in (recording.info, recording.states, recording.transitions, recording.mfpt):
        for message in topic:
            message.sequence += 2
    late = {STARTED_LATE: "yes"}
    report = inspect_bag(recording.write(tmp_path / "late", **late))
    assert not report.problems
    assert report.identical
    # Of any other bag the counters begin with the publisher.
    problems = inspect_bag(recording.write(tmp_path / "whole")).problems
    assert "/run/mesh/info: messages 0 to 1 are missing" in problems
    assert len(problems) == 4
    recording.states.pop(3)
    problems = inspect_bag(recording.write(tmp_path / "lossy", **late)).problems
    assert "/run/mesh/states: message 5 is missing" in problems


SPOILT = {
    "a message of states is lost": (lambda r: r.states.pop(3), "message 3 is missing"),
    "the first transitions are lost": (lambda r: r.transitions.pop(0), "message 0 is missing"),
    "the last transitions are lost": (lambda r: r.transitions.pop(), "the transitions of"),
    "a message came twice": (lambda r: r.states.insert(2, r.states[1]), "came again"),
    "no end": (lambda r: r.info.pop(), "not finished"),
    "no beginning and no end": (lambda r: r.info.clear(), "nothing says what it is"),
    "a target that is no state": (lambda r: spoil(r.transitions[1].targets, 10**9), "targets"),
    "a success without target": (lambda r: spoil(r.transitions[1].targets, 0, True), "STEP"),
    "a state that is not finite": (lambda r: spoil(r.states[2].states, math.nan), "states"),
    "a slope that is not there": (lambda r: spoil(r.states[2].preceding, 21), "preceding"),
    "half a state": (lambda r: r.states[2].states.pop(), "numbers for"),
    "half a row": (lambda r: r.transitions[1].outcomes.pop(), "outcomes for rows"),
    "an index that is not next": (lambda r: setattr(r.states[2], "first_index", 7**8), "index"),
    "scales that cannot be": (lambda r: spoil(r.info[1].scales, -1.0), "scales"),
    "no scales": (lambda r: setattr(r.info[1], "scales", []), "scales"),
    "slopes out of order": (lambda r: spoil(r.info[0].settings.slopes, 0.5), "slopes"),
    "no threshold": (lambda r: setattr(r.info[0].settings, "threshold", 0.0), "threshold"),
    "a scheme that does not exist": (
        lambda r: setattr(r.info[0].settings.controller, "scheme", "zmp"),
        "zmp",
    ),
    "more states than said": (lambda r: setattr(r.info[1], "states", 9), "more than the 9"),
}


def spoil(field, value, of_success: bool = False) -> None:
    field[next(i for i, was in enumerate(field) if was) if of_success else 0] = value


@pytest.mark.parametrize("case", SPOILT)
def test_spoilt_mesh_is_no_mesh_and_says_why(tmp_path, mesh, case):
    recording = Recording(mesh, sigmas=())
    change, text = SPOILT[case]
    change(recording)
    bag = recording.write(tmp_path / "bag")
    (found,) = read_meshes(bag).values()
    assert found.mesh is None
    assert found.problem
    problems = inspect_bag(bag).problems
    assert any(text in problem for problem in problems), problems


def test_cut_off_bag_is_salvaged_and_says_what_is_missing(tmp_path, mesh):
    bag = Recording(mesh).write(tmp_path / "bag", close=False)
    file = bag / "bag_0.mcap"
    for share in (0.25, 0.5, 0.7, 0.9, 1.0):
        broken = tmp_path / f"broken{share}"
        broken.mkdir()
        (broken / file.name).write_bytes(file.read_bytes())
        os.truncate(broken / file.name, int(file.stat().st_size * share))
        with pytest.raises(BagError, match="no end") as raised:
            inspect_bag(broken)
        assert str(broken) in str(raised.value)
        assert salvage(broken, tmp_path / f"saved{share}").missing
        report = inspect_bag(tmp_path / f"saved{share}")
        (found,) = report.meshes
        if share == 1.0:  # all had been flushed
            assert found.problem == ""
            assert report.identical
            assert len(found.estimates) == len(SIGMAS)
        elif found.problem:
            assert found.states == 0
            assert any("mesh-1" in problem for problem in report.problems)
        else:
            assert share == 0.9  # of the estimates only


def test_bag_without_meshes_is_a_clear_error(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        log = "rcl_interfaces/msg/Log"
        writer.add_topic("/rosout", log, message_definition(log), stated_hash(log), [QOS])
    with pytest.raises(BagError, match=r"holds no mesh, only rcl_interfaces/msg/Log"):
        inspect_bag(tmp_path / "bag")
    with pytest.raises(BagError, match="does not exist"):
        inspect_bag(tmp_path / "nothing")


def test_messages_of_another_version_are_a_clear_error(tmp_path, mesh):
    info = "biped_mfpt_msgs/msg/MeshInfo"
    with BagWriter(tmp_path / "bag") as writer:
        older = message_definition(info).replace("float64[] scales", "float64[] radii")
        writer.add_topic("/mesh/info", info, older)
        for message in Recording(mesh).info:
            writer.write("/mesh/info", serialize_message(message), 0, 0)
        add_topic(writer, "/mesh/states", "MeshStates")
        add_topic(writer, "/mesh/transitions", "MeshTransitions")
        for message in Recording(mesh).states:
            writer.write("/mesh/states", serialize_message(message), 0, 0)
        for message in Recording(mesh).transitions:
            writer.write("/mesh/transitions", serialize_message(message), 0, 0)
    with pytest.raises(BagError, match="without 'scales'; allowed: messages of this version"):
        read_meshes(tmp_path / "bag")


def test_inspect_repairs_a_cut_off_bag_and_leaves_it_as_it_is(tmp_path, mesh, capsys):
    bag = Recording(mesh).write(tmp_path / "bag", close=False)
    file = bag / "bag_0.mcap"
    before = file.read_bytes()
    assert main(["inspect", str(bag)]) == 2
    assert "`biped-mfpt inspect --repair` makes one of what is left" in capsys.readouterr().err
    new = tmp_path / "new"
    # All of it had been flushed: nothing but the end is missing.
    assert main(["inspect", str(bag), "--repair", str(new), "--json"]) == 1
    written = capsys.readouterr()
    report = json.loads(written.out)
    assert report["identical"]
    assert report["meshes"][0]["estimates"][0]["mfpt"] == metastability(mesh, 0.0, SIGMAS[0]).mfpt
    (problem,) = report["problems"]
    assert problem.startswith(f"not saved of {bag}: bag_0.mcap has no end")
    assert f"saved {report['messages']} messages of {bag} in {new}" in written.err
    assert main(["inspect", str(new)]) == 0
    # What is missing is said.
    os.truncate(file, len(before) // 2)
    capsys.readouterr()
    assert main(["inspect", str(bag), "--repair", str(tmp_path / "half")]) == 1
    text = capsys.readouterr().out
    assert f"not saved of {bag}: bag_0.mcap is cut off at byte" in text
    assert "cannot be rebuilt: of 372 states" in text
    assert file.read_bytes() == before[: len(before) // 2]
    assert [path.name for path in bag.iterdir()] == ["bag_0.mcap"]
    # Never over something that is there.
    assert main(["inspect", str(bag), "--repair", str(new)]) == 2
    assert "exists already" in capsys.readouterr().err
