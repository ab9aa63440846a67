"""`Problem.response` compiles once for all values of t, x and args."""

import jax.numpy as jnp

import dvax
from dvax._jax.compile_clock import listen

_COUPLING = jnp.array([[2.0, 0.5], [-0.5, 1.0]])
_PROBLEM = dvax.Problem(
    A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Simplex(1.0),
    f=lambda t, x, u, args: u, h=lambda t, x, u, args: u - _COUPLING @ u - args["gain"] * x - t,
)  # fmt: skip


def test_a_second_response_compiles_nothing_and_uses_its_own_values() -> None:
    x, other = jnp.array([0.2, 0.1]), jnp.array([0.4, 0.2])
    compiled: list[str] = []
    listen(lambda stage, seconds: compiled.append(stage))
    first = _PROBLEM.response(0.0, x, {"gain": 1.0})
    assert "compile" in compiled
    compiled.clear()
    second = _PROBLEM.response(0.5, other, {"gain": 3.0})
    assert "compile" not in compiled
    # F₁ = F₂ means 2y₁ + ½y₂ + gain x₁ = −½y₁ + y₂ + gain x₂, and with y₂ = 1 − y₁ that is
    # 3y₁ = ½ + gain (x₂ − x₁); y₁ = 0 where that is negative.
    for u, shift in ((first, -0.1), (second, -0.6)):
        y1 = max((0.5 + shift) / 3.0, 0.0)
        assert jnp.allclose(u, jnp.array([y1, 1.0 - y1]), atol=1e-10)
