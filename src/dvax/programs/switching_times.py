"""Times at which the code of f, h or K switches, from comparisons of affine functions of t.

    jnp.where(t < a, …)     t − a > 0     t >= 2 * a + b     jnp.sign(t − a)     jnp.maximum(t, a)
    jnp.interp(t, times, values)     values[jnp.searchsorted(times, t)]

compare st + c with 0, where s and c are independent of t, x and u. The switch is at −c/s, a function of
the parameters that is differentiated like other knots. Piecewise affine functions (|t − a| < w, a tent)
switch where two of their lines intersect, which includes all of their kinks. The interpreter assigns
each value of the program to one of four classes:

- *fixed*: independent of t, x and u;
- *lines*: at any time equal to one of s₁t + c₁, …, sₖt + cₖ;
- *of time*: another function of t, with the unresolved comparisons on which it depends;
- *other*: a function of x or u. Comparisons of such values are events, not switching times.

The switches of comparisons that are not affine in t (sin(t) < a), of loops that compare time, and of
step functions of time (floor(t/a), t % a) are not found. If such a comparison selects a value, a
derivative with respect to its operands raises an error.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._jax.jaxprs import Literal, bind, inner_program, scan_counts
from .._jax.known_functions import operation
from ..errors import DifferentiationError
from .interpreter import Domain, Rule, interpret, is_real, same_for
from .primitives import LOGICAL, ORDERING, REARRANGING, TABLES


class _Lazy:
    """A value that is computed on first use, since few values are used."""

    def __init__(self, make: Callable[[], Any]):
        self.make, self.value = make, None

    def get(self) -> Any:
        if self.make is not None:
            self.value, self.make = self.make(), None
        return self.value


class _Fixed(_Lazy):
    """A value independent of t, x and u."""


class _Line:
    """The function slope · t + offset."""

    def __init__(self, slope: _Lazy, offset: _Lazy):
        self.slope, self.offset = slope, offset


_MAX_LINES = 8
"""Largest number of lines of one value; with more, the value counts as a general function of time."""


class _Lines(_Lazy):
    """A function that equals one of `lines` at any time, with its value at one time."""

    def __init__(self, lines: list[_Line], make: Callable[[], Any]):
        super().__init__(make)
        self.lines = lines


class _OfTime:
    """Another function of t, with its `value` at one time.

    `pending` lists the unresolved comparisons on which it depends: their operands, and their positions
    in the source.
    """

    def __init__(self, value: _Lazy, pending: tuple = ()):
        self.value, self.pending = value, pending


_OTHER = object()


def switching_times(fn: Callable[..., list[Any]], t: Any, x: Any, u: Any) -> list[jax.Array]:
    """Return vectors of times at which the code of fn(t, x, u) switches, infinite if there are none.

    They are followed by the outputs of fn, which must be vectors of times that depend on parameters
    only. `t` is a time of the run, at which functions of time are evaluated.
    """
    count = len(jtu.tree_leaves((x, u)))
    one, zero = (_Fixed(partial(jnp.full, (), v, jnp.result_type(t))) for v in (1.0, 0.0))
    times: list[jax.Array] = []
    collector, now = _Collector(times), jax.lax.stop_gradient(t)
    domain = Domain(RULES, _is_variable, collector.unknown, collector.apply, _lazily_fixed)
    inputs = [_Lines([_Line(one, zero)], lambda: now), *[_OTHER] * count]
    results = interpret(jax.make_jaxpr(fn)(t, x, u), inputs, domain)
    return times + [jnp.ravel(v.get() if isinstance(v, _Fixed) else v) for v in results]


class _Collector:
    """The functions of the domain; they append switching times to `times`."""

    def __init__(self, times: list[Any]):
        self.times = times

    def unknown(self, eqn: Any, operands: list[Any]) -> list[Any]:
        """Return the results of an operation without a rule."""
        return self._results(None, eqn, list(map(_wrapped, operands)))

    def apply(self, rule: Rule, eqn: Any, operands: list[Any]) -> list[Any] | None:
        """Return the results of an operation whose `rule` returns their lines."""
        operands = list(map(_wrapped, operands))
        if operation(eqn) == "searchsorted":
            return self._search(eqn, operands)
        return self._results(rule, eqn, operands)

    def _results(self, rule: Rule | None, eqn: Any, operands: list[Any]) -> list[Any]:
        name = eqn.primitive.name
        if name == "select_n" and isinstance(operands[0], _OfTime) and not _is_check(operands[1:]):
            self._refuse(operands[0].pending)
        if name in _STEPS or (name == "convert_element_type" and _becomes_integer(eqn)):
            if isinstance(operands[0], _Lines | _OfTime):
                self._refuse(((_operands(operands), _place(eqn)),))
        if name in ("scan", "while") and _compares_time(eqn, operands):
            self._refuse(((_operands(operands), _place(eqn)),))
        if any(v is _OTHER for v in operands):
            # Comparisons that involve x or u are events.
            return [_OTHER] * len(eqn.outvars)
        pending = tuple(p for v in operands if isinstance(v, _OfTime) for p in v.pending)
        if name in ORDERING or name in ("max", "min", "sign", "abs", "clamp"):
            pending += self._compare(name, eqn, operands)
        if pending and _is_discontinuous(name, operands):
            self._refuse(pending)
            pending = ()
        elif rule is not None and not (pending and name == "select_n"):
            lines = rule(eqn, operands)
            if lines is not None and len(lines) <= _MAX_LINES:
                return [_Lines(lines, lambda: _evaluate(eqn, list(map(_value, operands)))[0])]
        is_flag = name in _FLAGS
        return _lazily(eqn, operands, lambda m: _OfTime(_Lazy(m), pending if is_flag else ()))

    def _search(self, eqn: Any, operands: list[Any]) -> list[Any] | None:
        """Return the result of a search in a sorted array, which switches where t equals an entry; None
        if the arguments are not lines."""
        row, lines = map(_as_lines, operands)
        if row is None or lines is None or len(row) != 1:
            return None
        self.times += [_intersection(line, row[0]) for line in lines]
        return _lazily(eqn, operands, lambda m: _OfTime(_Lazy(m)))

    def _compare(self, name: str, eqn: Any, operands: list[Any]) -> tuple:
        """Append the intersections of compared lines; return the unresolved comparisons."""
        if name in ("sign", "abs"):
            pairs = [(operands[0], _fixed(np.zeros((), eqn.invars[0].aval.dtype)))]
        elif name == "clamp":
            pairs = [(operands[1], operands[0]), (operands[1], operands[2])]
        else:
            pairs = [(operands[0], operands[1])]
        pending: tuple = ()
        for a, b in pairs:
            p, q = _as_lines(a), _as_lines(b)
            if not any(isinstance(v, _Lines | _OfTime) for v in (a, b)):
                continue
            if p is None or q is None:
                if name in ORDERING or name == "sign":
                    pending += ((_operands([a, b]), _place(eqn)),)
                continue
            self.times += [_intersection(left, right) for left in p for right in q]
        return pending

    def _refuse(self, pending: tuple) -> None:
        """Append infinite times whose derivatives by the traced operands of comparisons raise."""
        for operands, place in pending:
            values = [v.get() for v in operands]
            real = [v for v in values if jnp.issubdtype(jnp.result_type(v), jnp.floating)]
            if not _tree.is_concrete(real):
                self.times.append(_undifferentiable(place)(*real))


def _is_variable(v: Any) -> bool:
    return isinstance(v, _Lines | _OfTime) or v is _OTHER


def _wrapped(v: Any) -> Any:
    return v if isinstance(v, _Fixed) or _is_variable(v) else _fixed(v)


def _value(v: Any) -> Any:
    return v.value.get() if isinstance(v, _OfTime) else v.get()


def _operands(operands: list[Any]) -> list[_Lazy]:
    return [_Lazy(partial(_value, v)) for v in operands if v is not _OTHER]


def _lazily(eqn: Any, operands: list[Any], kind: Callable[..., Any]) -> list[Any]:
    results = _Lazy(lambda: _evaluate(eqn, list(map(_value, operands))))
    return [kind(lambda k=k: results.get()[k]) for k in range(len(eqn.outvars))]


def _lazily_fixed(eqn: Any, operands: list[Any]) -> list[Any]:
    return _lazily(eqn, list(map(_wrapped, operands)), _Fixed)


def _is_discontinuous(name: str, operands: list[Any]) -> bool:
    """Return whether the result of an operation is certainly discontinuous at a switch."""
    if name == "select_n":
        cases = operands[1:]
        if not all(isinstance(v, _Fixed) for v in cases):
            return False
        values = [v.get() for v in cases]
        if not _tree.is_concrete(values):
            return True
        return any(not np.array_equal(v, values[0]) for v in values[1:])
    return name in ("convert_element_type", "sign")


# Each rule returns the lines of the result, or None if the result does not consist of lines.

_OptionalLines = list[_Line] | None


def _sum(eqn: Any, operands: list[Any]) -> _OptionalLines:
    first, second = map(_as_lines, operands)
    if first is None or second is None:
        return None
    return [_both(partial(_result, eqn), p, q) for p in first for q in second]


def _linear(eqn: Any, operands: list[Any]) -> _OptionalLines:
    if not isinstance(operands[0], _Lines) or not is_real(eqn.outvars[0].aval):
        return None
    return [_both(partial(_result, eqn), line) for line in operands[0].lines]


def _multiple(eqn: Any, operands: list[Any]) -> _OptionalLines:
    first, second = operands
    if isinstance(first, _Lines) and isinstance(second, _Fixed):
        return [_both(lambda v: _result(eqn, v, second.get()), line) for line in first.lines]
    if eqn.primitive.name == "mul" and isinstance(second, _Lines) and isinstance(first, _Fixed):
        return [_both(lambda v: _result(eqn, first.get(), v), line) for line in second.lines]
    return None


def _modulus(eqn: Any, operands: list[Any]) -> _OptionalLines:
    if not isinstance(operands[0], _Lines):
        return None
    lines = operands[0].lines
    return [*lines, *(_both(jnp.negative, line) for line in lines)]


def _one_of(eqn: Any, operands: list[Any]) -> _OptionalLines:
    out = eqn.outvars[0].aval
    broadcast = lambda v: jnp.broadcast_to(v, out.shape)  # noqa: E731
    each = [lines for v in operands if (lines := _as_lines(v)) is not None]
    if not is_real(out) or len(each) != len(operands):
        return None
    return [_both(broadcast, line) for lines in each for line in lines]


def _no_lines(eqn: Any, operands: list[Any]) -> None:
    """Return None, for a comparison, whose intersections are known, and a table, which declares
    knots."""


RULES: dict[str, Rule] = {
    **same_for({"add", "sub", "add_any"}, _sum),
    **same_for(REARRANGING | {"reduce_precision", "neg", "convert_element_type"}, _linear),
    **same_for({"mul", "div"}, _multiple),
    **same_for({"max", "min", "clamp"}, _one_of),
    "abs": _modulus,
    "select_n": lambda eqn, operands: _one_of(eqn, operands[1:]),
    **same_for(ORDERING | {"sign", "searchsorted"}, _no_lines),
    **same_for(TABLES | {"dvax_lower_or_inf", "dvax_evaluate"}, _no_lines),
}

_FLAGS = ORDERING | LOGICAL | REARRANGING | {"eq", "ne", "reduce_precision"}
"""Operations whose results keep the unresolved comparisons of their arguments."""


def _is_check(cases: list[Any]) -> bool:
    """Return whether one of the cases is infinite or NaN, and so marks invalid values."""
    values = [v.get() for v in cases if isinstance(v, _Fixed)]
    return any(_tree.is_concrete(v) and not np.all(np.isfinite(np.asarray(v))) for v in values)


_STEPS = {"floor", "ceil", "round", "rem"}


def _becomes_integer(eqn: Any) -> bool:
    """Return whether a conversion is from floating-point to another type."""
    kinds = [jnp.issubdtype(v.aval.dtype, jnp.floating) for v in (eqn.invars[0], eqn.outvars[0])]
    return kinds == [True, False]


def _compares_time(eqn: Any, operands: list[Any]) -> bool:
    """Return whether a loop contains a comparison of values that depend on t and not on x or u."""
    if eqn.primitive.name == "scan":
        bodies, first = [eqn.params["jaxpr"]], 0
        fixed, carries = scan_counts(eqn.params) or (0, 0)
        back = {fixed + k: k for k in range(carries)}
        inputs = [operands]
    else:
        first, second = eqn.params["cond_nconsts"], eqn.params["body_nconsts"]
        bodies = [eqn.params["cond_jaxpr"], eqn.params["body_jaxpr"]]
        carried = operands[first + second :]
        inputs = [[*operands[:first], *carried], [*operands[first : first + second], *carried]]
        back = {second + k: k for k in range(len(carried))}
    kinds = [[_dependence(v) for v in row] for row in inputs]
    # Propagate dependences through the carry until they do not change any more.
    for _ in range(len(operands) + 1):
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


def _tainted(program: Any, operands: list[set[str]]) -> tuple[bool, list[set[str]]]:
    """Return whether a program compares values that depend on t only, and the dependences of its
    outputs."""
    dependences: dict[Any, set[str]] = dict(zip(program.jaxpr.invars, operands, strict=True))
    of = lambda v: set() if isinstance(v, Literal) else dependences.get(v, set())  # noqa: E731
    compares = False
    for eqn in program.jaxpr.eqns:
        depends = set().union(*map(of, eqn.invars))
        name = eqn.primitive.name
        compares |= name in ORDERING | _STEPS and depends == {"t"}
        if (inner := inner_program(eqn)) is not None:
            compares |= _tainted(inner, list(map(of, eqn.invars)))[0]
        dependences |= dict.fromkeys(eqn.outvars, depends)
    return compares, list(map(of, program.jaxpr.outvars))


def _undifferentiable(place: str) -> Callable[..., jax.Array]:
    """Return a function that returns one infinite time, and whose derivative raises."""

    @jax.custom_jvp
    def never(*values: Any) -> jax.Array:
        return jnp.full(1, jnp.inf)

    @partial(never.defjvp, symbolic_zeros=True)
    def _(primals: tuple, tangents: tuple) -> Any:
        if all(isinstance(v, jax.custom_derivatives.SymbolicZero) for v in tangents):
            return never(*primals), jnp.zeros(1)
        raise DifferentiationError(
            f"f, h or K may jump at a time that depends on a differentiated parameter, by a comparison "
            "that is not affine in t, a step function (floor, round, %) or a loop"
            f"{place}: the derivative of that time is not known. "
            "Write the switch as a comparison of t itself with the time of the jump (t < a), or "
            "declare that time as a knot of a dvax.signals.Function or as a time of a "
            "dvax.signals.Table."
        )

    return never


def _fixed(value: Any) -> _Fixed:
    return _Fixed(lambda: value)


def _evaluate(eqn: Any, operands: list[Any]) -> list[Any]:
    """Return the results of an operation; on concrete numbers compute them even while tracing."""
    if _tree.is_concrete(operands):
        with jax.ensure_compile_time_eval():
            return bind(eqn, operands)
    return bind(eqn, operands)


def _result(eqn: Any, *operands: Any) -> Any:
    return _evaluate(eqn, list(operands))[0]


def _as_lines(v: Any) -> list[_Line] | None:
    if isinstance(v, _Lines):
        return v.lines
    if not isinstance(v, _Fixed):
        return None
    return [_Line(_Fixed(lambda: jnp.zeros_like(jnp.asarray(v.get()))), v)]


def _intersection(p: _Line, q: _Line) -> jax.Array:
    """Return the times at which two lines intersect, infinite for parallel lines."""
    slope, offset = p.slope.get() - q.slope.get(), p.offset.get() - q.offset.get()
    slope, offset = jnp.broadcast_arrays(slope, offset)
    intersects = slope != 0
    times = -offset / jnp.where(intersects, slope, jnp.ones_like(slope))
    return jnp.where(intersects, times, jnp.inf).ravel()


def _both(do: Callable[..., Any], *lines: Any) -> _Line:
    slope = _Fixed(lambda: do(*(line.slope.get() for line in lines)))
    return _Line(slope, _Fixed(lambda: do(*(line.offset.get() for line in lines))))


def _place(eqn: Any) -> str:
    """Return the position of an operation in the caller's source, or an empty text."""
    traceback = getattr(getattr(eqn, "source_info", None), "traceback", None)
    for frame in getattr(traceback, "frames", ()):
        inside = ("site-packages", "/dvax/", "<frozen", "<string>")
        if not any(part in frame.file_name for part in inside):
            return f" ({frame.file_name}, line {frame.line_num})"
    return ""
