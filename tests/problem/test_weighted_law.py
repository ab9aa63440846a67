"""A weighted law (paper, remark:assstrong (ii)) in a coupled system equals that without weight."""

import jax.numpy as jnp
import numpy as np
import pytest

import dvax

P = dvax.operators.Scaling(2.0)


def coupled(weight):
    """h = u − a(Pu) (Pu − 0.2 + x): the drive that depends on x stands inside the bracket."""

    def h(t, x, u, args):
        y = P.apply(u)
        return u - weight(y) * (y - 0.2 + x)

    return dvax.Problem(
        A=dvax.generators.Scalar(-0.5),
        P=P,
        K=dvax.sets.Box(0.0, 3 * np.pi / 2),
        f=lambda t, x, u, args: 3.0 * jnp.sin(4.0 * t) - 2.0 * u,
        h=h,
    )


WHOLE, DIVIDED = coupled(lambda y: 2.0 + jnp.sin(y)), coupled(lambda y: 1.0)


@pytest.mark.parametrize("x", [-6.0, -4.0, -1.5, 0.1, 2.5])
def test_weighted_law_has_the_response_of_the_law_without_weight(x):
    exact = np.clip(0.2 - x, 0.0, 3 * np.pi / 2) / 2.0
    for problem in (WHOLE, DIVIDED):
        assert float(problem.response(0.0, x)) == pytest.approx(exact, abs=1e-10)


@pytest.mark.thorough
def test_weighted_law_has_the_trajectory_of_the_law_without_weight():
    ts = jnp.linspace(0.0, 3.0, 13)
    whole, divided = (
        dvax.solve(problem, 1.0, 0.0, 3.0, ts=ts, rtol=1e-6, atol=1e-6)
        for problem in (WHOLE, DIVIDED)
    )
    held = (np.asarray(divided.ys) == 0).sum()
    assert 0 < held < 13  # both regimes are met
    np.testing.assert_allclose(np.asarray(whole.xs), np.asarray(divided.xs), atol=1e-6)
    np.testing.assert_allclose(np.asarray(whole.us), np.asarray(divided.us), atol=1e-6)
