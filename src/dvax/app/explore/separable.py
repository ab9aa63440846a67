"""A field of a configuration as a signal whose factors in space alone are computed once.

`dvax run` evaluates a formula as it is written, at every point in every stage of a step. Most formulas
are products of a function of the place and one of the time, and sines at 2 000 points would take most
of the time of a solve.
"""

import ast
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from dvax.app.runs.boundary import Boundary
from dvax.app.runs.expressions import Expression, compile_expression
from dvax.app.runs.fields import Field, to_signal
from dvax.signals import Constant, Product


def separated(field: Field, boundary: Boundary) -> Any:
    """Return the field as a `dvax.signals` signal; up to roundoff it is that of a run."""
    expression = field.expression
    if expression is None or "t" not in expression.uses:
        return to_signal(field, boundary)
    profile, rest = np.ones(boundary.size), []
    coordinates = dict(zip(boundary.names, boundary.coordinates, strict=True))
    for text in _factors(ast.parse(_flat(expression), mode="eval").body):
        factor = compile_expression(text, expression.names, place="the formula")
        if "t" in factor.uses:
            rest.append(text)
        else:
            profile = profile * factor.numpy(**coordinates, t=0.0)
    moving = compile_expression("*".join(rest), expression.names, place="the formula")
    return Product(Constant(profile), to_signal(replace(field, expression=moving), boundary))


def _flat(expression: Expression) -> str:
    return expression.text.translate({9: " ", 10: " ", 13: " "}).strip()


def _factors(node: ast.expr) -> Iterator[str]:
    """Yield the factors of a product and of the numerators of quotients, each in parentheses."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
        yield from _factors(node.left)
        yield from _factors(node.right)
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
        yield from _factors(node.left)
        yield f"(1/({ast.unparse(node.right)}))"
    else:
        yield f"({ast.unparse(node)})"
