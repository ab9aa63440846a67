"""Random formulas: grammatical ones with their values, mutated ones, and known attacks."""

# ruff: noqa: E501  (tables of samples)

import ast
import math
import random

import numpy as np

from dvax.app.runs.expressions import FUNCTIONS

POINTS = {"t": np.float64(0.3), "s": np.array([-1.5, 0.0, 0.5, 2.0])}
"""Values of the variables."""

ATTACKS = (
    "__import__('os').getpid()", "().__class__.__bases__[0].__subclasses__()", "9**9**9**9", "'a'*10**9",
    "(1).__class__.__mro__", "t.__reduce__()", "[].append", "f'{t.__class__}'", "f'{9**9**9}'", "lambda: 1",
    "(lambda f: f(f))(lambda f: f(f))", "[[[]*9]*9]", "{}.__class__", "eval('1')", "exec('1')", "open('/etc/passwd')",
    "compile('1','','eval')", "getattr(t,'real')", "globals()", "sin.__globals__", "where.__call__(1)", "1if 1else 1",
    "(yield)", "await t", "t:=1", "*t", "**t", "print(t)", "exit()", "breakpoint()", "input()", "help()", "_", "__",
    "sin(cos)", "sin(sin)", "where(where,1,2)", "t if t else t", "not t", "t is t", "t in s", "0x" + "f" * 4000,
    "9" * 4096, "1e309", "1e-400", "-" * 4096, "(" * 4096, "1" + "+1" * 2047, "sin(" * 1000, "2**64**64", "2**-1e9",
    "(1e200)**64", "0**-1", "0.0**0", "(0-8)**(1/3)", "log(0)", "sqrt(0-1)", "exp(1e6)", "tan(pi/2)", "1/(1-1)",
    "floor(1e300)", "arctan2(0,0)", "clip(1,2,0)", "t\\\n+1", "t;import os", "t\nimport os", "import os", "t#", "t\x00",
    "ｔ", "t\u200b", "т", "1_000", "0o17", "0b1", "1j", "1e5j", "True", "None", "...", "b'x'", "'x'", "b'x'[0]", "t@s",
    "t//s", "t%s", "t<<1", "t|s", "t&s", "t^s", "~t", "t<s", "t==s", "t<s<1", "where(t<s<1,1,2)", "where(t==s,1,2)",
    "sin(t,)", "sin(t, s)", "sin()", "sin(*t)", "sin(x=t)", "sin(**t)", "minimum(t)", "s.real", "s[0]", "s[::]", "(t,)",
    "[t]", "{t}", "{t:1}", "[t for t in s]", "(t for t in s)", "e", "pi", "-pi**2", "2**0.5", "s**-64", "s**64", "s**65",
    "" , " ", "\t\n", "\ufefft", "\ud800", "é", "t" * 4097, "where(" * 60 + "t" + "<1,1,1)" * 60, "\\", "'", '"', "\r",
)  # fmt: skip

_FRAGMENTS = (
    "t", "s", "pi", "e", "0", "1e308", "9", "**", "*", "/", "+", "-", "(", ")", ",", "<", "<=", "==", "sin(", "where(",
    "foo", "lambda", ":=", "[", "]", "{", "}", ".", "__", "'", '"', "f'", "%", "//", "~", "not", "\\", "\n", "\t", "#",
    "0x", "1_0", "é", "\x00", "ａ", "@", ";", "=", "True", "1j", "\u202e", "\ud800", " ", "if", "else", "yield",
)  # fmt: skip


def formula(dice: random.Random, depth: int = 4) -> str:
    """Return a formula of the language."""
    if depth == 0 or dice.random() < 0.2:
        return dice.choice(
            ("t", "s", "pi", "e", "0", "1", "2.5", "1e-3", ".5", "3.", "1E2", "0x1f", "1e308")
        )
    less = depth - 1
    kind = dice.randrange(7)
    if kind < 3:
        blank = dice.choice(("", " ", "\n"))
        left, right = formula(dice, less), formula(dice, less)
        return f"({left}{blank}{dice.choice('+-*/')}{blank}{right})"
    if kind == 3:
        return f"{dice.choice(('-', '+', '--'))}{formula(dice, less)}"
    if kind == 4:
        return f"({formula(dice, less)})**{dice.choice(('2', '3', '0.5', '-1', '0', '64', '(1+1)', '-0.5'))}"
    name = dice.choice(sorted(FUNCTIONS))
    arguments = [formula(dice, less) for _ in range(FUNCTIONS[name])]
    if name == "where":
        arguments[0] += f" {dice.choice(('<', '<=', '>', '>='))} {formula(dice, less)}"
    return f"{name}({', '.join(arguments)})"


def text(number: int) -> str:
    """Return text `number`: the attacks, then formulas of which every second one is mutated."""
    if number < len(ATTACKS):
        return ATTACKS[number]
    dice = random.Random(f"expression {number}")
    if dice.random() < 0.1:
        return "".join(dice.choices(_FRAGMENTS, k=dice.randint(1, 30)))
    found = formula(dice) if dice.random() < 0.9 else dice.choice(ATTACKS)
    if number % 2:
        for _ in range(dice.randint(1, 3)):
            at, end = sorted((dice.randrange(len(found) + 1), dice.randrange(len(found) + 1)))
            change = dice.randrange(4)
            if change == 0:
                found = found[:at] + dice.choice(_FRAGMENTS) + found[at:]
            elif change == 1:
                found = found[:at] + found[min(end, at + 3) :]
            elif change == 2:
                found = found[:end] + found[at:end] * dice.choice((1, 2, 100)) + found[end:]
            else:
                found = found[:at] + dice.choice(ATTACKS) + found[at:]
    return found


def reference(text: str) -> np.ndarray | None:
    """Return the value of a formula by an evaluator of its own, scalar by scalar in Python's floats; None
    where the text is no formula."""
    try:
        tree = ast.parse(
            text.strip().replace("\n", " ").replace("\t", " ").replace("\r", " "), mode="eval"
        )
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return None
    places = np.broadcast_arrays(*POINTS.values())
    names = tuple(POINTS)
    values = [
        _value(tree.body, dict(zip(names, map(float, row), strict=True)))
        for row in zip(*(p.ravel() for p in places), strict=True)
    ]
    return np.array(values)


_SCALAR = {
    "sin": math.sin, "cos": math.cos, "tan": math.tan, "arctan": math.atan, "atan": math.atan, "sinh": math.sinh,
    "cosh": math.cosh, "tanh": math.tanh, "exp": math.exp, "log": math.log, "sqrt": math.sqrt, "abs": abs,
    "floor": math.floor, "arctan2": math.atan2, "minimum": min, "maximum": max,
    "sign": lambda x: math.copysign(1.0, x) if x else 0.0, "step": lambda x: 1.0 if x >= 0 else 0.0,
    "clip": lambda x, low, high: min(max(x, low), high),
}  # fmt: skip


def _value(node: ast.expr, env: dict[str, float]) -> float:
    """Return the value of a node; NaN wherever an operation has no finite value."""
    match node:
        case ast.Constant(value=number):
            return float(number)
        case ast.Name(id=name):
            return env.get(name, {"pi": math.pi, "e": math.e}.get(name, math.nan))
        case ast.UnaryOp(op=op, operand=inner):
            value = _value(inner, env)
            return -value if isinstance(op, ast.USub) else value
        case ast.Call(func=ast.Name(id="where"), args=[ast.Compare() as condition, yes, no]):
            left, right = _value(condition.left, env), _value(condition.comparators[0], env)
            holds = {
                ast.Lt: left < right, ast.LtE: left <= right, ast.Gt: left > right, ast.GtE: left >= right
            }[type(condition.ops[0])]  # fmt: skip
            chosen, other = _value(yes, env), _value(no, env)
            return math.nan if math.isnan(left + right) else (chosen if holds else other)
        case ast.Call(func=ast.Name(id=name), args=arguments):
            values = [_value(argument, env) for argument in arguments]
            return _finite(lambda: _SCALAR[name](*values), values)
        case ast.BinOp(left=left, op=op, right=right):
            a, b = _value(left, env), _value(right, env)
            operations = {
                ast.Add: lambda: a + b, ast.Sub: lambda: a - b, ast.Mult: lambda: a * b,
                ast.Div: lambda: a / b, ast.Pow: lambda: a**b,
            }  # fmt: skip
            return _finite(operations[type(op)], [a, b])
    raise AssertionError(ast.dump(node))


def _finite(operation, values: list[float]) -> float:
    if not all(map(math.isfinite, values)):
        return math.nan
    try:
        result = operation()
    except (ArithmeticError, ValueError):
        return math.nan
    return float(result) if isinstance(result, int | float) else math.nan
