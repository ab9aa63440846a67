"""Wrong calls of `dvax.solve_vi`, its solvers and `Problem.response`: one process tries all of them and
prints the messages.

A process of its own, since the tests check annotations, and the checker would answer before dvax.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from tests.refusals import print_all

jax.config.update("jax_enable_x64", True)

import dvax  # noqa: E402
from dvax import generators, operators, sets, vi  # noqa: E402

nan, inf = math.nan, math.inf
B, Z = sets.Box(0.0, 1.0), jnp.zeros(2)


def F3(y, args):
    return jnp.array([2.0, 3.0]) * y - y[::-1] * 0.3 - 1.0


def solve(F=F3, K=B, y0=Z, args=None, **options):
    return dvax.solve_vi(F, K, y0, args, **options)


def returns(value):
    return lambda y, args: value


def branches(y, args):
    if y[0] > 0:
        return y
    return -y


class Unhashable:
    __hash__ = None

    def __call__(self, y, args):
        return y


def cyclic(K=None, **changed):
    R = jnp.array([[0.0, 1.0], [-1.0, 0.0]])
    parts = dict(
        A=generators.Scalar(-1.0), P=operators.Scaling(1.0), K=sets.WholeSpace(),
        f=lambda t, x, u, args: -u, h=lambda t, x, u, args: u - R @ u - 1.0,
    )  # fmt: skip
    return dvax.Problem(**{**parts, **changed})


PLAIN = cyclic(K=B, h=lambda t, x, u, args: 1.0 - 2.0 * x - u)

SETS = {
    "None": (lambda: solve(K=None), "solve_vi(K); NoneType None; dvax.sets"),
    "a pair": (lambda: solve(K=(0.0, 1.0)), "solve_vi(K); (0.0, 1.0); Box"),
    "moving": (lambda: solve(K=lambda t, args: B), "solve_vi(K); K(t, args)"),
    "class": (lambda: solve(K=sets.Box), "solve_vi(K); Box"),
    "of another shape": (lambda: solve(K=sets.Box(jnp.zeros(3), 1.0)), "Box(lower); (3,)"),
}
SOLVERS = {
    "text": (lambda: solve(solver="Auto"), "solve_vi(solver); 'Auto'; dvax.vi.Auto()"),
    "class": (lambda: solve(solver=vi.Auto), "solve_vi(solver); Auto"),
    "method": (lambda: solve(solver=dvax.ETD2RK()), "solve_vi(solver); ETD2RK"),
    "phi text": (lambda: vi.GoldenRatio("a"), "GoldenRatio(phi); 'a'; 1.618; 1.5"),
    "phi 10": (lambda: vi.GoldenRatio(10.0), "GoldenRatio(phi); 10.0; 1.618"),
    "phi 1": (lambda: vi.GoldenRatio(1.0), "GoldenRatio(phi); 1.0"),
    "steps None": (lambda: vi.GoldenRatio(1.5, None), "GoldenRatio(max_steps); None; 20000"),
    "steps 0": (lambda: vi.Projection(0), "Projection(max_steps); 0"),
    "steps 1.5": (lambda: vi.Projection(1.5), "Projection(max_steps); 1.5; whole"),
    "steps True": (lambda: vi.Bracketing(True), "Bracketing(max_steps); True"),
    "steps inf": (lambda: vi.Bracketing(inf), "Bracketing(max_steps); inf"),
    "step text": (lambda: vi.SemismoothNewton("a"), "SemismoothNewton(step); 'a'; (0, 1)"),
    "step 0": (lambda: vi.Extragradient(0.0), "Extragradient(step); 0.0; (0, 1); 0.7"),
    "step -1": (lambda: vi.Extragradient(-1.0), "Extragradient(step); -1.0"),
    "step 1": (lambda: vi.ForwardBackwardForward(1.0), "ForwardBackwardForward(step); 1.0"),
    "step nan": (lambda: vi.ActiveSet(nan), "ActiveSet(step); nan"),
    "step of two": (lambda: vi.ActiveSet(Z), "ActiveSet(step); [0. 0.]"),
    "dense -1": (lambda: vi.ActiveSet(dense=-1), "ActiveSet(dense); -1"),
    "symmetric": (lambda: vi.ActiveSet(symmetric="yes"), "ActiveSet(symmetric); 'yes'"),
    "preconditioner": (lambda: vi.ActiveSet(preconditioner=1), "ActiveSet(preconditioner); 1"),
    "least": (lambda: vi.Accelerated(least=-1.0), "Accelerated(least); -1.0"),
    "a of text": (lambda: vi.Weighted("a", F3), "Weighted(a); 'a'"),
}
FUNCTIONS = {
    "no function": (lambda: solve(3.0), "solve_vi(F); 3.0; (y, args)"),
    "one parameter": (lambda: solve(lambda y: y), "(F); bad_input.py, line; F=lambda y, args"),
    "branch": (lambda: solve(branches), "(F); bad_input.py, line; jnp.where"),
    "numpy": (lambda: solve(lambda y, args: np.sin(y)), "(F); bad_input.py, line; jnp.sin"),
    "float": (lambda: solve(lambda y, args: float(y[0]) * y), "(F); bad_input.py, line; float()"),
    "no args": (lambda: solve(lambda y, a: a["k"] * y), "(F); bad_input.py, line; args=..."),
    "shapes": (lambda: solve(lambda y, a: jnp.ones((3, 3)) @ y), "(F); line; y of shape (2,)"),
    "text": (lambda: solve(returns("a")), "(F); bad_input.py, line; str 'a'"),
    "text of NumPy": (lambda: solve(returns(np.array(["a", "b"]))), "(F); ndarray; array"),
    "None": (lambda: solve(returns(None)), "(F); None; return"),
    "list": (lambda: solve(lambda y, args: [y[0], y[1]]), "(F); jnp.stack"),
    "bool": (lambda: solve(lambda y, args: y > 0), "(F); bool"),
    "int": (lambda: solve(returns(1), y0=0.0), "(F); int; float64"),
    "ints": (lambda: solve(returns(np.array([1, 2]))), "(F); int64; float64"),
    "float32": (lambda: solve(lambda y, a: y.astype("float32")), "(F); float32; guess y0; float64"),
    "scalar": (lambda: solve(lambda y, args: y[0]), "(F); shape (); (2,)"),
    "three": (lambda: solve(returns(jnp.zeros(3))), "(F); shape (3,); (2,)"),
    "complex": (lambda: solve(lambda y, args: 1j * y + 1), "(F); complex128; is real"),
    "unhashable": (lambda: solve(Unhashable()), "(F); Unhashable; hashable"),
    "G of three": (lambda: solve(vi.Weighted(lambda y, a: 1.0, returns(jnp.zeros(3)))),
                   "Weighted(G); shape (3,)"),
    "a of text": (lambda: solve(vi.Weighted(returns("a"), F3)), "Weighted(a); 'a'"),
    "a of two": (lambda: solve(vi.Weighted(lambda y, args: y, F3)), "Weighted(a); (2,)"),
}  # fmt: skip
NUMBERS = {
    "tol text": (lambda: solve(tol="a"), "solve_vi(tol); 'a'"),
    "tol None": (lambda: solve(tol=None), "solve_vi(tol); None"),
    "tol of two": (lambda: solve(tol=Z), "solve_vi(tol); [0. 0.]"),
    "tol of a list": (lambda: solve(tol=[1.0, [2.0]]), "solve_vi(tol); list"),
    "tol of two, traced": (lambda: jax.jit(lambda v: solve(tol=v).y)(Z), "solve_vi(tol)"),
    "tol nan": (lambda: solve(tol=nan), "solve_vi(tol); nan"),
    "tol -1": (lambda: solve(tol=-1.0), "solve_vi(tol); -1.0"),
    "tol True": (lambda: solve(tol=True), "solve_vi(tol); True"),
    "gamma text": (lambda: solve(gamma="a"), "solve_vi(gamma); 'a'"),
    "gamma of two": (lambda: solve(gamma=Z), "solve_vi(gamma); [0. 0.]"),
    "gamma nan": (lambda: solve(gamma=nan), "solve_vi(gamma); nan; positive"),
    "gamma -1": (lambda: solve(gamma=jnp.asarray(-1.0)), "solve_vi(gamma); -1.0; positive"),
    "gamma 0": (lambda: solve(gamma=0), "solve_vi(gamma); 0; positive"),
    "gamma inf": (lambda: solve(gamma=inf), "solve_vi(gamma); inf; finite"),
    "gamma huge": (lambda: solve(gamma=10**400), "solve_vi(gamma); finite"),
    "gamma single": (
        lambda: solve(y0=jnp.zeros(2, jnp.float32), gamma=1e300), "(gamma); 1e+300; inf in float32"
    ),
    "gamma complex": (lambda: solve(gamma=1j), "solve_vi(gamma); 1j"),
    "L_F text": (lambda: solve(L_F="a"), "solve_vi(L_F); 'a'"),
    "L_F -1": (lambda: solve(L_F=-1.0), "solve_vi(L_F); -1.0"),
}  # fmt: skip
ELEMENTS = {
    "space text": (lambda: solve(space="a"), "solve_vi(space); 'a'"),
    "space 3": (lambda: solve(space=3), "solve_vi(space); 3"),
    "space of three": (lambda: solve(space=dvax.spaces.Euclidean(3)), "(y0); (2,); space=; (3,)"),
    "args set": (lambda: solve(args={1}), "solve_vi(args); {1}; hashable"),
    "args keys": (lambda: solve(args={1: 2.0, "a": 1.0}), "solve_vi(args); keys"),
    "args of text": (lambda: solve(args=np.array(["a", "b"])), "solve_vi(args); numbers"),
    "y0 dict": (lambda: solve(y0={"a": 0.0}), "y0; dict"),
    "y0 dict in a tuple": (lambda: solve(y0=({"a": 0.0},)), "y0; dict"),
    "y0 text": (lambda: solve(y0="a"), "y0; 'a'"),
    "y0 None": (lambda: solve(y0=None), "y0; None"),
    "y0 ints": (lambda: solve(y0=np.array([1, 2])), "y0; int64"),
    "y0 complex": (lambda: solve(y0=np.array([1j, 2.0])), "y0; complex128; real"),
}
RESPONSE = {
    "solver": (lambda: PLAIN.response(0.0, 0.1, solver="a"), "solver; 'a'; dvax.vi.Auto()"),
    "law's solver": (lambda: PLAIN.law(0.0, jnp.array(0.1), solver="a"), "solver; 'a'"),
    "x nan": (lambda: PLAIN.response(0.0, nan), "x; nan"),
    "t nan": (lambda: PLAIN.reduced(nan, 0.1), "t; nan"),
}
CASES = {
    "K": SETS, "solver": SOLVERS, "F": FUNCTIONS, "number": NUMBERS, "element": ELEMENTS,
    "response": RESPONSE,
}  # fmt: skip

if __name__ == "__main__":
    print_all(CASES)
