"""The measured defect against its integral by quadrature along the dense output."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax

CLASSES = (dvax.ETD1, dvax.ETD2RK, dvax.ETD4RK, dvax.ExpRosenbrock, dvax.DormandPrince)
METHODS = {kind.__name__: kind() for kind in CLASSES}
NODES, WEIGHTS = np.polynomial.legendre.leggauss(24)


def rates(t, x, u, p):
    return jnp.stack([x[1], -p["s"] * jnp.sin(x[0])]) + p["a"] * jnp.cos(p["w"] * t) + 0.3 * u


PROBLEM = dvax.Problem(
    A=dvax.generators.Scalar(-0.4), P=dvax.operators.Scaling(1.0), K=dvax.sets.WholeSpace(),
    f=rates, h=lambda t, x, u, p: jnp.tanh(x) - 0.5 * u,
)  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize("name", mostly_thorough(METHODS, ["ETD2RK"]))
def test_sampled_defect_of_smooth_systems_has_the_size_of_its_integral(name):
    """For random smooth systems in 20 to 200 steps, the samples do not miss the defect."""
    rng = np.random.default_rng(5)
    method = METHODS[name]
    flow = None
    for _ in range(4):
        p = {"s": rng.uniform(0.2, 3.0), "w": rng.uniform(0.5, 4.0), "a": rng.uniform(-1, 1, 2)}
        steps = int(rng.integers(20, 200))
        x0 = rng.uniform(-2.0, 2.0, 2)
        sol = dvax.solve(
            PROBLEM, x0, 0.0, 4.0, p, dt=4.0 / steps, method=method, dense=True, measure=True,
            max_steps=200,
        )  # fmt: skip
        flow = sol.flow

        def size(t, flow=flow, sol=sol):
            x, x_dot = jax.jvp(lambda s: sol.evaluate(s)[0], (t,), (jnp.ones_like(t),))
            return jnp.linalg.norm(x_dot - flow.generator.apply(x) - flow.rate(t, x, None).value)

        h = 4.0 / steps
        inner = (np.arange(steps)[:, None] + 0.5 * (1.0 + NODES)) * h
        sizes = np.asarray(jax.jit(jax.vmap(size))(jnp.asarray(inner.ravel())))
        integral = float(np.sum(0.5 * h * WEIGHTS * sizes.reshape(steps, -1)))
        assert 0.8 * integral <= float(sol.defect[-1]) <= 7.0 * integral


def bent(t, x, u, p):
    """The right-hand side whose x₁ is the time, with a kink or a jump in x₁: no step ends there."""
    past = x[0] - p["at"]
    kink = p["slope"] * jnp.maximum(past, 0) + p["jump"] * jnp.heaviside(past, 0.0)
    return jnp.stack([jnp.ones_like(past), kink])


CLOCK = dvax.Problem(
    A=dvax.generators.Scalar(0.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.WholeSpace(), f=bent,
    h=lambda t, x, u, p: 0.0 * x,
)  # fmt: skip


@pytest.mark.parametrize("name", mostly_thorough(METHODS, ["ExpRosenbrock"]))
def test_sampled_defect_covers_a_kink_or_a_jump_within_a_step(name):
    """For one step over it, the charge covers the integral of the defect."""
    places = (jnp.arange(2000.0) + 0.5) / 2000

    @jax.jit
    def step(p):
        sol = dvax.solve(
            CLOCK, jnp.zeros(2), 0.0, 1.0, p, dt=1.0, method=METHODS[name], dense=True, measure=True,
            max_steps=2,
        )  # fmt: skip

        def size(t):
            _, x_dot = jax.jvp(lambda s: sol.evaluate(s)[0], (t,), (jnp.ones_like(t),))
            return jnp.abs(x_dot - CLOCK.f(t, jnp.stack([t, t]), None, p))[1]

        # Exact up to the panel with the kink.
        return sol.defect[-1], jnp.mean(jax.vmap(size)(places))

    for at in np.random.default_rng(2).uniform(0.0, 1.0, 60):
        for slope, jump in ((1.0, 0.0), (0.0, 1.0)):
            defect, integral = step({"at": at, "slope": slope, "jump": jump})
            assert integral > 0.0 and float(integral) <= float(defect) + 1e-3
