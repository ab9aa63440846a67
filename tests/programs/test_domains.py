"""The tables of rules: documented, for existing operations, and independent of one JAX interface."""

import subprocess
import sys

import jax.extend.core.primitives as primitives
import pytest
from tests.programs.primitive_table import parts, table

from dvax._jax.known_functions import VARIANTS
from dvax.programs import DOMAINS

ELSEWHERE = {
    # Operations that JAX does not list there, and those of releases other than this one.
    "bcoo_dot_general", "copy_p", "custom_vjp_call_jaxpr", "expand_dims", "optimization_barrier",
    "scatter_add", "scatter_mul", "split", "stack", "tile", "unstack", *VARIANTS,
}  # fmt: skip


def test_documentation_table_lists_the_rules_of_every_domain():
    assert parts()[1] == table(), "run: python -m tests.programs.primitive_table"


def test_every_rule_belongs_to_an_existing_operation():
    exist = {getattr(p, "name", None) for p in vars(primitives).values()} | ELSEWHERE
    for domain, rules in DOMAINS.items():
        wrong = {name for name in rules if not name.startswith("dvax_")} - exist
        assert not wrong, (domain, wrong)


WITHOUT = """
import sys
sys.modules["jax.extend.core"] = None
import jax, jax.numpy as jnp
from dvax._jax import jaxprs
program = jax.make_jaxpr(lambda v: jax.jit(lambda w: w + 2.0)(v))(1.0)
assert isinstance(program, jaxprs.ClosedJaxpr) and isinstance(program.jaxpr, jaxprs.Jaxpr)
inner = jaxprs.inner_program(program.jaxpr.eqns[0])
variable, literal = inner.jaxpr.eqns[0].invars
assert isinstance(literal, jaxprs.Literal) and not isinstance(variable, jaxprs.Literal)
assert jaxprs.read({variable: 3.0}, [variable, literal]) == [3.0, 2.0]
"""


@pytest.mark.thorough
def test_interpreter_works_without_exported_jaxpr_types():
    done = subprocess.run([sys.executable, "-c", WITHOUT], capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
