"""Typical mistakes of new users: one process tries all of them and prints the messages.

A process of its own, since the tests check annotations and promotion, which users do not: there
`max_steps="9"` would be refused by the checker, and never reach dvax.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from tests.refusals import print_all

jax.config.update("jax_enable_x64", True)  # before the data of the cases is made

import dvax  # noqa: E402
from dvax import generators, operators, sets, signals  # noqa: E402

nan, inf = math.nan, math.inf
PARTS = dict(
    A=generators.Scalar(-1.0),
    P=operators.Scaling(1.0),
    K=sets.Box(0.0, 0.5),
    f=lambda t, x, u, args: -u,
    h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
)


def problem(**changed):
    return dvax.Problem(**{**PARTS, **changed})


PLAIN = problem()  # one object, so that it compiles once
ROTATION = generators.Dense(jnp.array([[0.0, 1.0], [-1.0, 0.0]]))
SHORT = signals.Table(jnp.array([0.0, 0.5]), jnp.array([1.0, 2.0]))


def solve(p=None, x0=0.1, t0=0.0, t1=1.0, **options):
    return dvax.solve(PLAIN if p is None else p, x0, t0, t1, **options)


def verify(p=None, *given, **options):
    return dvax.verify(PLAIN if p is None else p, *given, **options)


def of_f(f, **options):
    return solve(problem(f=f), **options)


class Moduli:
    def __init__(self, gamma):
        self.gamma, self.L_F, self.norm_P_inv = gamma, 1.0, 1.0


def assigns(t, x, u, args):
    x[0] = 1.0
    return x


# name: (what is tried, words of the message)
FUNCTIONS = {
    "f of three": (
        lambda: of_f(lambda t, x, u: -u),
        "newcomer.py, line; a function of (t, x, u); f(t, x, u, args)",
    ),
    "times with a unit": (
        lambda: solve(ts=np.array([0, 1], "m8[s]")),
        "solve(ts); timedelta64",
    ),
    "NaN in a bound": (lambda: sets.Box(np.array([0.0, np.nan]), 1.0), "Box(lower); NaN"),
    "a text in args": (
        lambda: of_f(lambda t, x, u, args: x * args["k"], args={"k": "3"}),
        "Problem(f); args['k'] = '3'; float(...)",
    ),
    "a list in args": (
        lambda: dvax.solve(
            problem(f=lambda t, x, u, a: a[0] * x), jnp.ones(2), 0.0, 1.0, ([1.0, 2.0],)
        ),
        "Problem(f); newcomer.py, line; a list; jnp.asarray",
    ),
    "f of x first": (
        lambda: of_f(lambda x, t, u, args: -x),
        "Problem(f); the parameters x, t, u, args; called as f(t, x, u, args)",
    ),
    "f of five": (lambda: of_f(lambda t, x, u, a, b: -u), "Problem(f); called as f(t, x, u, args)"),
    "h of three": (lambda: solve(problem(h=lambda t, x, u: x)), "Problem(h); lambda t, x, u, args"),
    "K of one": (
        lambda: solve(problem(K=lambda t: sets.Box(0.0, 1.0))),
        "Problem(K); called as K(t, args)",
    ),
    "A of none": (
        lambda: solve(problem(A=lambda: generators.Scalar(-1.0))),
        "Problem(A); called as A(args)",
    ),
    "P of two": (
        lambda: solve(problem(P=lambda a, b: operators.Scaling(1.0))),
        "Problem(P); called as P(args)",
    ),
    "if": (
        lambda: of_f(lambda t, x, u, args: -u if x > 0 else u),
        "newcomer.py, line; `if`; jnp.where",
    ),
    "and": (
        lambda: of_f(lambda t, x, u, args: jnp.where((x > 0) and (x < 1), u, x)),
        "jnp.logical_and",
    ),
    "max": (lambda: of_f(lambda t, x, u, args: max(x, u)), "jnp.maximum"),
    "if in K": (
        lambda: solve(problem(K=lambda t, a: sets.Box(0.0, 1.0 if t < 1 else 2.0))),
        "Problem(K); jnp.where",
    ),
    "if in K, verify": (
        lambda: verify(problem(K=lambda t, a: sets.Box(0.0, 1.0 if t < 1 else 2.0))),
        "Problem(K); jnp.where",
    ),
    "integers": (
        lambda: solve(problem(h=lambda t, x, u, args: jnp.where(t < 0.5, 1, 0))),
        "Problem(h); newcomer.py, line; a value of int; floating-point; 1.0 for 1",
    ),
    "an integer": (lambda: of_f(lambda t, x, u, args: 0), "Problem(f); a value of int; 1.0 for 1"),
    "np.sin": (
        lambda: of_f(lambda t, x, u, args: np.sin(x)),
        "newcomer.py, line; jnp.sin(x) for np.sin(x)",
    ),
    "np.interp": (
        lambda: of_f(lambda t, x, u, args: x + np.interp(t, np.arange(3.0), np.ones(3))),
        "newcomer.py, line; dvax.signals.Table",
    ),
    "an entry by int(t)": (
        lambda: of_f(lambda t, x, u, args: x + np.ones(3)[int(t)]),
        "newcomer.py, line; Remove float() or int(); dvax.signals.Table",
    ),
    "parts of other shapes": (
        lambda: of_f(lambda t, x, u, args: (x[:2], x[2]), x0=jnp.zeros(3)),
        "Problem(f); jnp.concatenate([jnp.ravel(a), ...])",
    ),
    "np.array": (
        lambda: of_f(lambda t, x, u, args: np.array([x[0], u[1]]), x0=jnp.zeros(2)),
        "jax.numpy",
    ),
    "math.sin": (lambda: of_f(lambda t, x, u, args: math.sin(x)), "math.sin(x)"),
    "float": (lambda: of_f(lambda t, x, u, args: float(x)), "float()"),
    "index": (
        lambda: of_f(lambda t, x, u, args: jnp.asarray([1.0, 2.0][x.astype(int)])),
        "jnp.take",
    ),
    "mask": (
        lambda: of_f(lambda t, x, u, args: x[x > 0], x0=jnp.zeros(2)),
        "jnp.where(mask, a, b)",
    ),
    "assignment": (lambda: of_f(assigns, x0=jnp.zeros(2)), "x.at[i].set(v); newcomer.py, line"),
    "no args": (
        lambda: of_f(lambda t, x, u, args: args["k"] * x),
        "no args were given; Pass args=",
    ),
    "text args": (lambda: of_f(lambda t, x, u, args: args * u, args="a"), "newcomer.py, line"),
    "matrix": (
        lambda: of_f(lambda t, x, u, args: jnp.zeros((3, 3)) @ x, x0=jnp.zeros(2)),
        "x of shape (2,), u of shape (2,)",
    ),
    "text": (lambda: of_f(lambda t, x, u, args: "x"), "str 'x'; returns an array"),
    "nothing": (lambda: of_f(lambda t, x, u, args: None), "shape None"),
    "list": (lambda: of_f(lambda t, x, u, args: [x[0], x[1]], x0=jnp.zeros(2)), "jnp.stack([...])"),
    "complex": (
        lambda: of_f(lambda t, x, u, args: x * 1j),
        "complex128; is real, as the state x0 is",
    ),
    "shape": (lambda: of_f(lambda t, x, u, args: jnp.zeros(3), x0=jnp.zeros(2)), "(3,); (2,)"),
    "scalar u": (
        lambda: of_f(lambda t, x, u, args: jnp.stack([0.0 * u, -u]), x0=jnp.zeros(2)),
        "x of shape (2,) and u of shape (2,) (that of x, since P and K fix no other",
    ),
    "scalar u, concatenated": (
        lambda: solve(
            problem(
                h=lambda t, x, u, args: x[0],
                f=lambda t, x, u, args: jnp.concatenate([x, jnp.atleast_2d(u)]),
            ),
            jnp.zeros(2),
        ),
        "control_space=dvax.spaces.Euclidean(())",
    ),
    "a flag": (lambda: of_f(lambda t, x, u, args: x > 0), "newcomer.py, line; jnp.where(condition"),
    "single precision": (
        lambda: of_f(lambda t, x, u, args: jnp.float32(2.0) * u.astype(jnp.float32)),
        "Problem(f), ; a value of float32; of float64; jnp.float64",
    ),
    "single precision in args": (
        lambda: of_f(lambda t, x, u, args: args * u, args=jnp.float32(1.0)),
        "Problem(f), ; a value of float32; of float64",
    ),
    "a class for A": (lambda: problem(A=generators.Scalar), "Problem(A); a generator"),
    "a class for K": (lambda: problem(K=sets.Box), "Problem(K); a set"),
    "a table without order, made inside": (
        lambda: of_f(lambda t, x, u, a: signals.Table(jnp.array([1.0, 0.0]), jnp.ones(2))(t) - u),
        "Table(times); times[0] = 1, times[1] = 0; increase strictly",
    ),
    "a short table, made inside": (
        lambda: of_f(lambda t, x, u, a: signals.Table(jnp.array([0.0, 0.5]), jnp.ones(2))(t) - u),
        "a Table in f; from t = 0 to 0.5; [0, 1]",
    ),
    "short table": (
        lambda: of_f(lambda t, x, u, a: SHORT(t) - u),
        "a Table in f; from t = 0 to 0.5; [0, 1]",
    ),
    "short table of K": (
        lambda: solve(problem(K=lambda t, a: sets.Box(0.0, SHORT(t)))),
        "a Table in K; to 0.5",
    ),
    "K a number": (
        lambda: solve(problem(K=lambda t, args: 0.5)),
        "Problem(K); float 0.5; AbstractSet",
    ),
    "A a number": (lambda: solve(problem(A=lambda args: -1.0)), "Problem(A); AbstractGenerator"),
    "P nothing": (lambda: solve(problem(P=lambda args: None)), "Problem(P); NoneType"),
    "A a matrix": (lambda: problem(A=jnp.eye(2)), "Problem(A); a generator; Dense(M)"),
    "P a number": (lambda: problem(P=1.0), "Problem(P); an operator; Scaling(1.0)"),
    "K a pair": (lambda: problem(K=(0.0, 1.0)), "Problem(K); a set; Box(lower, upper)"),
    "bounds that cross by roundoff": (
        lambda: sets.Box(0.1 + 0.2, 0.3),
        "Box(lower, upper); 0.30000000000000004; 0.29999999999999999",
    ),
    "u of a callable K": (
        lambda: solve(
            problem(K=lambda t, args: sets.Box(-jnp.ones(3), 1.0), h=lambda t, x, u, args: -x[:3]),
            x0=jnp.zeros(5),
        ),
        "a callable K fixes no shape",
    ),
    "f a number": (lambda: problem(f=1.0), "Problem(f); f=lambda t, x, u, args"),
    "a space of text": (lambda: problem(state_space="R2"), "Problem(state_space); a space"),
    "a space of a number": (
        lambda: problem(control_space=3),
        "Problem(control_space); Euclidean(3)",
    ),
}

ARGUMENTS = {
    "x0 a flag": (lambda: solve(x0=True), "x0; True"),
    "x0 complex": (lambda: solve(x0=1j), "x0; 1j"),
    "x0 complex array": (lambda: solve(x0=jnp.array([1j])), "x0; states are real"),
    "x0 text": (lambda: solve(x0="a"), "x0; str 'a'"),
    "x0 none": (lambda: solve(x0=None), "x0; None"),
    "x0 dict": (lambda: solve(x0={"a": 1.0}), "x0; dict"),
    "x0 empty": (lambda: solve(x0=jnp.zeros(0)), "x0; at least one entry"),
    "x0 empty tuple": (lambda: solve(x0=()), "x0; ()"),
    "x0 NaN": (lambda: solve(x0=jnp.array([0.0, nan])), "x0; nan at index (1,)"),
    "x0 ragged": (lambda: solve(x0=[[1.0], [2.0, 3.0]]), "x0; [[1.0], [2.0, 3.0]]"),
    "x0 integers": (lambda: solve(x0=jnp.array([1, 2])), "x0; int64"),
    "x0 single, A double": (
        lambda: solve(problem(A=ROTATION), jnp.ones(2, jnp.float32)),
        "Problem(A); float64; float32",
    ),
    "x0 single, f double": (
        lambda: of_f(lambda t, x, u, a: x * jnp.ones(()).astype(float), x0=jnp.float32(1.0)),
        "Problem(f); float64; float32",
    ),
    "t0 text": (lambda: solve(t0="0"), "(t0); '0'; one real number"),
    "t0 none": (lambda: solve(t0=None), "(t0); None"),
    "t0 array": (lambda: solve(t0=jnp.zeros(2)), "(t0); [0. 0.]"),
    "t1 complex": (lambda: solve(t1=1j), "(t1); 1j"),
    "t1 before t0": (lambda: solve(t1=-1.0), "0.0, -1.0; t0 < t1"),
    "t1 at t0": (lambda: solve(t1=0.0), "0.0, 0.0; t0 < t1"),
    "t1 infinite": (lambda: solve(t1=inf), "0.0, inf; t0 < t1"),
    "t1 NaN": (lambda: solve(t1=nan), "0.0, nan; t0 < t1"),
    "a span that overflows": (lambda: solve(t0=-1e308, t1=1e308), "t1 − t0 must be finite"),
    "a span that underflows": (lambda: solve(t0=0.0, t1=5e-324), "t1 − t0 must be at least"),
    "ts text": (lambda: solve(ts="a"), "(ts); 'a'"),
    "ts unsorted": (lambda: solve(ts=[1.0, 0.0]), "(ts); increasing times in [0.0, 1.0]"),
    "ts NaN": (lambda: solve(ts=[0.0, nan]), "(ts); nan"),
    "ts empty": (lambda: solve(ts=[]), "(ts); nothing"),
    "ts outside": (lambda: solve(ts=[0.0, 2.0]), "(ts); in [0.0, 1.0]"),
    "ts of two axes": (lambda: solve(ts=[[0.5]]), "(ts); a vector"),
    "dt 0": (lambda: solve(dt=0.0), "(dt); positive"),
    "dt negative": (lambda: solve(dt=-1.0), "(dt); -1.0"),
    "dt NaN": (lambda: solve(dt=nan), "(dt); nan"),
    "dt text": (lambda: solve(dt="0.1"), "(dt); '0.1'"),
    "dt array": (lambda: solve(dt=jnp.ones(2)), "(dt); [1. 1.]"),
    "dt tiny": (lambda: solve(dt=1e-20), "(dt); a run has at most"),
    "rtol negative": (lambda: solve(rtol=-1.0), "(rtol); -1.0; ≥ 0"),
    "rtol none": (lambda: solve(rtol=None), "(rtol); None"),
    "rtol text": (lambda: solve(rtol="a"), "(rtol); 'a'"),
    "no tolerance": (lambda: solve(rtol=0.0, atol=0.0), "rtol, atol; one of them must be positive"),
    "atol NaN": (lambda: solve(atol=nan), "(atol); nan"),
    "horizon 0": (lambda: solve(horizon=0.0), "(horizon); 0.0"),
    "dt0 infinite": (lambda: solve(dt0=inf), "(dt0); inf"),
    "method a class": (lambda: solve(method=dvax.ETD2RK), "(method); dvax.ETD2RK()"),
    "method text": (lambda: solve(method="ETD2RK"), "(method); 'ETD2RK'"),
    "vi_solver text": (lambda: solve(vi_solver="auto"), "(vi_solver); dvax.vi.Auto()"),
    "vi_solver a class": (lambda: solve(vi_solver=dvax.vi.Auto), "(vi_solver); dvax.vi.Auto()"),
    "max_steps 0": (lambda: solve(max_steps=0), "(max_steps); whole number from 1"),
    "max_steps a fraction": (lambda: solve(max_steps=1.5), "(max_steps); 1.5"),
    "max_steps text": (lambda: solve(max_steps="9"), "(max_steps); '9'"),
    "max_steps huge": (lambda: solve(max_steps=2**40), "(max_steps); 2147483647"),
    "adjoint": (lambda: solve(adjoint="backward"), "(adjoint); 'backward'"),
    "measure text": (lambda: solve(measure="yes"), "(measure); 'yes'"),
    "dense text": (lambda: solve(dense="yes"), "(dense); 'yes'"),
    "dense without end": (
        lambda: jax.jit(lambda x0: solve(x0=x0, dense=True, max_steps=2**31 - 1))(jnp.zeros(1000)),
        "GiB; max_steps",
    ),
    "constants text": (lambda: solve(constants="a"), "(constants); 'a'"),
    "γ negative": (lambda: solve(constants=Moduli(-1.0)), "constants.gamma; -1.0"),
    "γ NaN": (lambda: solve(constants=Moduli(nan)), "constants.gamma; nan"),
    "no constants": (lambda: solve(certified_tol=1e-3), "(constants); None"),
    "certified_tol text": (
        lambda: solve(certified_tol="a", constants=verify().constants),
        "(certified_tol); a",
    ),
    "certified_tol negative": (
        lambda: solve(certified_tol=-1e-3, constants=verify().constants),
        "(certified_tol); -0.001",
    ),
    "args that cannot be hashed": (lambda: solve(args={"a": {1, 2}}), "args; set {1, 2}; hashable"),
    "args NaN": (lambda: of_f(lambda t, x, u, args: args * u, args=nan), "(args); nan"),
    "an index that is too large": (
        lambda: of_f(lambda t, x, u, args: -x + x[3], x0=jnp.zeros(3)),
        "Problem(f); newcomer.py, line; the index 3 into an axis of 3 entries; from 0 to 2",
    ),
    "an index that is too small": (
        lambda: of_f(lambda t, x, u, args: -x + x[-4], x0=jnp.zeros(3)),
        "Problem(f); the index -1 (after JAX added the number of entries)",
    ),
    "args NaN in a dictionary": (
        lambda: of_f(lambda t, x, u, args: args["k"] * u, args={"b": 1.0, "k": nan}),
        "(args); nan in ['k']",
    ),
    "A NaN": (lambda: solve(problem(A=generators.Scalar(nan))), "Problem(A); nan"),
    "A NaN in a matrix": (
        lambda: solve(
            problem(A=generators.Dense(jnp.array([[0.0, nan], [0.0, 0.0]]))), jnp.zeros(2)
        ),
        "Problem(A); nan in component (0, 1)",
    ),
    "P NaN": (lambda: operators.Scaling(nan), "Scaling(b); nan"),
    "K NaN": (lambda: sets.Box(0.0, nan), "Box(upper); nan; NaN"),
    "K empty": (
        lambda: sets.Box(jnp.zeros(300), -jnp.ones(300)),
        "lower = 0, upper = -1 in entry (0,) (300 of 300",
    ),
    "K empty at t0": (
        lambda: solve(problem(K=lambda t, a: sets.Box(1.0, 0.0 * t))),
        "Box(lower, upper); lower = 1, upper = 0",
    ),
    "no problem": (lambda: solve("x"), "(problem); str; dvax.Problem"),
    "a model": (
        lambda: solve(
            dvax.models.Contact(
                alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0, kappa0=0.5, g=1.0, ell=3.0
            )
        ),
        "Contact; model.problem",
    ),
    "K single, x0 double": (
        lambda: solve(problem(K=sets.Box(jnp.float32(0.0), jnp.float32(0.5)))),
        "Problem(K); data of float32; of float64; jnp.float64",
    ),
    "P single, x0 double": (
        lambda: solve(problem(P=operators.Scaling(jnp.float32(2.0)))),
        "Problem(P); data of float32; of float64",
    ),
    "bounds of two shapes": (lambda: sets.Box(jnp.zeros(2), jnp.ones(3)), "shapes (2,) and (3,)"),
    "P infinite": (lambda: operators.Scaling(inf), "Scaling(b); inf; bounded"),
    "dt and dt_max": (lambda: solve(dt=0.1, dt_max=0.2), "(dt_max); with dt all steps; Omit"),
    "dt and dt0": (lambda: solve(dt=0.1, dt0=0.2), "(dt0); with dt all steps; Omit"),
    "dt_max tiny": (lambda: solve(dt_max=1e-12), "(dt_max); max_steps = 1048576; 9.5e-07 or more"),
    "dt_max of events": (
        lambda: solve(method=dvax.PiecewiseLinear(), dt_max=0.1),
        "(dt_max); from one change of the constraints",
    ),
    "vi_solver of events": (
        lambda: solve(method=dvax.PiecewiseLinear(), vi_solver=dvax.vi.Auto()),
        "(vi_solver); closed form",
    ),
    "progress text": (lambda: solve(progress="yes"), "(progress); 'yes'"),
    "table of text": (lambda: signals.Table("a", "b"), "Table(times); 'a'; numbers"),
    "space of a negative number": (lambda: dvax.spaces.Euclidean(-1), "Euclidean(shape); -1"),
    "space of text in a tuple": (lambda: dvax.spaces.Euclidean(("a",)), "Euclidean(shape); ('a',)"),
    "response at text": (lambda: PLAIN.response("a", 0.1), "t; str 'a'"),
    "P of another size": (
        lambda: solve(
            problem(
                P=operators.Dense(jnp.eye(3)),
                h=lambda t, x, u, args: x,
                f=lambda t, x, u, args: u[:2],
            ),
            jnp.zeros(2),
        ),
        "Problem(h); (2,); u of shape (3,) (which P, Dense and K, Box, fix)",
    ),
}
VERIFY = {
    "a vector problem": (
        lambda: verify(problem(f=lambda t, x, u, a: x[0] * u)),
        "verify(x0); Pass any state; newcomer.py, line",
    ),
    "f of three": (lambda: verify(problem(f=lambda t, x, u: x)), "a function of (t, x, u)"),
    "no problem": (lambda: dvax.verify(None), "verify(problem); NoneType"),
    "x0 NaN": (lambda: verify(None, nan), "verify(x0); nan"),
    "t0 NaN": (lambda: verify(t0=nan), "verify(t0, t1); nan"),
    "t0 text": (lambda: verify(t0="a"), "verify(t0, t1); 'a'"),
    "t1 before t0": (lambda: verify(t1=-1.0), "t0 < t1"),
    "an empty region": (lambda: verify(x=(1.0, 0.0)), "verify(x); low ≤ high"),
    "half a region": (lambda: verify(x=1.0), "verify(x); a pair (low, high)"),
    "a NaN in a region": (lambda: verify(u=(nan, 0.0)), "verify(u); nan"),
    "an unknown modulus": (lambda: verify(declared={"gam": 1.0}), "verify(declared); 'gam'"),
    "a modulus of text": (lambda: verify(declared={"gamma": "one"}), "declared['gamma']; 'one'"),
    "a modulus of NaN": (lambda: verify(declared={"gamma": nan}), "declared['gamma']; nan"),
    "a modulus below 0": (
        lambda: verify(declared={"gamma": -1.0}),
        "declared['gamma']; -1.0; positive",
    ),
    "moduli in a list": (lambda: verify(declared=[1]), "verify(declared); 'list'"),
    "A NaN": (lambda: verify(problem(A=generators.Scalar(nan))), "Problem(A); nan"),
    "args NaN": (lambda: verify(problem(f=lambda t, x, u, a: a * u), args=nan), "(args); nan"),
    "bound of nothing": (
        lambda: dvax.bound_error(PLAIN, None, verify().constants),
        "bound_error(sol); NoneType; the result of dvax.solve",
    ),
    "bound with a verification": (
        lambda: dvax.bound_error(PLAIN, solve(), verify()),
        "bound_error(constants); Verification; dvax.verify(problem, x0).constants",
    ),
    "parameters, t0 text": (lambda: dvax.parameter_bounds(PLAIN, 0.0, 1.0, t0="a"), "'a'"),
}
CASES = {"functions": FUNCTIONS, "arguments": ARGUMENTS, "verify": VERIFY}

if __name__ == "__main__":
    print_all(CASES)
