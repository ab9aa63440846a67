"""Formulas written in configuration files: a small language that is safe and traceable.

A text such as ``"1 + 0.2*sin(2*pi*t) * where(s < 5, 1, 0)"`` is parsed by Python's own grammar, and
then every node is compared with a whitelist: finite numbers, the declared variables, the constants
``pi`` and ``e``, ``+ - * / **``, one comparison as the condition of ``where``, and the functions of
`FUNCTIONS` with their exact number of arguments. What is allowed becomes nested closures over an
array namespace; nothing is evaluated or compiled as Python, so a formula from an unknown source
can do arithmetic only.

The closures take the namespace as an argument: ``jax.numpy`` when the formula stands inside a
traced right-hand side, and ``numpy`` when a configuration is checked, in double precision, before
JAX is loaded.

Every subtree without a variable is folded in IEEE double precision, where an overflow takes one
operation. An infinity or NaN there is an error. Powers have constant exponents of
at most 64 in magnitude, because ``a**t`` has no real value for ``a < 0`` and its derivative is NaN
at ``a = 0``.

As always with ``where`` under differentiation, both branches are evaluated: keep both finite.
"""

import ast
import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any

import numpy as np

from dvax.app.runs.formula_syntax import kind_of, parse_formula, shown
from dvax.errors import InputError, Problems

MAX_EXPONENT = 64.0
MAX_PROBLEMS = 20

_Evaluate = Callable[[Any, Mapping[str, Any]], Any]  # (array namespace, variables) -> value

FUNCTIONS: Mapping[str, int] = MappingProxyType(
    {
        **dict.fromkeys(("sin", "cos", "tan", "arctan", "atan", "sinh", "cosh", "tanh"), 1),
        **dict.fromkeys(("exp", "log", "sqrt", "abs", "sign", "floor", "step"), 1),
        **dict.fromkeys(("arctan2", "minimum", "maximum"), 2),
        **dict.fromkeys(("clip", "where"), 3),
    }
)
"""Name -> number of arguments. ``step(0) = 1``; ``where`` takes a comparison first."""


def _function(name: str) -> Callable[..., Any]:
    """A function of the array namespace and its arguments."""
    if name == "step":
        # heaviside and not a comparison: a NaN stays a NaN.
        return lambda xp, x: xp.heaviside(x, 1.0)
    return lambda xp, *arguments: getattr(xp, name)(*arguments)


CONSTANTS: Mapping[str, float] = MappingProxyType({"pi": math.pi, "e": math.e})

_BINARY: Mapping[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}
_COMPARE: Mapping[type, Callable[[Any, Any], Any]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}


@dataclass(frozen=True)
class Expression:
    """A checked formula: an immutable function of named variables, equal to another by text and
    names.

    Call it with one keyword per name, ``expression(t=0.3, s=points)``: the variables are broadcast
    against each other, the result is a ``jax.numpy`` array of the shape of what the formula uses (a
    formula that uses no variable gives a scalar), and `jax.jit`, `jax.grad` and `jax.vmap` go
    through. `numpy` evaluates the same closures in double precision without JAX.

    `uses` holds the names that occur in the text.
    """

    text: str
    names: tuple[str, ...]
    uses: frozenset[str] = field(compare=False)
    _evaluate: _Evaluate = field(compare=False, repr=False)

    def __call__(self, **variables: Any) -> Any:
        import jax.numpy as jnp

        self._check(variables)
        arrays = {k: jnp.asarray(v) for k, v in variables.items()}
        # Convert integers to floats: t = 2 and t = 2.0 are the same time, also in 1 / t**2.
        arrays = {
            k: v.astype(float) if jnp.issubdtype(v.dtype, jnp.integer) else v
            for k, v in arrays.items()
        }
        return jnp.asarray(self._evaluate(jnp, arrays))

    def numpy(self, **variables: Any) -> np.ndarray:
        """The value in double precision, without JAX. Overflow and invalid operations give inf and
        NaN."""
        self._check(variables)
        arrays = {k: np.asarray(v, dtype=np.float64) for k, v in variables.items()}
        with np.errstate(all="ignore"):  # the caller checks for inf and NaN
            return np.asarray(self._evaluate(np, arrays), dtype=np.float64)

    def __reduce__(self) -> tuple[Any, ...]:
        return compile_expression, (self.text, self.names)

    def _check(self, variables: Mapping[str, Any]) -> None:
        if set(variables) != set(self.names):
            raise TypeError(
                f"the expression {self.text!r} is a function of "
                f"{', '.join(self.names) or 'nothing'}; it was called with "
                f"{', '.join(variables) or 'nothing'}. Pass each name once by keyword."
            )


def compile_expression(
    text: str, names: tuple[str, ...] = ("t", "s"), *, place: str = "expression"
) -> Expression:
    """Check `text` against the whitelist and return it as a function of `names`.

    `place` is the start of the place of each problem (a file and key, say). Raises `InputError`
    with every problem found (at most 20), each with its column; no other exception leaves, whatever
    the text."""
    tree = parse_formula(text, names, place)
    builder = _Builder(text.strip(), names, place, len(text) - len(text.lstrip()))
    built = builder.number(tree)
    if builder.problems:
        raise InputError(*builder.problems[:MAX_PROBLEMS])
    return Expression(text, tuple(names), frozenset(builder.used), built.evaluate)


@dataclass(frozen=True)
class _Built:
    """A closure, and its value where no variable occurs below it."""

    evaluate: _Evaluate
    constant: float | bool | None = None


class _Builder:
    """Turn whitelisted nodes into closures; report every other node and go on."""

    def __init__(self, text: str, names: tuple[str, ...], place: str, lead: int):
        self.text, self.names, self.place, self.lead = text, tuple(names), place, lead
        self.used: set[str] = set()
        self.problems = Problems()
        for name in self.names:
            if not name.isidentifier() or name in FUNCTIONS or name in CONSTANTS:
                raise ValueError(
                    f"{name!r} cannot name a variable: it is no identifier or already taken"
                )

    def refuse(self, node: ast.AST, rule: str, fix: str, given: str = "") -> _Built:
        column = getattr(node, "col_offset", 0) + self.lead + 1
        place = f"{self.place}, column {column}"
        self.problems.add(place, given or self.source(node), rule, fix)
        return _Built(lambda xp, env: math.nan)  # never called: the problem is raised

    def source(self, node: ast.AST) -> str:
        start, end = getattr(node, "col_offset", 0), getattr(node, "end_col_offset", None)
        return shown(self.text[start:end])

    def number(self, node: ast.expr) -> _Built:
        """A node that must have a number as its value."""
        match node:
            case ast.Constant(value=value):
                return self.literal(node, value)
            case ast.Name(id=name):
                return self.name(node, name)
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self.number(operand)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                inner = self.number(operand)
                return self.apply(node, lambda xp, a: -a, inner)
            case ast.BinOp(op=ast.Pow(), left=left, right=right):
                return self.power(node, left, right)
            case ast.BinOp(op=op, left=left, right=right) if type(op) in _BINARY:
                operation = _BINARY[type(op)]
                parts = self.number(left), self.number(right)
                return self.apply(node, lambda xp, a, b: operation(a, b), *parts)
            case ast.Call():
                return self.call(node)
            case ast.Compare():
                return self.refuse(
                    node,
                    "a comparison is no number; it stands only as the first argument of where",
                    "Write where(condition, value_if_true, value_if_false), or step(x).",
                )
        return self.refuse(
            node,
            f"{kind_of(node)} is not part of the expression language",
            "Use numbers, "
            + ", ".join((*self.names, *CONSTANTS))
            + ", + - * / ** and the functions "
            + ", ".join(FUNCTIONS)
            + ".",
        )

    def literal(self, node: ast.expr, value: object) -> _Built:
        if type(value) is not int and type(value) is not float:
            return self.refuse(
                node,
                f"a {type(value).__name__} is not a number here; numbers are real and finite",
                "Write a decimal number such as 2 or 1.5e-3.",
            )
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            return self.refuse(
                node,
                "a number must be finite in double precision (below 1.8e308)",
                "Use a smaller number or other units.",
            )
        return _Built(lambda xp, env: number, number)

    def name(self, node: ast.expr, name: str) -> _Built:
        if name in self.names:
            self.used.add(name)
            return _Built(lambda xp, env: env[name])
        if name in CONSTANTS:
            value = CONSTANTS[name]
            return _Built(lambda xp, env: value, value)
        if name in FUNCTIONS:
            return self.refuse(
                node, f"{name} is a function", f"Give it its argument: {name}(...).", repr(name)
            )
        return self.refuse(
            node,
            "the variables here are " + ", ".join(self.names)
            if self.names
            else "there is no variable here",
            _nearest(name, (*self.names, *CONSTANTS, *FUNCTIONS)),
            repr(name),
        )

    def power(self, node: ast.expr, left: ast.expr, right: ast.expr) -> _Built:
        base, exponent = self.number(left), self.number(right)
        value = exponent.constant
        if value is None:
            if not self.problems:
                self.refuse(
                    right,
                    "an exponent is a constant: a negative base has no real power where it moves",
                    "Write exp(exponent * log(base)) for a base that is always positive.",
                )
            return base
        if abs(value) > MAX_EXPONENT:
            return self.refuse(
                right,
                f"an exponent is at most {MAX_EXPONENT:g} in magnitude, or the power overflows",
                "Scale the base, or write exp(exponent * log(base)).",
            )
        # A whole exponent becomes a chain of products: exact at zero, also for its derivative.
        power = int(value) if float(value).is_integer() else value
        return self.apply(node, lambda xp, a: a**power, base)

    def call(self, node: ast.Call) -> _Built:
        if not isinstance(node.func, ast.Name):
            return self.refuse(
                node.func,
                "only the functions of the expression language can be called, by their plain name",
                "Use " + ", ".join(FUNCTIONS) + ".",
            )
        name = node.func.id
        if name not in FUNCTIONS:
            return self.refuse(
                node.func,
                "there is no such function" if name not in self.names else f"{name} is a variable",
                _nearest(name, tuple(FUNCTIONS)),
                repr(name),
            )
        arity = FUNCTIONS[name]
        if node.keywords or len(node.args) != arity:
            given = f"{len(node.args)} arguments" + (" and keywords" if node.keywords else "")
            return self.refuse(
                node,
                f"{name} takes exactly {arity} plain argument{'s' if arity > 1 else ''}",
                f"Write {name}({', '.join('abc'[:arity])}).",
                f"{name} with {given}",
            )
        parts = [
            self.condition(argument) if name == "where" and i == 0 else self.number(argument)
            for i, argument in enumerate(node.args)
        ]
        return self.apply(node, _function(name), *parts)

    def condition(self, node: ast.expr) -> _Built:
        if (
            not isinstance(node, ast.Compare)
            or len(node.ops) != 1
            or type(node.ops[0]) not in _COMPARE
        ):
            return self.refuse(
                node,
                "the condition of where is one comparison with <, <=, > or >=",
                "Write where(t < 2, a, b); nest where for more conditions.",
            )
        compare = _COMPARE[type(node.ops[0])]
        left, right = self.number(node.left), self.number(node.comparators[0])
        if left.constant is not None and right.constant is not None:
            verdict = bool(compare(left.constant, right.constant))
            return _Built(lambda xp, env: verdict, verdict)
        return _Built(lambda xp, env: compare(left.evaluate(xp, env), right.evaluate(xp, env)))

    def apply(self, node: ast.expr, operation: Callable[..., Any], *parts: _Built) -> _Built:
        """The closure of an operation; its value, checked to be finite, where every part is
        constant."""
        if self.problems:
            return _Built(lambda xp, env: math.nan)
        constants = [part.constant for part in parts]
        if all(constant is not None for constant in constants):
            with np.errstate(all="ignore"):  # overflow gives inf, which is refused below
                value = float(operation(np, *(np.float64(c) for c in constants)))
            if not math.isfinite(value):
                return self.refuse(
                    node,
                    f"its value is {value}, and every constant must be finite",
                    "Fix the division by zero, the overflow or the argument outside the domain.",
                )
            return _Built(lambda xp, env: value, value)
        evaluations = [part.evaluate for part in parts]
        return _Built(lambda xp, env: operation(xp, *(run(xp, env) for run in evaluations)))


def _nearest(name: str, known: tuple[str, ...]) -> str:
    close = get_close_matches(name, known, n=1)
    return f"Did you mean {close[0]!r}?" if close else "Allowed: " + ", ".join(known) + "."
