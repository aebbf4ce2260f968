import math
from dataclasses import replace
from types import SimpleNamespace

import hypothesis
import numpy as np
import pytest
from biped_mfpt_msgs.msg import Controller as ControllerMsg
from biped_mfpt_msgs.msg import MeshInfo, MeshStates, MeshTransitions
from biped_mfpt_msgs.msg import MeshSettings as MeshSettingsMsg
from biped_mfpt_msgs.msg import WalkerModel as WalkerModelMsg
from biped_mfpt_msgs.srv import SimulateSteps
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from rclpy.serialization import deserialize_message, serialize_message

from biped_mfpt_ros.chain.mesh import NOT_SIMULATED, Mesh
from biped_mfpt_ros.cli.parser import make_parser
from biped_mfpt_ros.control.controller import Controller, controller, controller_names
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.step import Steps
from biped_mfpt_ros.nodes import messages
from biped_mfpt_ros.nodes.assembly import IncompleteMesh, MeshAssembly
from biped_mfpt_ros.nodes.messages import MeshSettings
from biped_mfpt_ros.walker.robot import WalkerModel, rabbit
from biped_mfpt_ros.walker.terrain import slope_set

PATIENT = hypothesis.settings(deadline=None)  # others use the machine too
NANS = [math.nan] * len(controller("hzd/base").parameters)


def sent(message):
    """The message as it comes out at the other end."""
    return deserialize_message(serialize_message(message), type(message))


def same_bits(a, b):
    return np.asarray(a).tobytes() == np.asarray(b).tobytes()


@PATIENT
@given(npst.arrays(np.float64, npst.array_shapes(max_dims=2, min_side=0, max_side=7)))
def test_float_arrays_keep_every_bit(values):
    message = sent(MeshStates(states=messages.packed(values, "d")))
    assert same_bits(messages.unpacked(message.states, "d"), values)


@PATIENT
@given(npst.arrays(np.uint32, st.integers(0, 20)), npst.arrays(np.uint8, st.integers(0, 20)))
def test_integer_arrays_survive(targets, outcomes):
    message = sent(
        MeshTransitions(
            targets=messages.packed(targets, "I"), outcomes=messages.packed(outcomes, "B")
        )
    )
    assert (messages.unpacked(message.targets, "I") == targets).all()
    assert (messages.unpacked(message.outcomes, "B") == outcomes).all()


def test_strided_and_transposed_arrays_are_packed_row_major():
    values = np.arange(12.0).reshape(3, 4).T[::2]
    assert same_bits(messages.packed(values, "d"), np.ascontiguousarray(values))


@pytest.mark.parametrize("name", controller_names())
def test_catalogue_controller_round_trip_and_by_name(name):
    walking = controller(name)
    spelled_out = messages.controller_from(sent(messages.controller_message(walking)), rabbit())
    by_name = messages.controller_from(sent(ControllerMsg(name=name)), rabbit())
    for got in (spelled_out, by_name):
        assert (got.name, got.scheme) == (walking.name, walking.scheme)
        assert same_bits(got.parameters, walking.parameters)


def test_controller_with_infinite_limit_round_trip():
    base = controller("hzd/base")
    walking = Controller("mine", "hzd", np.append(base.parameters, np.inf))
    got = messages.controller_from(sent(messages.controller_message(walking)), rabbit())
    assert same_bits(got.parameters, walking.parameters)


@PATIENT
@given(
    st.floats(min_value=0.0, exclude_min=True),
    st.floats(min_value=0.0, exclude_min=True),
    st.floats(0.0, 1.0),
    st.floats(0.0, 60.0, exclude_min=True),
    st.floats(1e-13, 1e-2),
    st.sampled_from(["slope", "vertical"]),
)
def test_model_round_trip(torque_limit, friction, slip_duration, time_limit, tolerance, frame):
    model = WalkerModel(torque_limit, friction, slip_duration, time_limit, tolerance, frame)
    assert messages.model_from(sent(messages.model_message(model))) == model


def test_another_robot_goes_through_a_message():
    model = WalkerModel(robot=replace(rabbit(), femur_length=0.45))
    assert messages.model_from(sent(messages.model_message(model))) == model


def test_messages_have_the_defaults_of_the_library():
    assert messages.model_from(sent(WalkerModelMsg())) == WalkerModel()
    parser = make_parser().parse_args(["run"])
    slopes = slope_set(parser.slope_step, parser.slope_limit)
    wanted = MeshSettings(controller("hzd/base"), WalkerModel(), slopes, parser.threshold)
    sparse = MeshSettingsMsg(controller=ControllerMsg(name="hzd/base"))
    got = messages.settings_from(sent(sparse))
    assert same_bits(got.slopes, wanted.slopes)
    for name in ("model", "threshold", "clustered", "scale_refresh", "max_states", "initial_slope"):
        assert getattr(got, name) == getattr(wanted, name), name


def settings(**changes):
    values = {
        "controller": controller("smc/mfpt"),
        "model": WalkerModel(torque_limit=math.inf),
        "slopes": slope_set(5.0),
        "threshold": 0.3,
        "clustered": False,
        "scale_refresh": "addition",
        "max_states": 1234,
        "initial_state": np.linspace(-1.0, 1.0, 10),
        "initial_slope": math.radians(-5.0),
    }
    return MeshSettings(**{**values, **changes})


@pytest.mark.parametrize("initial_state", [None, np.linspace(-1.0, 1.0, 10)])
def test_settings_round_trip(initial_state):
    made = settings(initial_state=initial_state)
    got = messages.settings_from(sent(messages.settings_message(made)))
    assert same_bits(got.slopes, made.slopes)
    assert same_bits(got.controller.parameters, made.controller.parameters)
    assert got.model == made.model
    for name in ("threshold", "clustered", "scale_refresh", "max_states", "initial_slope"):
        assert getattr(got, name) == getattr(made, name), name
    if initial_state is None:
        assert got.initial_state is None
    else:
        assert same_bits(got.initial_state, initial_state)


def test_what_a_message_leaves_empty_is_the_default():
    message = messages.settings_message(settings())
    message.model.friction_frame = message.scale_refresh = ""
    got = messages.settings_from(sent(message))
    assert (got.model.friction_frame, got.scale_refresh) == ("slope", "generation")


def edit(message, path, value):
    *inside, last = path.split(".")
    for name in inside:
        message = getattr(message, name)
    setattr(message, last, value)


@pytest.mark.parametrize(
    ("path", "value", "field"),
    [
        ("controller.name", "hzd/none", "controller.name"),
        ("controller.scheme", "smc", "controller.scheme"),
        ("model.torque_limit", -1.0, "model.torque_limit"),
        ("model.friction", math.nan, "model.friction"),
        ("model.time_limit", math.inf, "model.time_limit"),
        ("model.friction_frame", "horizontal", "model.friction_frame"),
        ("model.robot.gravity", 0.0, "model.robot.gravity"),
        ("slopes", [math.inf], "slopes[0]"),
        ("slopes", [0.1, 0.0], "slopes[1]"),
        ("slopes", [0.0, math.nan], "slopes[1]"),
        ("slopes", [0.0, 1.0], "slopes[1]"),
        ("threshold", 0.0, "threshold"),
        ("threshold", -1.0, "threshold"),
        ("threshold", math.nan, "threshold"),
        ("threshold", math.inf, "threshold"),
        ("scale_refresh", "state", "scale_refresh"),
        ("max_states", 1, "max_states"),
        ("initial_state", [0.0] * 9, "initial_state"),
        ("initial_state", [0.0] * 9 + [math.nan], "initial_state[0][9]"),
        ("initial_slope", 0.001, "initial_slope"),
        ("initial_slope", math.nan, "initial_slope"),
    ],
)
def test_bad_settings_are_named(path, value, field):
    message = messages.settings_message(settings(initial_slope=0.0))
    message.controller = ControllerMsg(name="hzd/base")
    edit(message, path, value)
    with pytest.raises(InputError) as caught:
        messages.settings_from(sent(message))
    assert caught.value.field == f"settings.{field}"


@pytest.mark.parametrize(
    ("message", "field"),
    [
        (ControllerMsg(), "controller.name"),
        (ControllerMsg(name="mine", parameters=[1.0]), "controller.scheme"),
        (ControllerMsg(scheme="hzd", parameters=[1.0]), "controller.parameters"),
        (
            ControllerMsg(scheme="hzd", parameters=NANS),
            "controller.parameters[0]",
        ),
    ],
)
def test_bad_controllers_are_named(message, field):
    with pytest.raises(InputError) as caught:
        messages.controller_from(message, rabbit())
    assert caught.value.field == field


def request(n=3, m=5, **changes):
    values = {
        "controller": ControllerMsg(name="hzd/base"),
        "model": messages.model_message(WalkerModel()),
        "states": messages.packed(np.zeros((n, 10)), "d"),
        "previous_slopes": messages.packed(np.zeros(n), "d"),
        "slopes": messages.packed(np.linspace(-0.1, 0.1, m), "d"),
    }
    return SimulateSteps.Request(**{**values, **changes})


@pytest.mark.parametrize(
    ("bad", "limits", "field"),
    [
        (request(states=[0.0] * 11), (10, 100), "states"),
        (request(n=3), (2, 100), "states"),
        (request(n=3, m=5), (3, 14), "states"),
        (request(model=WalkerModelMsg(torque_limit=0.0)), (10, 100), "model.torque_limit"),
    ],
)
def test_bad_requests_are_named(bad, limits, field):
    with pytest.raises(InputError) as caught:
        messages.steps_request_from(bad, *limits)
    assert caught.value.field == field


def test_largest_request_is_taken():
    got = messages.steps_request_from(request(n=3, m=5), 3, 15)
    assert got.states.shape == (3, 10)
    assert got.slopes.shape == (5,)


@st.composite
def some_steps(draw):
    n, m = draw(st.integers(0, 4)), draw(st.integers(1, 5))
    outcomes = draw(npst.arrays(np.uint8, (n, m), elements=st.integers(0, 10)))
    finite = st.floats(allow_nan=False, allow_infinity=False)
    k = int((outcomes == 0).sum())
    measured = n if draw(st.booleans()) else 0
    measures = [draw(npst.arrays(np.float64, (measured, m), elements=finite)) for _ in range(3)]
    next_states = draw(npst.arrays(np.float64, (k, 10), elements=finite))
    return Steps(outcomes, next_states, *measures, 0.25, 17, 119)


@PATIENT
@given(some_steps())
def test_steps_round_trip(steps):
    response = SimulateSteps.Response()
    messages.fill_response(response, steps)
    got = messages.steps_from(sent(response), *steps.outcomes.shape)
    assert same_bits(got.outcomes, steps.outcomes)
    assert got.outcomes.shape == steps.outcomes.shape
    assert same_bits(got.next_states, steps.next_states)
    assert got.next_states.shape == steps.next_states.shape
    for name in ("durations", "step_lengths", "energies"):
        assert same_bits(getattr(got, name), getattr(steps, name))
        assert getattr(got, name).shape == getattr(steps, name).shape
    assert (got.seconds, got.integrator_steps, got.evaluations) == (0.25, 17, 119)


def answer(**changes):
    """An answer to 2 states and 2 slopes, in which one step succeeded."""
    values = {"outcomes": [0, 1, 2, 3], "next_states": [0.5] * 10, "seconds": 0.1}
    return SimulateSteps.Response(success=True, **{**values, **changes})


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"outcomes": [0, 1, 2]}, "outcomes"),
        ({"outcomes": [0, 1, 2, 11]}, "outcomes"),
        ({"outcomes": [0, 1, 2, 0]}, "next_states"),
        ({"next_states": [0.5] * 9}, "next_states"),
        ({"next_states": [0.5] * 9 + [math.nan]}, "next_states"),
        ({"seconds": math.nan}, "seconds"),
        ({"seconds": -1.0}, "seconds"),
        ({"durations": [0.0]}, "durations"),
        ({"energies": [math.inf] * 4}, "energies"),
    ],
)
def test_answers_that_cannot_be_are_named(changes, field):
    messages.steps_from(answer(), 2, 2)
    with pytest.raises(InputError) as caught:
        messages.steps_from(answer(**changes), 2, 2)
    assert caught.value.field == field


# Assembly of a mesh from its messages.

STATES = 60_000
"""More than one message of each kind holds."""


@pytest.fixture(scope="module")
def mesh():
    rng = np.random.default_rng(1)
    slopes = slope_set(5.0)
    m = len(slopes)
    outcomes = rng.integers(0, 3, (STATES, m)).astype(np.uint8)
    targets = rng.integers(1, STATES, (STATES, m)).astype(np.uint32)
    targets[outcomes != 0] = 0
    targets[0], outcomes[0] = 0, NOT_SIMULATED
    states = rng.normal(size=(STATES, 10))
    states[0] = 0.0
    preceding = rng.integers(0, m, STATES).astype(np.uint32)
    preceding[0] = 0
    generation = np.r_[0, 0, np.sort(rng.integers(1, 5, STATES - 2))].astype(np.uint32)
    scales = rng.uniform(1.0, 2.0, 10)
    scales[3] = np.inf
    return Mesh(slopes, states, preceding, generation, targets, outcomes, scales, 0.3, False)


def info(mesh, status, sequence, **changes):
    values = {
        "mesh_id": "m",
        "sequence": sequence,
        "status": status,
        "settings": messages.settings_message(settings(slopes=mesh.slopes)),
        "step_map": "s",
        "states": STATES if status == MeshInfo.COMPLETE else 1,
        "scales": messages.packed(mesh.scales if status == MeshInfo.COMPLETE else [], "d"),
    }
    return MeshInfo(**{**values, **changes})


def published(mesh):
    """All messages of a mesh by topic, as they come out at the other end."""
    infos = [info(mesh, MeshInfo.GROWING, 4), info(mesh, MeshInfo.COMPLETE, 5)]
    states = []
    for generation in range(5):
        of = np.flatnonzero(mesh.generation == generation)
        of = of[of > 0]
        states += messages.states_messages(
            "m", generation, int(of[0]), mesh.states[of], mesh.preceding[of]
        )
    transitions = [*messages.transitions_messages("m", mesh.targets, mesh.outcomes)]
    for counted in (states, transitions):
        for sequence, message in enumerate(counted):
            message.sequence = sequence + 7
    return tuple([sent(message) for message in topic] for topic in (infos, states, transitions))


ADD = (MeshAssembly.add_info, MeshAssembly.add_states, MeshAssembly.add_transitions)


def test_published_messages_are_about_a_megabyte(mesh):
    _, states, transitions = published(mesh)
    assert len(states) > 5
    assert len(transitions) > 2
    for message in states + transitions:
        assert len(serialize_message(message)) < messages.MESSAGE_BYTES + 1000


@PATIENT
@given(st.randoms(use_true_random=False), st.booleans())
def test_mesh_is_assembled_in_whichever_order_its_messages_come(assembly_cases, random, in_order):
    # A late subscriber may even get the new messages of a topic before those kept for it.
    mesh, topics = assembly_cases
    queues = [list(topic) for topic in topics]
    if not in_order:
        for queue in queues:
            random.shuffle(queue)
    assembly = MeshAssembly("m")
    while any(queues):
        # The info that opens a mesh says nothing that the one that closes it does not.
        assert not assembly.complete or not any(queues[1:])
        kind = random.choice([k for k in range(3) if queues[k]])
        ADD[kind](assembly, queues[kind].pop(0))
    assert (assembly.missing, assembly.status) == ("", MeshInfo.COMPLETE)
    got = assembly.mesh()
    for name in ("slopes", "states", "preceding", "generation", "targets", "outcomes", "scales"):
        assert same_bits(getattr(got, name), getattr(mesh, name)), name
    assert (got.threshold, got.clustered) == (mesh.threshold, mesh.clustered)


@pytest.fixture(scope="module")
def assembly_cases(mesh):
    return mesh, published(mesh)


@pytest.mark.parametrize(("kind", "lost"), [(1, 0), (1, 2), (2, 0), (2, 1), (1, -1), (2, -1)])
def test_a_lost_message_makes_the_mesh_unusable(assembly_cases, kind, lost):
    _, topics = assembly_cases
    topics = [list(topic) for topic in topics]
    del topics[kind][lost]
    assembly = MeshAssembly("m")
    for add, topic in zip(ADD, topics, strict=True):
        for message in topic:
            add(assembly, message)
    assert not assembly.complete
    assert not assembly.problem  # it may come yet
    assert f"of {STATES} states" in assembly.missing
    # Nothing follows the last message of a topic: no gap.
    gap = f"{('', 'mesh/states', 'mesh/transitions')[kind]}: from index"
    assert (gap in assembly.missing) == (lost != -1)
    with pytest.raises(IncompleteMesh, match="mesh m cannot be used"):
        assembly.mesh()


def test_a_message_that_comes_again_is_noticed(assembly_cases):
    _, (infos, states, _) = assembly_cases
    assembly = MeshAssembly("m")
    assembly.add_info(infos[0])
    assembly.add_states(states[0])
    assembly.add_states(states[0])
    assert "came twice" in assembly.problem


def test_a_mesh_that_was_handed_out_stays_as_it_is(assembly_cases):
    mesh, topics = assembly_cases
    assembly = MeshAssembly("m")
    for add, topic in zip(ADD, topics, strict=True):
        for message in topic:
            add(assembly, message)
    got = assembly.mesh()
    more = sent(topics[1][-1])
    more.first_index = STATES
    assembly.add_states(more)
    assert assembly.mesh() is got
    assert same_bits(got.states, mesh.states)


def test_messages_that_overlap_are_noticed(assembly_cases):
    _, (infos, states, _) = assembly_cases
    assembly = MeshAssembly("m")
    assembly.add_info(infos[0])
    early = sent(states[2])
    early.first_index -= 1
    assembly.add_states(early)
    assembly.add_states(states[0])
    assert not assembly.problem
    assembly.add_states(states[1])
    assert "came twice" in assembly.problem


def test_failed_and_cancelled_meshes_say_so(mesh):
    for status, word in ((MeshInfo.FAILED, "failed"), (MeshInfo.CANCELLED, "cancelled")):
        assembly = MeshAssembly("m")
        assembly.add_info(info(mesh, MeshInfo.GROWING, 0))
        assembly.add_info(info(mesh, status, 1, message="why"))
        assert word in assembly.missing
        assert "why" in assembly.missing


@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        (1, {"states": [0.0] * 9}),
        (1, {"first_index": 0}),
        (2, {"targets": [0] * 10}),
        (2, {"first_index": 0}),
    ],
)
def test_parts_that_do_not_fit_are_told(mesh, assembly_cases, kind, changes):
    _, topics = assembly_cases
    bad = sent(topics[kind][0])
    for name, value in changes.items():
        setattr(bad, name, value)
    assembly = MeshAssembly("m")
    assembly.add_info(topics[0][0])
    ADD[kind](assembly, bad)
    assert assembly.problem.startswith(("", "mesh/states", "mesh/transitions")[kind])


def test_transitions_that_cannot_be_are_told(assembly_cases):
    _, topics = assembly_cases
    infos, states, transitions = ([sent(message) for message in topic] for topic in topics)
    transitions[0].targets[0] = STATES  # beyond the last state
    assembly = MeshAssembly("m")
    for add, topic in zip(ADD, (infos, states, transitions), strict=True):
        for message in topic:
            add(assembly, message)
    with pytest.raises(IncompleteMesh, match="targets"):
        assembly.mesh()


def test_assembly_takes_the_objects_of_a_bag_reader(mesh, assembly_cases):
    _, topics = assembly_cases

    def as_read(message):
        """Arrays as numpy arrays, which is what rosbags makes of them."""
        values = {name: getattr(message, name) for name in message.get_fields_and_field_types()}
        for name, value in values.items():
            if hasattr(value, "typecode"):
                values[name] = np.array(value, dtype=value.typecode)
        return SimpleNamespace(**values)

    assembly = MeshAssembly("m")
    for add, topic in zip(ADD, topics, strict=True):
        for message in topic:
            add(assembly, as_read(message))
    assert same_bits(assembly.mesh().states, mesh.states)
