"""Data of a wrong kind, shape or type are rejected where they are given; valid data are accepted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests import bad_data
from tests.refusals import answers_of, is_a_good_refusal, names_and_words

from dvax import generators, operators, sets, signals, spaces

NAMES = names_and_words(bad_data)


@pytest.fixture(scope="module")
def answers():
    return answers_of(bad_data)


@pytest.mark.parametrize(("name", "words"), NAMES, ids=[name for name, _ in NAMES])
def test_bad_data_is_an_input_error_on_one_line_with_place_and_fix(answers, name, words):
    is_a_good_refusal(answers[name], words)
    message = answers[name][1]
    assert "\n" not in message and len(message) < 700, message
    assert "asarray(dvax" not in message, "the fix is code of the caller"


def test_none_in_data_is_not_reported_as_args(answers):
    assert "args=" not in answers["solve: None from elsewhere"][1]


@pytest.mark.parametrize("size", [np.int64(4), np.int32(4), (np.int64(4),), [4]])
def test_numpy_integers_are_accepted_as_sizes(size):
    assert spaces.Euclidean(size).zeros().shape == (4,)
    assert generators.Elliptic(size).transform.shape == (4,)
    assert operators.Convolution(jnp.ones(3), size).shape == (4,)


@pytest.mark.parametrize(
    ("knots", "times"),
    [
        (0.5, [0.5]),
        (1, [1.0]),
        ([2, 1], [1.0, 2.0]),
        ((), []),
        ([], []),
        (np.arange(2), [0.0, 1.0]),
    ],
)
def test_knots_accept_a_time_or_a_list_of_times(knots, times):
    assert signals.Function(jnp.sin, knots).knots().tolist() == times


@pytest.mark.parametrize(
    ("make", "value"),
    [
        (lambda: sets.Box([0, 1], 2).lower, [0.0, 1.0]),
        (lambda: sets.Box(-np.inf, np.inf).upper, np.inf),
        (lambda: sets.Box([0.0, 2**70], 2.0**80).lower, [0.0, 2.0**70]),
        (lambda: sets.Ball((jnp.zeros(2), 1.0), 1.0).center[1], 1.0),
        (lambda: sets.HalfSpace((jnp.ones(2), 1.0), 1.0).normal[1], 1.0),
        (lambda: operators.Dense([[2, 0], [0, 1]]).matrix, [[2.0, 0.0], [0.0, 1.0]]),
        (lambda: operators.Dense([[1.0, 2.0], [1.0, 3.0]]).matrix[1], [1.0, 3.0]),  # for weights
        (lambda: generators.Dense(-np.eye(2), omega=1).omega, 1.0),
        (lambda: generators.Elliptic((2, 2), lengths=(1, 2)).symbol.shape, (2, 2)),
        (lambda: jax.jit(lambda a: sets.Box([a, 0.0], [1.0, a + 1.0]).lower)(0.5), [0.5, 0.0]),
        (lambda: jax.vmap(lambda b: operators.Scaling(b).inverse_b)(jnp.array([1.0, 2.0])), [1, 0.5]),
        (lambda: jax.grad(lambda p: operators.Dense([[p]]).inverse(jnp.ones(1))[0])(2.0), -0.25),
    ],
)  # fmt: skip
def test_valid_data_are_accepted(make, value):
    np.testing.assert_allclose(make(), value)
