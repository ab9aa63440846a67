"""What samples of the defect show of a jump or a kink of f̃ anywhere inside a step.

Oracle: the integral of |p − f̃| of the stage polynomial p, by the trapezoidal rule on a fine grid."""

import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax.programs.branches import branches

METHODS = [dvax.ETD1(), dvax.ETD2RK(), dvax.ETD4RK(), dvax.DormandPrince()]
GRID = np.linspace(0.0, 1.0, 4001)

SHAPES = {
    "jump": lambda t, star: np.where(t > star, 1.0, 0.0),
    "kink": lambda t, star: np.maximum(t - star, 0.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("method", METHODS, ids=lambda m: type(m).__name__)
def test_the_bump_of_the_samples_bounds_a_jump_or_kink_at_any_place(method, shape):
    nodes = (0.0, *method.samples, 1.0)
    for star in np.linspace(0.0, 1.0, 402)[1:-1]:
        f = lambda t, star=star: SHAPES[shape](t, star)  # noqa: E731
        c = method.coefficients(
            lambda t, x, f=f: jnp.asarray(f(t)), lambda t, c: 0.0, jnp.asarray(f(0.0)), None
        )
        p = lambda t, c=c: sum(float(v) * t**j for j, v in enumerate(c))  # noqa: E731
        start, *inner, end = (f(t) - p(t) for t in nodes)
        bumps = [
            abs(d - (1 - t) * start - t * end) for t, d in zip(nodes[1:-1], inner, strict=True)
        ]
        shown = 0.5 * abs(start) + 0.5 * abs(end) + max(bumps)
        assert np.trapezoid(np.abs(p(GRID) - f(GRID)), GRID) <= 1.001 * method.safety * shown


JUMPS = {
    "square wave": (lambda t, x: jnp.where(t - jnp.floor(t) < 0.5, 1.0, 0.0) + x, 2.5),
    "saw": (lambda t, x: t - jnp.floor(t) + x, 2.0),
    "round": (lambda t, x: jnp.round(t) * x, 2.5),
    "remainder": (lambda t, x: jnp.remainder(t, 0.8) + x, 2.4),
    "of a sine": (lambda t, x: jnp.where(jnp.sin(t) > 0.0, x, 0.0), np.pi),
    "in the state": (lambda t, x: jnp.where(x > t, x, 0.0), 0.3),
}


@pytest.mark.parametrize("name", JUMPS)
def test_branches_change_a_sign_at_every_jump_of_the_code(name):
    fn, at = JUMPS[name]
    signs = [
        [bool(s > 0) for s in branches(lambda t, x, u: fn(t, x), t, jnp.asarray(0.3), ())]
        for t in (at - 1e-3, at + 1e-3)
    ]
    assert signs[0] != signs[1]
