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

from .. import _tree
from .._jax.jaxprs import Literal, bind, inner_program, operation, scan_counts
from ..errors import DifferentiationError
from .interpreter import Domain, Rule, interpret, is_real, same_for
from .primitives import LOGICAL, ORDERING, REARRANGING, TABLES


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


def switching_times(fn: Callable[..., list[Any]], t: Any, x: Any, u: Any) -> list[jax.Array]:
    """Return the times, in vectors, at which the code of fn(t, x, u) switches; infinite where there is
    none. With them those that fn returns: a list of vectors of times, computed from parameters alone.
    `t` is a time of the run, at which functions of time alone are evaluated."""
    count = len(jtu.tree_leaves((x, u)))
    one, zero = (_Fixed(partial(jnp.full, (), v, jnp.result_type(t))) for v in (1.0, 0.0))
    found: list[jax.Array] = []
    reader, now = _Reader(found), jax.lax.stop_gradient(t)
    domain = Domain(RULES, _is_variable, reader.unknown, reader.apply, _lazily_fixed)
    given = [_Lines([_Line(one, zero)], lambda: now), *[_OTHER] * count]
    results = interpret(jax.make_jaxpr(fn)(t, x, u), given, domain)
    return found + [jnp.ravel(v.get() if isinstance(v, _Fixed) else v) for v in results]


class _Reader:
    """Collects the times that are found."""

    def __init__(self, found: list[Any]):
        self.found = found

    def unknown(self, eqn: Any, given: list[Any]) -> list[Any]:
        """The results of an operation that makes no lines."""
        return self._results(None, eqn, list(map(_wrapped, given)))

    def apply(self, rule: Rule, eqn: Any, given: list[Any]) -> list[Any] | None:
        """The results of an operation, whose `rule` gives the lines that they are made of."""
        given = list(map(_wrapped, given))
        if operation(eqn) == "searchsorted":
            return self._search(eqn, given)
        return self._results(rule, eqn, given)

    def _results(self, rule: Rule | None, eqn: Any, given: list[Any]) -> list[Any]:
        name = eqn.primitive.name
        if name == "select_n" and isinstance(given[0], _OfTime) and not _is_check(given[1:]):
            self._refuse(given[0].pending)
        if name in _STEPS or (name == "convert_element_type" and _becomes_whole(eqn)):
            if isinstance(given[0], _Lines | _OfTime):
                self._refuse(((_operands(given), _place(eqn)),))
        if name in ("scan", "while") and _compares_time(eqn, given):
            self._refuse(((_operands(given), _place(eqn)),))
        if any(v is _OTHER for v in given):
            # What it compares is an event; what else a select chooses by is not known to be one.
            return [_OTHER] * len(eqn.outvars)
        pending = tuple(p for v in given if isinstance(v, _OfTime) for p in v.pending)
        if name in ORDERING or name in ("max", "min", "sign", "abs", "clamp"):
            pending += self._compared(name, eqn, given)
        if pending and _jumps(name, given):
            self._refuse(pending)
            pending = ()
        elif rule is not None and not (pending and name == "select_n"):
            lines = rule(eqn, given)
            if lines is not None and len(lines) <= _MOST:
                return [_Lines(lines, lambda: _done(eqn, list(map(_value, given)))[0])]
        is_flag = name in _FLAGS
        return _lazily(eqn, given, lambda m: _OfTime(_Lazy(m), pending if is_flag else ()))

    def _search(self, eqn: Any, given: list[Any]) -> list[Any] | None:
        """A place in a sorted row, which changes where t meets its entries; None for a place of
        anything that is not made of lines."""
        row, lines = map(_as_lines, given)
        if row is None or lines is None or len(row) != 1:
            return None
        self.found += [_meeting(line, row[0]) for line in lines]
        return _lazily(eqn, given, lambda m: _OfTime(_Lazy(m)))

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
                if name in ORDERING or name == "sign":
                    pending += ((_operands([a, b]), _place(eqn)),)
                continue
            self.found += [_meeting(left, right) for left in p for right in q]
        return pending

    def _refuse(self, pending: tuple) -> None:
        for operands, place in pending:
            values = [v.get() for v in operands]
            real = [v for v in values if jnp.issubdtype(jnp.result_type(v), jnp.floating)]
            if not _tree.is_concrete(real):
                self.found.append(_undifferentiated(place)(*real))


def _is_variable(v: Any) -> bool:
    return isinstance(v, _Lines | _OfTime) or v is _OTHER


def _wrapped(v: Any) -> Any:
    return v if isinstance(v, _Fixed) or _is_variable(v) else _fixed(v)


def _value(v: Any) -> Any:
    return v.value.get() if isinstance(v, _OfTime) else v.get()


def _operands(given: list[Any]) -> list[_Lazy]:
    return [_Lazy(partial(_value, v)) for v in given if v is not _OTHER]


def _lazily(eqn: Any, given: list[Any], kind: Callable[..., Any]) -> list[Any]:
    every = _Lazy(lambda: _done(eqn, list(map(_value, given))))
    return [kind(lambda k=k: every.get()[k]) for k in range(len(eqn.outvars))]


def _lazily_fixed(eqn: Any, given: list[Any]) -> list[Any]:
    return _lazily(eqn, list(map(_wrapped, given)), _Fixed)


def _jumps(name: str, given: list[Any]) -> bool:
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


# The lines that a result is made of; None where it is not made of lines.

_Some = list[_Line] | None


def _sum(eqn: Any, given: list[Any]) -> _Some:
    first, second = map(_as_lines, given)
    if first is None or second is None:
        return None
    return [_both(partial(_one, eqn), p, q) for p in first for q in second]


def _linear(eqn: Any, given: list[Any]) -> _Some:
    if not isinstance(given[0], _Lines) or not is_real(eqn.outvars[0].aval):
        return None
    return [_both(partial(_one, eqn), line) for line in given[0].lines]


def _multiple(eqn: Any, given: list[Any]) -> _Some:
    first, second = given
    if isinstance(first, _Lines) and isinstance(second, _Fixed):
        return [_both(lambda v: _one(eqn, v, second.get()), line) for line in first.lines]
    if eqn.primitive.name == "mul" and isinstance(second, _Lines) and isinstance(first, _Fixed):
        return [_both(lambda v: _one(eqn, first.get(), v), line) for line in second.lines]
    return None


def _modulus(eqn: Any, given: list[Any]) -> _Some:
    if not isinstance(given[0], _Lines):
        return None
    lines = given[0].lines
    return [*lines, *(_both(jnp.negative, line) for line in lines)]


def _one_of(eqn: Any, given: list[Any]) -> _Some:
    out = eqn.outvars[0].aval
    over = lambda v: jnp.broadcast_to(v, out.shape)  # noqa: E731
    each = [lines for v in given if (lines := _as_lines(v)) is not None]
    if not is_real(out) or len(each) != len(given):
        return None
    return [_both(over, line) for lines in each for line in lines]


def _no_lines(eqn: Any, given: list[Any]) -> None:
    """Of a comparison, which has its crossings; and of a table, which announces its knots."""


RULES: dict[str, Rule] = {
    **same_for({"add", "sub", "add_any"}, _sum),
    **same_for(REARRANGING | {"reduce_precision", "neg", "convert_element_type"}, _linear),
    **same_for({"mul", "div"}, _multiple),
    **same_for({"max", "min", "clamp"}, _one_of),
    "abs": _modulus,
    "select_n": lambda eqn, given: _one_of(eqn, given[1:]),
    **same_for(ORDERING | {"sign", "searchsorted"}, _no_lines),
    **same_for(TABLES | {"dvax_lower_or_inf", "dvax_evaluate"}, _no_lines),
}

_FLAGS = ORDERING | LOGICAL | REARRANGING | {"eq", "ne", "reduce_precision"}
"""Operations whose results remember the comparisons that are not resolved."""


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


def _tainted(program: Any, given: list[set[str]]) -> tuple[bool, list[set[str]]]:
    """(whether a comparison of time alone is in it, what the outputs depend on)."""
    known: dict[Any, set[str]] = dict(zip(program.jaxpr.invars, given, strict=True))
    of = lambda v: set() if isinstance(v, Literal) else known.get(v, set())  # noqa: E731
    found = False
    for eqn in program.jaxpr.eqns:
        depends = set().union(*map(of, eqn.invars))
        name = eqn.primitive.name
        found |= name in ORDERING | _STEPS and depends == {"t"}
        if (inner := inner_program(eqn)) is not None:
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
            return bind(eqn, given)
    return bind(eqn, given)


def _one(eqn: Any, *given: Any) -> Any:
    return _done(eqn, list(given))[0]


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
