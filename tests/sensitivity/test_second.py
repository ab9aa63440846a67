"""Second derivatives in x0, the end time, and parameters of A, f and h: the gradient differentiated
once more agrees with forward mode twice, which has no reverse pass, over generators × methods."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax
from dvax import generators

N = 6
RNG = np.random.default_rng(5)
MATRIX = 0.3 * RNG.normal(size=(N, N)) - 2.0 * np.eye(N)
GENERATORS = {
    "Scalar": lambda p: generators.Scalar(-p["a"]),
    "Diagonal": lambda p: generators.Diagonal(-p["a"] * jnp.linspace(0.5, 4.0, N)),
    "Dense": lambda p: generators.Dense(p["a"] * jnp.asarray(MATRIX)),
    "heat": lambda p: generators.Elliptic(N, 1.0, "dirichlet", diffusion=0.1 * p["a"]),
    "waves": lambda p: generators.Elliptic(N, 1.0, "periodic", 0.05, velocity=0.3 * p["a"]),
    "Rotation": lambda p: generators.Rotation(-0.1 * p["a"] * jnp.ones(N), jnp.linspace(1, 3, N)),
}
METHODS = {
    "ETD1": dvax.ETD1(), "ETD2RK": dvax.ETD2RK(), "ETD4RK": dvax.ETD4RK(),
    "ExpRosenbrock": dvax.ExpRosenbrock(), "DormandPrince": dvax.DormandPrince(),
}  # fmt: skip
# The first size is given: the error of the tiny step that dvax would begin with is roundoff, which
# differs between the two modes, and with it the steps that follow.
STEPS = {
    "adaptive": dict(rtol=1e-5, atol=1e-5, dt0=1e-3, max_steps=2**12),
    "adaptive, of the first order": dict(rtol=3e-3, atol=3e-3, dt0=1e-3, max_steps=2**12),
    "fixed": dict(dt=1 / 20, max_steps=64),
}
# Each method and each generator has adaptive steps once.
CASES = [
    *itertools.product(GENERATORS, METHODS, ["fixed"]),
    *zip(GENERATORS, [*METHODS, "ETD2RK"], ["adaptive, of the first order"] + 5 * ["adaptive"]),
]
FIRST = ("ETD1", "adaptive, of the first order")
OFTEN = {("heat", "ETD2RK", "fixed")}


@pytest.mark.slow
@pytest.mark.parametrize(("made", "method", "steps"), mostly_thorough(CASES, OFTEN))
def test_hessian_by_forward_over_reverse_equals_forward_over_forward(made, method, steps, uncached):
    pair = made == "Rotation"

    def f(t, x, u, p):
        if pair:
            return p["b"] * jnp.sin(2 * x[0]) * jnp.cos(3 * t) + u[1], 0.3 * u[0] * x[1]
        return p["b"] * jnp.sin(2 * x) * jnp.cos(3 * t) + u

    def h(t, x, u, p):
        own = lambda x, u: p["g"] * jnp.cos(p["b"] * t) * x**2 - u  # noqa: E731
        return jax.tree_util.tree_map(own, x, u)

    box = dvax.sets.Box(-9.0, 9.0)
    K = dvax.sets.Product(box, box) if pair else box
    problem = dvax.Problem(A=GENERATORS[made], P=dvax.operators.Scaling(1.0), K=K, f=f, h=h)

    def asked(given, adjoint):
        t1, scale, args = given
        start = scale * jnp.linspace(0.2, 1.0, N)
        found = dvax.solve(
            problem, (start, -start) if pair else start, 0.0, t1, args,
            method=METHODS[method], adjoint=adjoint, **STEPS[steps],
        )  # fmt: skip
        weights = jnp.linspace(-1.0, 2.0, N)
        return sum(jnp.sum(weights * x[-1] ** 2) for x in jax.tree_util.tree_leaves(found.xs))

    args = {"a": jnp.array(0.7), "b": jnp.array(0.9), "g": jnp.array(0.4)}
    given = jnp.array(1.3), jnp.array(1.0), args
    backward = jax.jit(jax.jacfwd(jax.jacrev(lambda g: asked(g, "reverse"))))(given)
    forward = jax.jit(jax.jacfwd(jax.jacfwd(lambda g: asked(g, "forward"))))(given)
    ours, theirs = (
        np.array(jax.tree_util.tree_leaves(tree)).reshape(5, 5) for tree in (backward, forward)
    )
    size = np.max(abs(theirs))
    # Both see the same steps.
    np.testing.assert_allclose(ours[1:, 1:], theirs[1:, 1:], rtol=0.0, atol=1e-9 * size)
    # Backwards, the last of adaptive steps moves with the end, which loses two orders there: ETD1
    # has nothing left; forwards, the state moves by x'.
    tol = 1e-9 if steps == "fixed" else 2e-2
    known = slice(1, None) if (method, steps) == FIRST else slice(None)
    np.testing.assert_allclose(ours[0][known], theirs[0][known], rtol=0.0, atol=tol * size)
    np.testing.assert_allclose(ours[:, 0][known], theirs[:, 0][known], rtol=0.0, atol=tol * size)
