"""Times at which the code of f, h or K switches: comparisons of an affine function of t, read off it.

    jnp.where(t < a, …)     t − a > 0     t >= 2 * a + b     jnp.sign(t − a)     jnp.maximum(t, a)
    jnp.interp(t, times, values)     values[jnp.searchsorted(times, t)]

compare st + c, with s and c independent of t, x and u, with 0. The switch is at −c/s, a function of the
parameters that is differentiated as any other knot. Functions that are affine in pieces (|t − a| < w, a
tent) switch where any two of their lines meet, which includes all of their kinks. Of the program traced
with t, x and u as arguments every value is one of

- *fixed*: independent of t, x and u;
- *lines*: equal to one of s₁t + c₁, …, sₖt + cₖ at any time;
- *of time*: another function of t, remembering comparisons that were not resolved;
- *other*: a function of x or u. A comparison of those is an event, and nothing is said of it.

The switches of a comparison of time that is not affine (sin(t) < a), of a loop that compares time, and
of a step function of it (floor(t/a), t % a) are not found. Where such a comparison chooses, a
derivative in what it compares is refused.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from . import _tree
from ._jaxpr import bound, is_search, scan_counts, walked
from .errors import DifferentiationError
from .vi.structure import CALLS, CUSTOM, inner_jaxpr


class _Lazy:
    """A value that is computed when it is needed: few of them are."""

    def __init__(self, make: Callable[[], Any]):
        self.make, self.known = make, None

    def get(self) -> Any:
        if self.make is not None:
            self.known, self.make = self.make(), None
        return self.known


class _Fixed(_Lazy):
    """Independent of t, x and u."""


class _Line:
    """slope · t + offset."""

    def __init__(self, slope: _Lazy, offset: _Lazy):
        self.slope, self.offset = slope, offset


_MOST = 8
"""Lines of one value; with more it counts as any function of time."""


class _Lines(_Lazy):
    """One of these `lines` at any time; as a value, that at one time."""

    def __init__(self, lines: list[_Line], make: Callable[[], Any]):
        super().__init__(make)
        self.lines = lines


class _OfTime:
    """Another function of t, as it is at one time. `pending`: the operands of comparisons that decide
    it and are not resolved, with their places."""

    def __init__(self, value: _Lazy, pending: tuple = (), is_flag: bool = False):
        self.value, self.pending, self.is_flag = value, pending, is_flag


_OTHER = object()
_COMPARE = {"lt", "le", "gt", "ge", "lt_to", "le_to"}
_MOVING_PLACES = {
    "broadcast_in_dim", "reshape", "squeeze", "expand_dims", "copy", "copy_p", "transpose", "rev",
    "slice", "stop_gradient", "reduce_precision",
}  # fmt: skip
_LOGIC = {"and", "or", "not", "xor", "eq", "ne"} | _MOVING_PLACES


def switching_times(fn: Callable[..., list[Any]], t: Any, x: Any, u: Any) -> list[jax.Array]:
    """Return the times, in vectors, at which the code of fn(t, x, u) switches; infinite where there is
    none. With them those that fn returns: a list of vectors of times, computed from parameters alone.
    `t` is a time of the run, at which functions of time alone are evaluated."""
    traced = jax.make_jaxpr(fn)(t, x, u)
    count = len(jtu.tree_leaves((x, u)))
    one, zero = (_Fixed(partial(jnp.full, (), v, jnp.result_type(t))) for v in (1.0, 0.0))
    found: list[jax.Array] = []
    reader = _Reader(jax.lax.stop_gradient(t), found)
    known = reader.read(traced, [_Lines([_Line(one, zero)], lambda: reader.t), *[_OTHER] * count])
    return found + [jnp.ravel(v.get() if isinstance(v, _Fixed) else v) for v in known]


class _Reader:
    def __init__(self, t: Any, found: list[Any]):
        self.t, self.found = t, found

    def read(self, traced: ClosedJaxpr, given: list[Any]) -> list[Any]:
        return walked(traced, given, self._apply)

    def _apply(self, eqn: Any, given: list[Any]) -> list[Any]:
        name = eqn.primitive.name
        given = [
            v if isinstance(v, _Fixed | _Lines | _OfTime) or v is _OTHER else _fixed(v)
            for v in given
        ]
        if name == "select_n" and isinstance(given[0], _OfTime) and not _is_check(given[1:]):
            self._refuse(given[0].pending)
        if name in _STEPS or (name == "convert_element_type" and _becomes_whole(eqn)):
            if isinstance(given[0], _Lines | _OfTime):
                self._refuse(((self._operands(given), _place(eqn)),))
        if name in ("scan", "while") and _compares_time(eqn, given):
            self._refuse(((self._operands(given), _place(eqn)),))
        if any(v is _OTHER for v in given):
            # What it compares is an event; what else a select chooses by is not known to be one.
            inner = self._inner(eqn, given)
            return inner or [_OTHER] * len(eqn.outvars)
        if all(isinstance(v, _Fixed) for v in given):
            return self._lazily(eqn, given, _Fixed)
        if is_search(eqn):
            row, lines = map(_as_lines, given)
            if row is not None and lines is not None and len(row) == 1:
                self.found += [_meeting(line, row[0]) for line in lines]
                return self._lazily(eqn, given, lambda m: _OfTime(_Lazy(m)))
        inner = self._inner(eqn, given)
        if inner is not None:
            return inner
        pending = tuple(p for v in given if isinstance(v, _OfTime) for p in v.pending)
        if name in _COMPARE or name in ("max", "min", "sign", "abs", "clamp"):
            pending += self._compared(name, eqn, given)
        if pending and self._jumps(name, given):
            self._refuse(pending)
            pending = ()
        elif not (pending and name == "select_n"):
            lines = self._lines(name, eqn, given)
            if lines is not None and len(lines) <= _MOST:
                return [_Lines(lines, lambda: _done(eqn, [self._value(v) for v in given])[0])]
        is_flag = name in _COMPARE or name in _LOGIC
        return self._lazily(eqn, given, lambda m: _OfTime(_Lazy(m), pending if is_flag else ()))

    def _inner(self, eqn: Any, given: list[Any]) -> list[Any] | None:
        name = eqn.primitive.name
        if name not in CALLS and name not in CUSTOM:
            return None
        if str(eqn.params.get("name", "")).startswith("dvax_"):
            return None  # tables announce their knots
        inner = inner_jaxpr(eqn.params)
        if inner is None or len(inner.jaxpr.invars) != len(given):
            return None
        return self.read(inner, given)

    def _lazily(self, eqn: Any, given: list[Any], kind: Callable[..., Any]) -> list[Any]:
        every = _Lazy(lambda: _done(eqn, [self._value(v) for v in given]))
        return [kind(lambda k=k: every.get()[k]) for k in range(len(eqn.outvars))]

    def _value(self, v: Any) -> Any:
        return v.value.get() if isinstance(v, _OfTime) else v.get()

    def _lines(self, name: str, eqn: Any, given: list[Any]) -> list[_Line] | None:
        """The lines of the outcome, where it consists of such."""
        do = lambda *v: _done(eqn, list(v))[0]  # noqa: E731
        each = [lines for v in given if (lines := _as_lines(v)) is not None]
        known = len(each) == len(given)
        floating = jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.floating)
        if name in ("add", "sub", "add_any") and known:
            return [_both(do, p, q) for p in each[0] for q in each[1]]
        if name == "neg" or name in _MOVING_PLACES or name == "convert_element_type":
            if floating and isinstance(given[0], _Lines):
                return [_both(do, line) for line in given[0].lines]
        if name == "mul" and isinstance(given[1], _Lines) and isinstance(given[0], _Fixed):
            return [_both(lambda v: do(given[0].get(), v), line) for line in given[1].lines]
        if name in ("mul", "div") and isinstance(given[0], _Lines) and isinstance(given[1], _Fixed):
            return [_both(lambda v: do(v, given[1].get()), line) for line in given[0].lines]
        if name == "abs" and isinstance(given[0], _Lines):
            return [*given[0].lines, *(_both(jnp.negative, line) for line in given[0].lines)]
        if name == "select_n":
            each = [lines for v in given[1:] if (lines := _as_lines(v)) is not None]
            known = len(each) == len(given) - 1
        if name in ("max", "min", "clamp", "select_n") and floating and known:
            shape = eqn.outvars[0].aval.shape
            over = lambda v: jnp.broadcast_to(v, shape)  # noqa: E731
            return [_both(over, line) for lines in each for line in lines]
        return None

    def _compared(self, name: str, eqn: Any, given: list[Any]) -> tuple:
        """Keep where lines cross; return what is not resolved."""
        if name in ("sign", "abs"):
            pairs = [(given[0], _fixed(np.zeros((), eqn.invars[0].aval.dtype)))]
        elif name == "clamp":
            pairs = [(given[1], given[0]), (given[1], given[2])]
        else:
            pairs = [(given[0], given[1])]
        pending: tuple = ()
        for a, b in pairs:
            p, q = _as_lines(a), _as_lines(b)
            if not any(isinstance(v, _Lines | _OfTime) for v in (a, b)):
                continue
            if p is None or q is None:
                if name in _COMPARE or name == "sign":
                    operands = [_Lazy(partial(self._value, v)) for v in (a, b)]
                    pending += ((operands, _place(eqn)),)
                continue
            self.found += [_meeting(left, right) for left in p for right in q]
        return pending

    def _jumps(self, name: str, given: list[Any]) -> bool:
        """Whether what is decided so is surely not continuous."""
        if name == "select_n":
            cases = given[1:]
            if not all(isinstance(v, _Fixed) for v in cases):
                return False
            values = [v.get() for v in cases]
            if not _tree.is_concrete(values):
                return True
            return any(not np.array_equal(v, values[0]) for v in values[1:])
        return name in ("convert_element_type", "sign")

    def _operands(self, given: list[Any]) -> list[Any]:
        return [_Lazy(partial(self._value, v)) for v in given if v is not _OTHER]

    def _refuse(self, pending: tuple) -> None:
        for operands, place in pending:
            values = [v.get() for v in operands]
            real = [v for v in values if jnp.issubdtype(jnp.result_type(v), jnp.floating)]
            if not _tree.is_concrete(real):
                self.found.append(_undifferentiated(place)(*real))


def _is_check(cases: list[Any]) -> bool:
    """Whether one of the cases stands for what is not valid: infinity, or NaN."""
    values = [v.get() for v in cases if isinstance(v, _Fixed)]
    return any(_tree.is_concrete(v) and not np.all(np.isfinite(np.asarray(v))) for v in values)


_STEPS = {"floor", "ceil", "round", "rem"}


def _becomes_whole(eqn: Any) -> bool:
    kinds = [jnp.issubdtype(v.aval.dtype, jnp.floating) for v in (eqn.invars[0], eqn.outvars[0])]
    return kinds == [True, False]


def _compares_time(eqn: Any, given: list[Any]) -> bool:
    """Whether the body of a loop compares what depends on time, and not on x or u."""
    if eqn.primitive.name == "scan":
        bodies, first = [eqn.params["jaxpr"]], 0
        fixed, carries = scan_counts(eqn.params) or (0, 0)
        back = {fixed + k: k for k in range(carries)}
        inputs = [given]
    else:
        first, second = eqn.params["cond_nconsts"], eqn.params["body_nconsts"]
        bodies = [eqn.params["cond_jaxpr"], eqn.params["body_jaxpr"]]
        carried = given[first + second :]
        inputs = [[*given[:first], *carried], [*given[first : first + second], *carried]]
        back = {second + k: k for k in range(len(carried))}
    kinds = [[_dependence(v) for v in row] for row in inputs]
    # What a turn carries on may depend on more than what it began with.
    for _ in range(len(given) + 1):
        out = _tainted(bodies[-1], kinds[-1])[1]
        for place, k in back.items():
            kinds[-1][place] = kinds[-1][place] | out[k]
    if eqn.primitive.name == "while":
        for k in range(len(back)):
            kinds[0][first + k] = kinds[-1][eqn.params["body_nconsts"] + k]
    return any(_tainted(body, row)[0] for body, row in zip(bodies, kinds, strict=True))


def _dependence(v: Any) -> set[str]:
    if v is _OTHER:
        return {"x"}
    return {"t"} if isinstance(v, _Lines | _OfTime) else set()


def _tainted(program: ClosedJaxpr, given: list[set[str]]) -> tuple[bool, list[set[str]]]:
    """(whether a comparison of time alone is in it, what the outputs depend on)."""
    known: dict[Any, set[str]] = dict(zip(program.jaxpr.invars, given, strict=True))
    of = lambda v: set() if isinstance(v, Literal) else known.get(v, set())  # noqa: E731
    found = False
    for eqn in program.jaxpr.eqns:
        depends = set().union(*map(of, eqn.invars))
        name = eqn.primitive.name
        found |= name in _COMPARE | _STEPS and depends == {"t"}
        inner = inner_jaxpr(eqn.params) if name in CALLS or name in CUSTOM else None
        if inner is not None and len(inner.jaxpr.invars) == len(eqn.invars):
            found |= _tainted(inner, list(map(of, eqn.invars)))[0]
        known |= dict.fromkeys(eqn.outvars, depends)
    return found, list(map(of, program.jaxpr.outvars))


def _undifferentiated(place: str) -> Callable[..., jax.Array]:
    """A function that returns one infinite time; a derivative in its arguments raises."""

    @jax.custom_jvp
    def never(*values: Any) -> jax.Array:
        return jnp.full(1, jnp.inf)

    @partial(never.defjvp, symbolic_zeros=True)
    def _(primals: tuple, tangents: tuple) -> Any:
        if all(isinstance(v, jax.custom_derivatives.SymbolicZero) for v in tangents):
            return never(*primals), jnp.zeros(1)
        raise DifferentiationError(
            f"f, h or K may jump at a time that depends on a parameter which is differentiated, by a "
            "comparison that is not affine in t, a step function (floor, round, %) or a loop"
            f"{place}: the derivative of that time is not known. "
            "Write the switch as a comparison of t itself with the time of the jump (t < a), or "
            "name that time in the knots of a dvax.signals.Function or as a time of a "
            "dvax.signals.Table."
        )

    return never


def _fixed(value: Any) -> _Fixed:
    return _Fixed(lambda: value)


def _done(eqn: Any, given: list[Any]) -> list[Any]:
    """One operation; on known numbers at once, also within a program that is being traced."""
    if _tree.is_concrete(given):
        with jax.ensure_compile_time_eval():
            return bound(eqn, given)
    return bound(eqn, given)


def _as_lines(v: Any) -> list[_Line] | None:
    if isinstance(v, _Lines):
        return v.lines
    if not isinstance(v, _Fixed):
        return None
    return [_Line(_Fixed(lambda: jnp.zeros_like(jnp.asarray(v.get()))), v)]


def _meeting(p: _Line, q: _Line) -> jax.Array:
    """The times where two lines meet, infinite where they do not."""
    slope, offset = p.slope.get() - q.slope.get(), p.offset.get() - q.offset.get()
    slope, offset = jnp.broadcast_arrays(slope, offset)
    moves = slope != 0
    times = -offset / jnp.where(moves, slope, jnp.ones_like(slope))
    return jnp.where(moves, times, jnp.inf).ravel()


def _both(do: Callable[..., Any], *lines: Any) -> _Line:
    slope = _Fixed(lambda: do(*(line.slope.get() for line in lines)))
    return _Line(slope, _Fixed(lambda: do(*(line.offset.get() for line in lines))))


def _place(eqn: Any) -> str:
    """Where in the caller's source an operation is written."""
    traceback = getattr(getattr(eqn, "source_info", None), "traceback", None)
    for frame in getattr(traceback, "frames", ()):
        inside = ("site-packages", "/dvax/", "<frozen", "<string>")
        if not any(part in frame.file_name for part in inside):
            return f" ({frame.file_name}, line {frame.line_num})"
    return ""
