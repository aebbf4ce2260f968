"""Arrays that are none of numbers: an error that names the field, what was given, what may be."""

import numpy as np
import pytest

from biped_mfpt_ros.chain.markov import solve_chain
from biped_mfpt_ros.chain.mesh import NOT_SIMULATED, MeshGrowth
from biped_mfpt_ros.control.controller import Controller, controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.step import check_state, check_states, simulate_steps
from biped_mfpt_ros.optimise.searchers import make_searcher
from biped_mfpt_ros.optimise.space import SearchSpace
from biped_mfpt_ros.walker.robot import rabbit
from biped_mfpt_ros.walker.terrain import check_slopes

NOT_NUMBERS = [
    "abc",
    ["a", "b"],
    ["0.1", "0.2"],
    None,
    [None, 0.1],
    [[0.1], [0.1, 0.2]],
    [1j, 2.0],
    {},
    np.array(["2026-01-01"], dtype="datetime64[D]"),
]
BASE = controller("hzd/base")
SPACE = SearchSpace(BASE, rabbit())
TARGETS, OUTCOMES = [[0, 0], [1, 0]], [[NOT_SIMULATED] * 2, [0, 1]]
CHECKED = {
    "states": check_states,
    "previous_slopes": lambda v: simulate_steps(BASE, np.zeros((1, 10)), v, [0.0]),
    "parameters": lambda v: Controller("mine", "hzd", v),
    "state": check_state,
    "slopes": check_slopes,
    "initial_state": lambda v: MeshGrowth(v, [0.0], 0.1),
    "targets": lambda v: solve_chain(v, OUTCOMES, [0.5, 0.5]),
    "outcomes": lambda v: solve_chain(TARGETS, v, [0.5, 0.5]),
    "probabilities": lambda v: solve_chain(TARGETS, OUTCOMES, v),
    "vector": SPACE.controller,
    "candidates[0]": lambda v: make_searcher("given", np.zeros((2, 2)), candidates=[v]),
}


@pytest.mark.parametrize("field", CHECKED)
@pytest.mark.parametrize("value", NOT_NUMBERS, ids=repr)
def test_what_is_no_array_of_numbers_is_refused(field, value):
    with pytest.raises(InputError) as caught:
        CHECKED[field](value)
    assert caught.value.field == field
    assert caught.value.value is value
    assert "numbers" in caught.value.allowed


def test_a_vector_of_another_length_is_refused():
    with pytest.raises(InputError, match=r"vector: 'shape \(2,\)' is not allowed; allowed: \d+ nu"):
        SPACE.controller([0.1, 0.2])
