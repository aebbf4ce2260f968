"""What `fuzz` gives bad input to: every parser and message handler that takes what others sent."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import patch

import numpy as np
from biped_mfpt_msgs import msg
from biped_mfpt_msgs.srv import SimulateSteps
from rclpy.context import Context
from rclpy.node import Node
from rclpy.serialization import serialize_message

from biped_mfpt_ros.bag.definitions import message_definition
from biped_mfpt_ros.bag.error import BagError
from biped_mfpt_ros.bag.reader import Bag
from biped_mfpt_ros.bag.repair import salvage
from biped_mfpt_ros.bag.report import inspect_bag
from biped_mfpt_ros.bag.sequences import leading_sequence
from biped_mfpt_ros.bag.writer import BagWriter
from biped_mfpt_ros.chain.markov import ChainError, metastability
from biped_mfpt_ros.chain.mesh import Mesh, grow_mesh
from biped_mfpt_ros.cli import options
from biped_mfpt_ros.cli.parser import make_parser
from biped_mfpt_ros.control.controller import controller, controller_names
from biped_mfpt_ros.gait.step import simulate_steps
from biped_mfpt_ros.nodes import messages
from biped_mfpt_ros.nodes.analysis import AnalysisParameters
from biped_mfpt_ros.nodes.assembly import IncompleteMesh, MeshAssembly
from biped_mfpt_ros.nodes.mesher import MesherParameters
from biped_mfpt_ros.nodes.optimiser import OptimiserParameters
from biped_mfpt_ros.nodes.parameters import Declared, NodeParameters
from biped_mfpt_ros.nodes.recorder import RecorderParameters
from biped_mfpt_ros.nodes.simulator import SimulatorParameters
from biped_mfpt_ros.nodes.spin import initialise
from biped_mfpt_ros.soak import inputs
from biped_mfpt_ros.soak.result import check
from biped_mfpt_ros.walker.robot import WalkerModel
from biped_mfpt_ros.walker.terrain import slope_set

_MOST_STATES, _MOST_OUTCOMES, MOST_EVALUATIONS = 8, 256, 50_000

# The paper's limit cycle of hzd/base on flat ground, rounded: a state that takes a step.
STATE = (
    3.615120, 3.034901, -0.416229, -0.319996, -0.015846,
    0.374090, -1.916832, -3.562034, 1.022692, 0.140844,
)  # fmt: skip
_SLOPES = slope_set(5.0)


class _Silent(io.StringIO):
    """A file that keeps nothing."""

    def write(self, text: str) -> int:
        return len(text)


# What comes over services and actions --------------------------------------------------------


def _controller(random: Random) -> msg.Controller:
    made = controller(random.choice(controller_names()))
    if random.random() < 0.3:
        return msg.Controller(name=made.name)
    return messages.controller_message(made)


def request(random: Random) -> SimulateSteps.Request:
    """A request to a simulator, with nothing wrong in it."""
    n = random.choice((0, 1, 1, 2))
    return SimulateSteps.Request(
        controller=_controller(random),
        model=messages.model_message(WalkerModel()),
        states=messages.packed(np.tile(STATE, (n, 1)), "d"),
        previous_slopes=messages.packed(np.zeros(n), "d"),
        slopes=messages.packed(_SLOPES, "d"),
        measures=random.random() < 0.5,
    )


def answer_request(random: Random) -> None:
    """A request as the simulator answers it, and its answer as the mesher reads it."""
    made = inputs.spoil(random, request(random))
    asked = messages.steps_request_from(made, _MOST_STATES, _MOST_OUTCOMES)
    steps = simulate_steps(
        asked.controller,
        asked.states,
        asked.previous_slopes,
        asked.slopes,
        asked.model,
        MOST_EVALUATIONS,
        made.measures,
    )
    response = SimulateSteps.Response()
    messages.fill_response(response, steps)
    back = messages.steps_from(response, len(steps.outcomes), asked.slopes.size)
    check(back.outcomes.tobytes() == steps.outcomes.tobytes())
    check(back.next_states.tobytes() == steps.next_states.tobytes())


def read_response(random: Random) -> None:
    """The answer of a simulator that is broken, or of something that is none."""
    n, m = random.randrange(4), random.randrange(1, 4)
    outcomes = [random.choice((0, 0, 1, 9)) for _ in range(n * m)]
    response = SimulateSteps.Response(
        success=True,
        outcomes=outcomes,
        next_states=[0.5] * (10 * outcomes.count(0)),
        durations=[0.5] * (n * m),
        step_lengths=[0.5] * (n * m),
        energies=[0.5] * (n * m),
        seconds=0.1,
        integrator_steps=17,
        evaluations=119,
    )
    steps = messages.steps_from(inputs.spoil(random, response), n, m)
    check(np.isfinite(steps.next_states).all())
    check(steps.outcomes.shape == (n, m))


def read_settings(random: Random) -> None:
    """The settings of a goal."""
    made = messages.MeshSettings(
        controller(random.choice(controller_names())),
        WalkerModel(),
        _SLOPES,
        0.3,
        initial_state=np.array(STATE) if random.random() < 0.5 else None,
    )
    settings = messages.settings_from(inputs.spoil(random, messages.settings_message(made)))
    again = messages.settings_from(messages.settings_message(settings))
    check(again.slopes.tobytes() == settings.slopes.tobytes())
    check(again.controller.parameters.tobytes() == settings.controller.parameters.tobytes())


# What comes over topics ----------------------------------------------------------------------


def _made_up_mesh() -> Mesh:
    """A mesh over a step map that is made up, of a few dozen states."""

    def simulate(states: np.ndarray, previous: np.ndarray) -> Any:
        mixed = np.sin(7.0 * states[:, None, :] + 20.0 * _SLOPES[:, None])
        outcomes = np.where(mixed[..., 0] > 0.2, 0, 2).astype(np.uint8)

        class Answer:
            pass

        answer: Any = Answer()
        answer.outcomes, answer.next_states = outcomes, mixed[outcomes == 0]
        return answer

    return grow_mesh(simulate, np.full(10, 0.1), _SLOPES, 3.0)


class Published:
    """The messages of a mesh, to be spoilt."""

    def __init__(self) -> None:
        self.mesh = _made_up_mesh()
        self.settings = messages.MeshSettings(
            controller("hzd/base"), WalkerModel(), _SLOPES, 3.0, initial_state=np.full(10, 0.1)
        )
        self.estimate = metastability(self.mesh, 0.0, 0.05)

    def make(self, random: Random) -> list[Any]:
        """All messages, each topic's in order, with something wrong with some of them."""
        mesh, mesh_id = self.mesh, "mesh"
        infos = [
            msg.MeshInfo(
                mesh_id=mesh_id,
                status=status,
                settings=messages.settings_message(self.settings),
                states=len(mesh.states),
                scales=messages.packed(mesh.scales, "d"),
            )
            for status in (msg.MeshInfo.GROWING, msg.MeshInfo.COMPLETE)
        ]
        states = messages.all_states_messages(mesh_id, mesh)
        transitions = [*messages.transitions_messages(mesh_id, mesh.targets, mesh.outcomes)]
        estimates = [
            messages.estimate_message(mesh_id, "hzd/base", mesh, 0.0, 0.05, 0.0, self.estimate, 0.1)
        ]
        for topic in (infos, states, transitions, estimates):
            for sequence, message in enumerate(topic):
                message.sequence = sequence
        together = [infos[0], *states, infos[1], *transitions, *estimates]
        for _ in range(random.choice((0, 1, 1, 2))):
            inputs.spoil(random, random.choice(together))
        at = random.randrange(len(together))
        kind = random.random()
        if kind < 0.1:
            del together[at]
        elif kind < 0.2:
            together.insert(at, random.choice(together))
        elif kind < 0.3:
            random.shuffle(together)
        return together


_ADD = {
    msg.MeshInfo: MeshAssembly.add_info,
    msg.MeshStates: MeshAssembly.add_states,
    msg.MeshTransitions: MeshAssembly.add_transitions,
}


@contextmanager
def assemble_mesh() -> Iterator[Callable[[Random], None]]:
    """Messages of a mesh, as the analysis puts them together and solves the chain."""
    published = Published()

    def give(random: Random) -> None:
        assembly = MeshAssembly("mesh")
        for message in published.make(random):
            if type(message) in _ADD:
                _ADD[type(message)](assembly, message)
        check(bool(assembly.missing) != assembly.complete)
        # The reason to give up a mesh is told, and logged.
        check(len(assembly.missing) < 10_000)
        with contextlib.suppress(IncompleteMesh, ChainError):
            correlation = inputs.number(random, random.choice((0.0, 0.5)))
            result = metastability(assembly.mesh(), 0.0, inputs.number(random, 0.05), correlation)
            check(result.mfpt >= 1.0)

    yield give


def read_counter(random: Random) -> None:
    """Bytes of a message whose counter the recorder reads."""
    kind = random.choice((msg.MeshInfo, msg.MeshStates, msg.MfptEstimate, msg.OptimisationTrial))
    data = inputs.spoilt(random, serialize_message(kind(sequence=random.randrange(2**64))))
    with contextlib.suppress(ValueError):
        check(0 <= leading_sequence(data) < 2**64)


# Bags ----------------------------------------------------------------------------------------


def _write(path: Path, spread: list[Any], spoil_bytes: Random | None = None) -> None:
    with BagWriter(path) as writer:
        for i, message in enumerate(spread):
            name = f"biped_mfpt_msgs/msg/{type(message).__name__}"
            writer.add_topic(f"/{type(message).__name__}", name, message_definition(name))
            data = serialize_message(message)
            if spoil_bytes is not None and spoil_bytes.random() < 1.0 / len(spread):
                data = inputs.spoilt(spoil_bytes, data)
            writer.write(f"/{type(message).__name__}", data, i, i, i)
            if i % 3 == 0:
                writer.flush()


@contextmanager
def inspect_hostile_bag() -> Iterator[Callable[[Random], None]]:
    """A whole bag with messages that cannot be."""
    published = Published()
    with tempfile.TemporaryDirectory() as directory:

        def give(random: Random) -> None:
            path = Path(directory, "bag")
            shutil.rmtree(path, ignore_errors=True)
            _write(path, published.make(random), random if random.random() < 0.3 else None)
            inspect_bag(path)

        yield give


@contextmanager
def read_damaged_bag() -> Iterator[Callable[[Random], None]]:
    """A bag with damaged bytes: what is read of it is what was written, and it is never changed."""
    published = Published()
    with tempfile.TemporaryDirectory() as directory:
        whole = Path(directory, "whole")
        _write(whole, published.make(Random(3)))
        good = [(m.topic, m.data) for m in Bag(whole).raw_messages()]
        file, yaml = whole / "whole_0.mcap", whole / "metadata.yaml"
        data, text = file.read_bytes(), yaml.read_bytes()
        saved = Path(directory, "saved")

        def give(random: Random) -> None:
            shutil.rmtree(saved, ignore_errors=True)
            file.write_bytes(damaged := inputs.spoilt(random, data))
            described = random.random()
            if described < 0.5:
                yaml.write_bytes(text if described < 0.3 else inputs.spoilt(random, text))
            else:
                yaml.unlink(missing_ok=True)
            read = []
            try:
                for raw in Bag(whole, unfinished=random.random() < 0.5).raw_messages():
                    read.append((raw.topic, raw.data))
            finally:
                check(file.read_bytes() == damaged)
                check([r[1] for r in read] == [g[1] for g in good[: len(read)]])
                with contextlib.suppress(BagError):
                    check(sum(salvage(whole, saved).counts.values()) >= len(read))
                    list(Bag(saved).raw_messages())

        yield give


# Parameters, files, command line -------------------------------------------------------------

PARAMETERS: dict[str, type[NodeParameters]] = {
    "simulator": SimulatorParameters,
    "mesher": MesherParameters,
    "analysis": AnalysisParameters,
    "optimiser": OptimiserParameters,
    "recorder": RecorderParameters,
}
"""Of each node."""


def value(random: Random) -> Any:
    """Anything that a parameter of ROS can be."""
    kind = random.randrange(7)
    if kind == 0:
        return random.random() < 0.5
    if kind == 1:
        return inputs.whole(random, 64, signed=True)
    if kind == 2:
        return inputs.number(random)
    if kind == 3:
        return inputs.text(random)
    if kind == 4:
        return [inputs.number(random) for _ in range(random.randrange(4))]
    if kind == 5:
        return [inputs.text(random) for _ in range(random.randrange(4))]
    return None if random.random() < 0.5 else b"bytes"


def set_parameters(random: Random) -> None:
    """Values of a node's parameters."""
    kind = random.choice([*PARAMETERS.values()])
    names = [field.name for field in fields(kind)]
    given = {name: value(random) for name in random.sample(names, random.randint(1, 2))}
    made = kind(**given)
    for name in given:
        taken = getattr(made, name)
        check(not (isinstance(taken, float) and math.isnan(taken)))


_YAML = (
    ".nan", "-.inf", "1e999", "~", "[]", "[1, 2.5]", "[1, a]", "[[1]]", "{a: 1}", "'x'", "!!int x",
    "&a [*a]", "99999999999999999999", "0x7f", "yes", "|\n x", "- 1", "",
)  # fmt: skip


@contextmanager
def read_parameter_file() -> Iterator[Callable[[Random], None]]:
    """A file of parameters with which a node starts."""
    # Nobody is to be found, which would take most of the time.
    alone = patch.dict(os.environ, ROS_AUTOMATIC_DISCOVERY_RANGE="OFF")
    with tempfile.TemporaryDirectory() as directory, alone:
        path = Path(directory, "parameters.yaml")

        def give(random: Random) -> None:
            name, kind = random.choice([*PARAMETERS.items()])
            lines = [f"{random.choice((name, '/**'))}:", "  ros__parameters:"]
            for field in random.sample(fields(kind), random.randint(1, 2)):
                given = random.choice(_YAML) if random.random() < 0.7 else value(random)
                lines.append(f"    {field.name}: {given}")
            data = "\n".join(lines).encode(errors="replace")
            path.write_bytes(inputs.spoilt(random, data) if random.random() < 0.3 else data)
            context = Context()
            try:
                initialise(["--ros-args", "--params-file", str(path)], context)
                node = Node(
                    name, context=context, start_parameter_services=False, enable_rosout=False
                )
                Declared(node, kind)
                node.destroy_node()
            finally:
                context.try_shutdown()

        yield give


_WALKER = (
    "--controller", "--torque-limit", "--friction", "--slip-duration", "--time-limit",
    "--tolerance", "--json", "--quiet",
)  # fmt: skip
_MESH = ("--slope-step", "--slope-limit", "--threshold", "--max-states", "--unclustered")
_GROUND = ("--mean", "--correlation")
_COMMANDS = {
    "run": (*_WALKER, *_MESH, *_GROUND, "--sigma", "--walks", "--seed", "--workers", "--namespace"),
    "mfpt": (*_WALKER, *_MESH, *_GROUND, "--sigma"),
    "mesh": (*_WALKER, *_MESH, "--output"),
    "monte-carlo": (*_WALKER, *_GROUND, "--sigma", "--walks", "--seed", "--max-steps"),
    "cycle": (*_WALKER, "--slope"),
    "step": (*_WALKER, "--slope", "--previous-slope", "--state"),
    "picture": (
        *_WALKER,
        *_MESH,
        *_GROUND,
        "--sigma",
        "--seed",
        "--number",
        "--last-steps",
        "--output",
    ),
    "inspect": (*_GROUND, "--sigma", "--json", "--quiet"),
    "node": (),
    "dance": _WALKER,
}
_NEEDED = {
    "mfpt": ["--sigma", "1"],
    "monte-carlo": ["--sigma", "1"],
    "step": ["--state", ",".join(map(str, STATE))],
    "picture": ["gait", "--output", "new.png"],
    "inspect": ["no/such/bag"],
    "node": ["simulator"],
}
_SWITCHES = ("--json", "--quiet", "--unclustered")


def _words(random: Random) -> list[str]:
    """A command line: options of one command with values that may be anything."""
    command = random.choice([*_COMMANDS])
    out = [command, *(_NEEDED.get(command, []) if random.random() < 0.9 else [])]
    for _ in range(random.randrange(4) if _COMMANDS[command] else 0):
        option = random.choice(_COMMANDS[command])
        out.append(option)
        if (option not in _SWITCHES) == (random.random() < 0.95):
            out.append(_word(random, option))
    return out


def _word(random: Random, option: str) -> str:
    kind = random.random()
    if option == "--state":
        return ",".join(str(inputs.number(random, x)) for x in STATE)
    if option in ("--controller", "--namespace", "--output") or kind < 0.1:
        return inputs.text(random, random.choice(controller_names()))
    return str(inputs.whole(random, 64, True) if kind < 0.4 else inputs.number(random))


def read_command_line(random: Random) -> None:
    """A command line, up to where the work would begin."""
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(_Silent()):
        try:
            args = make_parser().parse_args(_words(random))
        except SystemExit as end:
            check(end.code in (0, 2))
            lines = errors.getvalue().splitlines()
            check(end.code == 0 or "error: " in errors.getvalue())
            check(end.code == 0 or len(lines) <= 5)
            return
    given = vars(args)
    if "controller" in given:
        walking, model = options.walker_of(args)
    for name in ("slope", "previous_slope", "mean"):
        if given.get(name) is not None:
            check(math.isfinite(options.slope(f"--{name}", given[name])))
    if given.get("sigma"):
        sigmas = given["sigma"] if isinstance(given["sigma"], list) else [given["sigma"]]
        for sigma in sigmas:
            check(options.spread("--sigma", sigma) > 0.0)
    if given.get("correlation") is not None:
        check(abs(options.correlation_of(args)) < 1.0)
    if "threshold" in given:
        slopes = options.slopes_of(args)
        messages.MeshSettings(walking, model, slopes, args.threshold, **options.mesh_settings(args))
    if "state" in given:
        simulate_steps(walking, [args.state], [0.0], [0.0], model, MOST_EVALUATIONS)


@contextmanager
def read_result_file() -> Iterator[Callable[[Random], None]]:
    """A result that a study kept, cut off or overwritten: read as it was, or computed again."""
    from biped_mfpt_ros.study.plan import Job
    from biped_mfpt_ros.study.store import Store

    with tempfile.TemporaryDirectory() as directory:
        store = Store(Path(directory))
        job = Job("mesh", "hzd/base", {"threshold": 0.3})
        result = {"x": [1.5, 2.5], "y": "z"}
        store.put(job, result)
        path = store.path(job)
        data = path.read_bytes()
        deep = [b"[" * 100_000, b'{"a":' * 50_000, json.dumps({"inputs": job.inputs}).encode()]

        def give(random: Random) -> None:
            path.write_bytes(
                random.choice(deep) if random.random() < 0.05 else inputs.spoilt(random, data)
            )
            kept = store.get(job)
            check(kept is None or isinstance(kept, dict))

        yield give


# ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TargetEntry:
    """A target, and how much of the inputs it gets.

    Attributes
    ----------
    name : str
    share : float
        Relative to the others'.
    make : callable
        Context manager that sets it up and gives the function that takes a random generator.
    """

    name: str
    share: float
    make: Callable[[], AbstractContextManager[Callable[[Random], object]]]


def _plain(give: Callable[[Random], None]) -> Callable[[], Any]:
    return lambda: contextlib.nullcontext(give)


TARGETS = (
    TargetEntry("requests to a simulator", 20, _plain(answer_request)),
    TargetEntry("answers of a simulator", 20, _plain(read_response)),
    TargetEntry("settings of a mesh", 20, _plain(read_settings)),
    TargetEntry("messages of a mesh", 10, assemble_mesh),
    TargetEntry("counters of messages", 10, _plain(read_counter)),
    TargetEntry("messages in a bag", 1.5, inspect_hostile_bag),
    TargetEntry("bytes of a bag", 3, read_damaged_bag),
    TargetEntry("parameters of nodes", 10, _plain(set_parameters)),
    TargetEntry("parameter files", 0.3, read_parameter_file),
    TargetEntry("command lines", 4, _plain(read_command_line)),
    TargetEntry("results on disk", 5, read_result_file),
)
"""All of them, the cheap ones with more inputs."""
