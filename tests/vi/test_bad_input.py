"""Wrong arguments of `dvax.solve_vi` are an `InputError`, and an unsolved law has no response."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.refusals import answers_of, is_a_good_refusal, names_and_words
from tests.vi import bad_input

import dvax
from dvax import sets

NAMES = names_and_words(bad_input)


@pytest.fixture(scope="module")
def answers():
    return answers_of(bad_input)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "words"), NAMES, ids=[name for name, _ in NAMES])
def test_solve_vi_rejects_wrong_arguments_in_one_line(answers, name, words):
    is_a_good_refusal(answers[name], words)
    message = answers[name][1]
    assert len(message.splitlines()) == 1 and "Traceback" not in message


def test_solve_vi_accepts_traced_moduli_and_mixed_types():
    """A traced invalid γ gives an infinite bound; parts of a tuple may differ in type."""
    K, F = sets.Box(0.0, 1.0), bad_input.F3
    bound = jax.jit(lambda gamma: dvax.solve_vi(F, K, jnp.zeros(2), gamma=gamma).error_bound)
    assert np.isinf(bound(jnp.asarray(-1.0))) and float(bound(jnp.asarray(1.0))) < 1e-10
    # Of a γ so large the quotient underflows, and the bound is not 0 for that.
    assert 0 < float(bound(jnp.asarray(1e300))) < 1e-299
    # Parts of a tuple may be of several types, and F may be a number for a number.
    pair = jnp.zeros(2), jnp.zeros(3, jnp.float32)
    with jax.numpy_dtype_promotion("standard"):
        vi = dvax.solve_vi(lambda y, _: (y[0] - 0.5, y[1] - 0.25), sets.Product(K, K), pair)
    assert [part.dtype for part in vi.y] == [jnp.float64, jnp.float32]
    assert float(dvax.solve_vi(lambda y, _: -1.0, K, jnp.zeros(())).y) == 1.0


ROTATION = bad_input.cyclic()
FEW = dvax.vi.Projection(5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["response", "reduced"])
def test_response_of_an_unsolved_law_raises_solve_error(name):
    x = jnp.zeros(2)
    with pytest.raises(dvax.SolveError, match=r"Projection: the largest number of iterations"):
        getattr(ROTATION, name)(0.0, x, solver=FEW)
    right = np.array([1.0, -1.0]) if name == "response" else np.array([-1.0, 1.0])
    np.testing.assert_allclose(getattr(ROTATION, name)(0.0, x), right, atol=1e-9)


@pytest.mark.slow
def test_response_of_an_unsolved_law_is_nan_under_transformations():
    R = jnp.array([[0.0, 1.0], [-1.0, 0.0]])
    law = bad_input.cyclic(h=lambda t, x, u, args: u - args * (R @ u - x))
    few = lambda a: jnp.sum(law.reduced(0.0, jnp.ones(2), a - 1.0, solver=FEW))  # noqa: E731
    assert np.isnan(jax.jit(few)(3.0))
    assert np.isnan(jax.jit(jax.grad(few))(3.0))
    many = jax.jit(jax.vmap(lambda x: ROTATION.response(0.0, x, solver=FEW)))
    assert np.isnan(many(jnp.zeros((2, 2)))).all()
    good = jax.jit(lambda x: ROTATION.response(0.0, x))
    np.testing.assert_allclose(good(jnp.zeros(2)), [1.0, -1.0], atol=1e-9)


def test_response_in_single_precision_is_solved():
    M = jnp.array([[2.0, -1.0], [1.0, 2.0]], jnp.float32)
    problem = bad_input.cyclic(
        P=dvax.operators.Scaling(jnp.float32(1.0)), K=sets.Box(jnp.float32(-5e3), jnp.float32(5e3)),
        h=lambda t, x, u, args: u - M @ u - 100.0 * jnp.tanh(u) + x,
    )  # fmt: skip
    x = jnp.array([300.0, 1e4], jnp.float32)
    solution = np.asarray(problem.response(0.0, x))
    F = np.asarray(M) @ solution + 100.0 * np.tanh(solution) - np.asarray(x)
    assert np.abs(F).max() < 1e-6 * 1e4
