"""Walker models as plain values, and the files of an own robot and controller."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

from biped_mfpt_ros.cli import main
from biped_mfpt_ros.control.controller import SCHEMES, Controller, controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.models import model_from, model_values, robot_from, robot_from_file
from biped_mfpt_ros.walker.robot import WalkerModel, rabbit

RABBIT = dataclasses.asdict(rabbit())
HEAVY = dataclasses.replace(rabbit(), tibia_mass=3.6)


def test_values_give_the_same_model_back():
    for model in (WalkerModel(friction=0.7), WalkerModel(robot=HEAVY)):
        assert model_from(json.loads(json.dumps(model_values(model)))) == model
    # A study of RABBIT that was begun before there were other robots goes on.
    assert "robot" not in model_values(WalkerModel())


BAD_VALUES = [
    ("torso_mass", -1.0),
    ("gravity", float("nan")),
    ("femur_inertia", 0),
    ("tibia_com", float("inf")),
    ("femur_length", "0.4"),
    ("femur_length", True),
    ("femur_length", 10**400),
    ("tibia_length", None),
]


@pytest.mark.parametrize(("field", "value"), BAD_VALUES)
def test_a_robot_of_bad_values_cannot_be_made(field, value):
    low = "-1e+06" if field == "tibia_com" else "1e-06"
    with pytest.raises(InputError) as error:
        dataclasses.replace(rabbit(), **{field: value})
    assert error.value.field == field
    assert error.value.value is value
    assert error.value.allowed == f"a number from {low} to 1e+06"


def test_a_number_of_numpy_is_shown_as_a_plain_one():
    with pytest.raises(InputError, match=r"^friction: -0\.5 is not allowed"):
        WalkerModel(friction=np.float64(-0.5))


def test_the_values_of_a_robot_are_floats():
    made = dataclasses.replace(rabbit(), torso_mass=12, torso_com=-1)
    assert all(type(value) is float for value in dataclasses.astuple(made))


@pytest.mark.parametrize("field", ["torque_limit", "friction", "time_limit", "tolerance"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), "1", True, None])
def test_a_model_of_bad_values_cannot_be_made(field, value):
    with pytest.raises(InputError, match=f"^{field}: "):
        WalkerModel(**{field: value})


@pytest.mark.parametrize(
    ("values", "field"),
    [
        *((RABBIT | {field: value}, field) for field, value in BAD_VALUES),
        (RABBIT | {"arm_mass": 1.0}, "arm_mass"),
        ({k: v for k, v in RABBIT.items() if k != "gravity"}, "gravity"),
    ],
)
def test_a_bad_robot_is_refused_by_the_name_of_its_value(values, field):
    with pytest.raises(InputError) as error:
        robot_from(values)
    assert error.value.field == f"robot.{field}"


@pytest.mark.parametrize("text", ["", "[]", "3", '{"torso_mass": ', "[" * 100000, "\xff"])
def test_a_file_that_holds_no_robot_is_refused(tmp_path, text):
    path = tmp_path / "robot.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError):
        robot_from_file(path)


def test_own_robot_and_controller_walk_as_they_do_in_the_library(tmp_path, capsys):
    robot, mine = tmp_path / "heavy.json", tmp_path / "mine.json"
    robot.write_text(json.dumps(dataclasses.asdict(HEAVY)))
    assert main(["controllers", "hzd/mfpt"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert tuple(data["parameters"]) == SCHEMES["hzd"].parameters
    data["parameters"]["kp"] = 200.0
    mine.write_text(json.dumps(data))
    command = ["cycle", "--robot-file", str(robot), "--controller-file", str(mine), "--json"]
    assert main(command) == 0
    found = json.loads(capsys.readouterr().out)
    parameters = controller("hzd/mfpt").parameters.copy()
    parameters[0] = 200.0
    own = dataclasses.replace(controller("hzd/mfpt"), parameters=parameters)
    wanted = find_limit_cycle(own, 0.0, WalkerModel(robot=HEAVY))
    assert found["state"] == wanted.state.tolist()
    assert found["controller"] == "mine on heavy"
    assert found["model"]["robot"] == dataclasses.asdict(HEAVY)
    # Another robot walks otherwise.
    rabbits = find_limit_cycle(own, 0.0, WalkerModel()).state
    assert not np.allclose(rabbits, wanted.state, atol=1e-3)


def test_a_gait_of_the_catalogue_is_made_hybrid_invariant_for_another_robot(tmp_path, capsys):
    """Then its cycle on the flat does not depend on the gains: there is nothing to correct."""
    robot = tmp_path / "heavy.json"
    robot.write_text(json.dumps(dataclasses.asdict(HEAVY)))

    def moves(*options):
        """How far the cycle's state moves with twice the stiffness, rad and rad/s."""
        assert main(["controllers", "hzd/mfpt", *options]) == 0
        data = json.loads(capsys.readouterr().out)
        states = []
        for factor in (1.0, 2.0):
            parameters = np.array(list(data["parameters"].values()))
            parameters[0] *= factor
            walking = Controller("mine", "hzd", parameters)
            model = WalkerModel(robot=HEAVY, torque_limit=math.inf)
            states.append(find_limit_cycle(walking, 0.0, model).state)
        return np.abs(states[1] - states[0]).max()

    assert moves() > 1e-4
    # The residual of Newton's method, 1e-9, over one minus the second eigenvalue, some 0.5.
    assert moves("--robot-file", str(robot)) < 1e-8


def test_a_robot_is_for_a_controller_that_is_named(tmp_path, capsys):
    robot = tmp_path / "heavy.json"
    robot.write_text(json.dumps(dataclasses.asdict(HEAVY)))
    assert main(["controllers", "--robot-file", str(robot)]) == 2
    assert "NAME" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"parameters": {"kp": 1.0}}, "parameters.alpha_0^1"),
        ({"parameters": {}, "scheme": "pid"}, "scheme"),
        ({"parameters": [1.0]}, "length 1"),
    ],
)
def test_a_bad_controller_file_is_refused_with_the_field(tmp_path, capsys, change, said):
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({"name": "mine", "scheme": "hzd"} | change))
    assert main(["cycle", "--controller-file", str(path)]) == 2
    error = capsys.readouterr().err
    assert str(path) in error
    assert said in error


def test_a_run_takes_a_controller_of_any_name(tmp_path, capsys):
    path = tmp_path / "mine.json"
    parameters = controller("hzd/base").parameters.tolist()
    path.write_text(json.dumps({"name": "my gait!", "scheme": "hzd", "parameters": parameters}))
    # Refused for its threshold, which is checked after the names made of the controller's.
    assert main(["run", "--controller-file", str(path), "--threshold", "-1"]) == 2
    assert capsys.readouterr().err.startswith("biped-mfpt run: error: --threshold: -1.0")
