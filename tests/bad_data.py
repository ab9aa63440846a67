"""Data that the constructors reject: one process tries all of them and prints the messages.

A process of its own, as for `tests/newcomer.py`: the tests check annotations, which users do not.
"""

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)  # before the data of the cases is made

from tests.newcomer import PLAIN, problem, solve, verify  # noqa: E402
from tests.refusals import print_all  # noqa: E402

from dvax import generators as g  # noqa: E402
from dvax import operators as o  # noqa: E402
from dvax import sets as s  # noqa: E402
from dvax import signals, spaces  # noqa: E402

inf, nan = np.inf, np.nan


class Lines:
    """A value whose text has several lines, as tables have."""

    def __repr__(self):
        return "\n".join(f"row {k}   {float(k)}" for k in range(100))

    __hash__ = None


def f_unpacks(t, x, u, args):
    a, b = args
    return a * x + b


def f_helper(t, x, u, args):
    return scaled(x, args)


def scaled(x, p):
    return p["k"] * x


def f_other(t, x, u, args):
    return missing(t) * x


def missing(t):
    return None


UNIT = s.Box(0.0, 1.0)
NUMBERS = {
    "Scaling of a list": (lambda: o.Scaling([1.0, 2.0]), "Scaling(b); [1. 2.]; operators.Diagonal"),
    "Scaling of no list": (lambda: o.Scaling([]), "Scaling(b); []; one number"),
    "Scaling of no tuple": (lambda: o.Scaling(()), "Scaling(b); (); one number"),
    "Scaling of a dict": (lambda: o.Scaling({"b": 1.0}), "Scaling(b); dict {'b': 1.0}; its values"),
    "offset": (lambda: s.HalfSpace([1.0, 1.0], [1.0, 2.0]), "HalfSpace(offset); one number"),
    "offset of a plane": (lambda: s.Hyperplane([1.0], [1.0, 2.0]), "Hyperplane(offset); [1. 2.]"),
    "m": (lambda: o.MatrixFree(np.abs, [1.0, 2.0], 1.0), "MatrixFree(m); one number"),
    "rate": (lambda: g.Dense(-np.eye(2), omega=np.ones(2)), "Dense(omega); one number"),
    "infinite rate": (lambda: g.Dense(-np.eye(2), omega=inf), "Dense(omega); got inf; finite"),
    "rate of NaN": (lambda: g.Dense(nan * np.eye(2), omega=1.0), "Dense(matrix); nan; finite"),
    "reaction": (lambda: g.Elliptic(4, reaction=[1.0, 2.0]), "Elliptic(reaction); one number"),
    "factor": (lambda: s.Scaled(UNIT, [1.0, 2.0]), "Scaled(factor); one number"),
    "tol": (lambda: s.Intersection(UNIT, tol="a"), "Intersection(tol); 'a'; Leave it out"),
    "cycles": (lambda: s.Intersection(UNIT, max_cycles=1.5), "(max_cycles); 1.5; whole number"),
}
ARRAYS = {
    "tuples of a box": (
        lambda: s.Box((0.0, 0.0), (1.0, 1.0)),
        "Box(lower); (0.0, 0.0); Write jnp.array([0.0, 0.0])",
    ),
    "tuple of rates": (lambda: g.Scalar((-1.0, -2.0)), "Scalar(a); jnp.array([-1.0, -2.0])"),
    "tuple of entries": (lambda: g.Diagonal((-1.0, -2.0)), "Diagonal(entries); jnp.array([-1.0,"),
    "tuple of arrays": (lambda: o.Diagonal((jnp.ones(2), jnp.ones(2))), "Join them into one array"),
    "no entries": (lambda: o.Diagonal([]), "Diagonal(entries); shape (0,); at least one entry"),
    "infinite entry": (lambda: o.Diagonal([1.0, inf]), "Diagonal(entries); [ 1. inf]; finite"),
    "text of a number": (lambda: s.Box(0.0, "1.0"), "Box(upper); '1.0'; Write 1.0, without quot"),
    "text": (lambda: s.Box(0.0, "a"), "Box(upper); str 'a'; not text"),
    "nothing": (lambda: s.Box(0.0, None), "Box(upper); got None; such as 1.0"),
    "function": (
        lambda: s.Box(0.0, lambda t: t),
        "Box(upper); <lambda>; the value that it returns",
    ),
    "class": (lambda: s.Box(0.0, float), "Box(upper); the class float; such as 1.0"),
    "flag": (lambda: s.Box(0.0, True), "Box(upper); bool True; Write 1.0 for True"),
    "integer": (lambda: s.Box(0.0, np.int64(1)), "Box(upper); int64 1; jnp.asarray(upper, float)"),
    "integers": (lambda: s.Box(0.0, np.arange(2)), "Box(upper); int64; jnp.asarray(upper, float)"),
    "list of text": (lambda: s.Box(0.0, ["1"]), "Box(upper); ['1']; real numbers"),
    "table of text": (
        lambda: signals.Table([0.0, 1.0], ["1", "2"]),
        "Table(values); ['1', '2']; a list or array of numbers",
    ),
    "list of nothing": (lambda: s.Box(0.0, [None]), "Box(upper); [None]; real numbers"),
    "ragged": (lambda: g.Dense([[1.0], [1.0, 2.0]]), "Dense(matrix); rows of one length"),
    "complex": (lambda: s.Box(1j, 2.0), "Box(lower); 1j; jnp.real(lower)"),
    "complex P": (lambda: o.Diagonal(jnp.array([1j])), "Diagonal(entries); complex128; jnp.real("),
    "complex A": (lambda: g.Diagonal(np.array([1j])), "Diagonal(entries); complex128; jnp.real("),
    "complex in a list": (lambda: g.Dense([[1j]]), "Dense(matrix); [[1j]]; real numbers"),
    "set": (lambda: s.Ball({1.0}, 1.0), "Ball(center); {1.0}; no order: give a list"),
    "signal": (lambda: s.Box(0.0, signals.Constant(1.0)), "Box(upper); Constant; the value that"),
    "part without value": (lambda: s.Ball((1.0, None), 1.0), "Ball(center); got None"),
    "table": (lambda: s.Box(0.0, Lines()), "Box(upper); row 0 0.0 row 1 1.0; ..."),
    "shape of an array": (lambda: s.Box(0.0, jax.ShapeDtypeStruct((2,), float)), "Box(upper)"),
    "weights": (lambda: spaces.L2("a"), "spaces.L2(weights); 'a'"),
    "singular P": (lambda: o.Dense(np.ones((2, 2))), "Dense(matrix); singular; rank 1; coercive"),
    "indefinite P": (lambda: o.Dense([[1.0, 2.0], [2.0, 1.0]]), "smallest eigenvalue -1; coercive"),
    "singular, not symmetric": (lambda: o.Dense([[1.0, 1.0], [2.0, 2.0]]), "singular; rank 1"),
    "infinite P": (lambda: o.Dense(inf * np.ones((2, 2))), "Dense(matrix); not finite"),
}
SHAPES = {
    f"{name} {value!r:.12}": (lambda make=make, value=value: make(value), f"{name}(shape); whole")
    for name, make in {
        "Euclidean": spaces.Euclidean,
        "Elliptic": g.Elliptic,
        "Convolution": lambda shape: o.Convolution(jnp.ones(3), shape),
    }.items()
    for value in (3.0, None, "ab", [nan], True, (2, 0), {3}, Lines())
} | {
    "no boundary": (lambda: g.Elliptic(4, boundary=None), "Elliptic(boundary); None; periodic"),
    "table of boundaries": (lambda: g.Elliptic(4, boundary=Lines()), "Elliptic(boundary); row 0"),
    "few boundaries": (lambda: g.Elliptic((4, 4), boundary=["neumann"]), "Elliptic(boundary)"),
}
PARTS = {
    "number for a set": (lambda: s.Translated(1.0, UNIT), "Translated(set); 1.0; comes first"),
    "number to stretch": (lambda: s.Scaled(1.0, UNIT), "Scaled(set); 1.0; comes first"),
    "text for a set": (lambda: s.Intersection(UNIT, "a"), "Intersection, part 2; 'a'; dvax.sets"),
    "a list of sets": (
        lambda: s.Product([UNIT, UNIT]),
        "sets.Product, part 1; one argument a part",
    ),
    "text for a space": (lambda: spaces.Product("a"), "spaces.Product, part 1; 'a'"),
    "no spaces": (lambda: spaces.Product(), "spaces.Product; no parts"),
    "number for P": (lambda: o.Product(1.0), "operators.Product, part 1; 1.0; operators.Scaling"),
    "number for A": (lambda: g.Product(1.0), "generators.Product, part 1; 1.0"),
    "text for a field": (lambda: g.KroneckerSum("a", np.eye(2)), "KroneckerSum(field); 'a'"),
    "text for fn": (lambda: o.MatrixFree("a", 1.0, 2.0), "MatrixFree(fn); 'a'; lambda v"),
    "number for a signal": (lambda: signals.Product(1.0, 2.0), "signals.Product(a); Constant"),
    "no function of time": (lambda: signals.Function(None), "Function(fn); got None; lambda t"),
} | {
    f"knots {knots!r}": (lambda knots=knots: signals.Function(jnp.sin, knots), "Function(knots)")
    for knots in ("a", [[1.0], [1.0, 2.0]], [1j], [[1.0]], [nan], {1.0}, [None])
}
SOLVE = {
    "half precision": (
        lambda: solve(x0=np.float16(0.1)),
        "x0; float16; np.asarray(x0, np.float64)",
    ),
    "bfloat16": (lambda: solve(x0=jnp.bfloat16(0.1)), "x0; bfloat16; np.asarray(x0, np.float64)"),
    "long double": (
        lambda: solve(x0=np.array([0.1], ">f8")),
        "x0; >f8; np.asarray(x0, np.float64)",
    ),
    "a large integer": (lambda: solve(x0=10**400), "x0; int 1000; range of float64"),
    "a masked array": (lambda: solve(x0=np.ma.array([0.1])), "x0; masked; x0.filled(0.0)"),
    "a complex state": (lambda: solve(x0=jnp.array([1j])), "x0; complex128; two components"),
    "the problem second": (lambda: solve(0.1, PLAIN), "solve(problem); 0.1; comes first"),
    "table in args": (lambda: solve(args=Lines()), "solve(problem, args); row 0; hashable"),
    "no point at ∞": (lambda: verify(x=(inf, inf)), "verify(x); inf; the region is empty"),
    "no point at −∞": (lambda: verify(u=(-inf, -inf)), "verify(u); -inf; the region is empty"),
    "args unpacked": (lambda: solve(problem(f=f_unpacks)), "f reads args; Pass args="),
    "args handed on": (lambda: solve(problem(f=f_helper)), "f reads args; Pass args="),
    "None from elsewhere": (lambda: solve(problem(f=f_other)), "NoneType; Fix that line"),
    "another key": (
        lambda: solve(problem(f=lambda t, x, u, args: args["rate"] * x), args={"rates": 1.0}),
        "KeyError: 'rate'; 'rates'; Correct the key",
    ),
}
CASES = {
    "numbers": NUMBERS, "arrays": ARRAYS, "shapes": SHAPES, "parts": PARTS, "solve": SOLVE
}  # fmt: skip

if __name__ == "__main__":
    print_all(CASES)
