"""A Python script that solves a contact law whose data are formulas."""

import ast
from typing import Any

from dvax.app.explore.subject import Values
from dvax.app.runs.contact_inputs import ContactInputs
from dvax.app.runs.expressions import CONSTANTS, FUNCTIONS
from dvax.app.runs.fields import Field
from dvax.app.runs.settings import Config


def script(config: Config, inputs: ContactInputs, values: Values) -> str | None:
    """Return the text of the script; None where measured data or a boundary from a file need more."""
    fields = (inputs.demand, inputs.load)
    if config.data_files() or len(inputs.boundary.names) > 1:
        return None
    keys = ("alpha", "beta", "b_x", "b_u", "d_x", "d_u", "kappa0")
    parameters = ", ".join(f"{key}={values[f'model.{key}']!r}" for key in keys)
    demand, load = (
        f"{values[key]!r} * {_formula(field)}"
        for key, field in zip(("demand.value", "load.value"), fields, strict=True)
    )
    knots = sorted({*inputs.demand.knots, *inputs.load.knots})
    start = _initial(config)
    u = config.units
    units = ", ".join((u.time, u.length, u.indentation, u.pressure))
    return f'''"""Written by dvax explore: the contact law in the units {units}."""

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np

import dvax

points, length, end = {inputs.boundary.size}, {config.boundary.length!r}, {config.time.end!r}
s = jnp.asarray((np.arange(points) + 0.5) * (length / points))
times = np.linspace(0.0, end, {config.time.frames + 1})


def demand(t):
    return {demand} * jnp.ones_like(s)


def load(t):
    return {load} * jnp.ones_like(s)


model = dvax.models.Contact(
    {parameters},
    g=dvax.signals.Function(demand, knots={knots!r}),
    ell=dvax.signals.Function(load, knots={knots!r}),
    weights=np.full(points, length / points),
)
problem = model.problem
solution = dvax.solve(
    problem, {start} * jnp.ones_like(s), 0.0, end, ts=times, constants=model.constants,
    measure=True, horizon=end, {_options(config)},
)
bound = dvax.bound_error(problem, solution, model.constants)
force = solution.ys @ np.full(points, length / points)
print("peak_pressure", float(solution.ys.max()))
print("final_force", float(force[-1]))
print("error_bound_x", float(bound.x_paper[-1]), bound.status)
'''


def _options(config: Config) -> str:
    keys = config.solver
    given = {
        name: repr(value)
        for name in ("rtol", "atol", "dt", "dt_max", "max_steps")
        if (value := getattr(keys, name)) is not None
    }
    given["method"] = f"dvax.evolution.{keys.method}()"
    if keys.vi_solver is not None:
        given["vi_solver"] = f"dvax.vi.{keys.vi_solver}()"
    return ", ".join(f"{name}={value}" for name, value in given.items())


def _initial(config: Config) -> str:
    section = config.initial
    text = "1.0" if section.expression is None else f"({_python(section.expression)})"
    return f"{section.value if section.value is not None else 1.0!r} * {text}"


def _formula(field: Field) -> str:
    return "1.0" if field.expression is None else f"({_python(field.expression.text)})"


class _Names(ast.NodeTransformer):
    """Functions and constants of formulas become those of jax.numpy."""

    def visit_Call(self, node: ast.Call) -> Any:
        self.generic_visit(node)
        if isinstance(node.func, ast.Attribute) and node.func.attr == "step":
            node.func.attr = "heaviside"
            node.args.append(ast.Constant(1.0))
        return node

    def visit_Name(self, node: ast.Name) -> Any:
        if node.id in CONSTANTS or node.id in FUNCTIONS:
            return ast.Attribute(ast.Name("jnp"), node.id)
        return node


def _python(formula: str) -> str:
    """Return a checked formula as Python code. Its syntax is that of Python."""
    flat = formula.translate({9: " ", 10: " ", 13: " "}).strip()
    return ast.unparse(_Names().visit(ast.parse(flat, mode="eval")))
