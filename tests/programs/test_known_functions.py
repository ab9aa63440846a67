"""Functions of JAX are recognised in whatever context they were traced first."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

import dvax
from dvax._jax.known_functions import VARIANTS, _programs, operation

SCRIPT = """
import jax, jax.numpy as jnp
import dvax
jax.config.update("jax_enable_x64", True)
times = jnp.linspace(0.0, 10.0, 11)
problem = dvax.Problem(
    A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-5.0, 5.0),
    control_space=dvax.spaces.Euclidean(()),
    f=lambda t, x, u, args: jnp.stack([x[1], jnp.interp(t, times, args) - u]),
    h=lambda t, x, u, args: x[1],
)
values, x0 = jnp.zeros(11).at[2].set(1.0), jnp.zeros(2)
if {first}:
    problem.knots(0.0, 10.0, x0, values)
sol = dvax.solve(problem, x0, 0.0, 10.0, values, method=dvax.{method}())
print(int(sol.stats["steps"]), problem.knots(0.0, 10.0, x0, values).tolist())
"""


@pytest.mark.slow
@pytest.mark.parametrize("method", ["DormandPrince"])
def test_the_knots_of_a_table_do_not_depend_on_what_was_traced_first(method):
    found = {
        subprocess.run(
            [sys.executable, "-c", SCRIPT.format(first=first, method=method)],
            capture_output=True, text=True, check=True,
        ).stdout
        for first in (True, False)
    }  # fmt: skip
    assert len(found) == 1 and found.pop().endswith(f"{[float(k) for k in range(1, 10)]}\n")


def test_another_function_of_the_same_name_is_not_recognised():
    times = jnp.linspace(0.0, 1.0, 5)

    def name_of(fn, *args):
        (eqn,) = jax.make_jaxpr(fn)(*args).jaxpr.eqns
        return operation(eqn)

    assert name_of(jnp.interp, 0.3, times, times) == "_interp"
    assert name_of(lambda t, *v: jnp.interp(t, *v, left=0.0), 0.3, times, times) != "_interp"
    assert name_of(lambda t, *v: jnp.interp(t, *v, period=2.0), 0.3, times, times) != "_interp"
    weights = jnp.arange(3.0)
    plain, weighted = (lambda x: jnp.linalg.norm(x)), (lambda x: jnp.sqrt(jnp.sum(x * weights)))
    assert name_of(plain, weights) == "norm"
    weighted.__name__ = "norm"
    assert name_of(jax.jit(weighted), weights) not in VARIANTS


CALLS = {
    "hypot": lambda x: jnp.hypot(x, 1.0),
    "_interp": lambda x: jnp.interp(x, jnp.array([-1.0, 0.0, 2.0]), jnp.array([1.0, 0.0, 2.0])),
    "logaddexp": lambda x: jnp.logaddexp(x, 0.0),
    "norm": lambda x: jnp.linalg.norm(x) * jnp.ones(2),
}


@pytest.mark.parametrize("name", CALLS)
def test_constants_of_a_known_function_are_sharp_where_the_input_was_checked_first(name):
    """The check of indices, which every call begins with, must not change what is recognised."""
    _programs.cache_clear()
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        f=lambda t, x, u, args: CALLS[name](x) + u, h=lambda t, x, u, args: -x,
    )  # fmt: skip
    found = dvax.verify(problem, jnp.array([0.3, 0.2]), 0.0, 1.0, x=(-3.0, 3.0))
    assert found["ass:f_lipschitz"].status == "proved"
    # The norm depends on both entries.
    assert found.constants.alpha_f <= (1.0 if name != "norm" else 2.0) + 1e-12
