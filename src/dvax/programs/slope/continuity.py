"""Proofs that the two branches of a selection agree where it switches, by exact arithmetic.

The function a(v) where v > w and b(v) elsewhere is continuous if a = b wherever v = w. Both branches
are expanded into polynomials with rational coefficients, in which v is replaced by w. Every function
that is no polynomial counts as a new variable, but its values at the points where they are rational are
known, such as e⁰ = 1. A difference of a few roundings of the values themselves counts as 0, since it
comes from constants such as 0.1, which are rounded.
"""

import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any

import numpy as np

from ..interpreter import is_real
from .alignment import Axes, operand_axes, own_axes
from .sources import COMPARISONS, Source, relation_of
from .values import is_slope

Terms = dict[frozenset[tuple[Any, int]], Any]
"""A polynomial: the coefficient of each product of powers of variables. A coefficient is an array of
fractions, one for each entry of the selection or one for all."""

_ONE: frozenset[tuple[Any, int]] = frozenset()
"""The product of no variables."""

_MAX_TERMS = 64

_MAX_POWER = 8

_EPS_FACTOR = 8

_FLIPPED = {"lt", "le"}


class _NoProof(Exception):
    """The branches have no polynomials in this arithmetic."""


def agree(which: Any, no: Any, yes: Any, shape: tuple[int, ...], eps: float) -> bool:
    """Return whether `no` = `yes` is proved wherever one of the comparisons in `which` switches."""
    try:
        a, b = (_Expansion(shape, {}, {}).of(v) for v in (no, yes))
        if _differ_by_rounding(a, b, 0.0):
            return True
    except _NoProof:
        pass
    if which.source is None:
        return False
    try:
        return all(
            _agree_at(source, which.source, no, yes, shape, eps)
            for source in _comparisons(which.source)
        )
    except _NoProof:
        return False


def facts(source: Source | None, is_true: bool, axes: Axes) -> list[tuple[Source, bool, Axes]]:
    """Return the Boolean values that follow from the value of one of them, with their own and axes."""
    if source is None or source.eqn is None or axes is None:
        return []
    name = source.eqn.primitive.name
    found: list[tuple[Source, bool, Axes]] = [(source, is_true, axes)]
    if name == "not":
        is_true = not is_true
    slopes = [v for v in source.operands if is_slope(v)]
    follows = name in ("not", *_MOVING) or name == ("and" if is_true else "or")
    if name in ("and", "or") and not follows and len(slopes) == 1:
        # The other operand leaves the choice to this one where it is true in `and`, false in `or`.
        (other,) = (v for v in source.operands if not is_slope(v))
        follows = bool(np.all(np.asarray(other) == (name == "and")))
    for operand in slopes if follows else []:
        found += facts(operand.source, is_true, operand_axes(source.eqn, axes, operand))
    return found


def _choices(choice: Source, is_true: bool) -> dict[Any, bool]:
    """Return what follows from a Boolean value: other ones by their keys, and relations."""
    found: dict[Any, bool] = {}
    whole = own_axes(choice.eqn.outvars[0].aval.shape) if choice.eqn is not None else None
    for source, value, axes in facts(choice, is_true, whole):
        if axes not in (whole, ()):
            continue
        found[source.key] = value
        relation = relation_of(source)
        if relation is not None:
            found[relation[0]] = value == relation[1]
    return found


def _comparisons(source: Source) -> Iterator[Source]:
    """Yield the comparisons of which a Boolean value is made.

    **Raises:** `_NoProof` if it is made of something else.
    """
    name = "" if source.eqn is None else source.eqn.primitive.name
    if name in COMPARISONS:
        yield source
    elif name in ("and", "or", "not", *_MOVING):
        for operand in source.operands:
            if is_slope(operand):
                if operand.source is None:
                    raise _NoProof
                yield from _comparisons(operand.source)
    else:
        raise _NoProof


def _agree_at(
    comparison: Source, choice: Source, no: Any, yes: Any, shape: tuple[int, ...], eps: float
) -> bool:
    """Return whether the branches agree where the two sides of a comparison are equal."""
    v, w = comparison.operands
    choices = [_choices(choice, is_true) for is_true in (False, True)]

    def is_proved(known: dict[int, Terms]) -> bool:
        expansions = [_Expansion(shape, known, own) for own in choices]
        try:
            a, b = (e.of(branch) for e, branch in zip(expansions, (no, yes), strict=True))
        except _NoProof:
            return False
        return _differ_by_rounding(a, b, eps)

    return any(all(map(is_proved, each)) for each in _solutions(v, w, shape))


def _differ_by_rounding(a: Terms, b: Terms, eps: float) -> bool:
    """Return whether each coefficient of a − b is rounding beside those of a and b."""
    for product, gap in _sum(a, b, -1).items():
        size = sum(np.abs(terms.get(product, Fraction(0))) for terms in (a, b))
        if np.any(np.abs(gap) > Fraction(_EPS_FACTOR * eps) * size):
            return False
    return True


def _solutions(v: Any, w: Any, shape: tuple[int, ...]) -> Iterator[list[dict[int, Terms]]]:
    """Yield the solutions of v = w, each as a replacement of one value, by its key; all of them
    together, and again for other choices of that value."""
    plain = _Expansion(shape, {}, {})
    for this, other in ((v, w), (w, v)):
        if is_slope(this) and this.source is not None:
            try:
                terms = plain.of(other)
            except _NoProof:
                continue
            yield [{this.source.key: terms}]
            inner = modulus_argument(this)
            if inner is not None:
                yield [{inner.source.key: terms}, {inner.source.key: _sum({}, terms, -1)}]
    try:
        terms = _sum(plain.of(v), plain.of(w), -1)
    except _NoProof:
        return
    for product, factor in terms.items():
        if len(product) == 1:
            ((variable, power),) = product
            alone = sum(any(variable == a for a, _ in p) for p in terms) == 1
            if power == 1 and alone and isinstance(variable, int) and np.all(factor != 0):
                yield [{variable: {p: -c / factor for p, c in terms.items() if p != product}}]


def modulus_argument(value: Any) -> Any:
    """Return x if a value is |x|, and else None."""
    source = value.source
    if source is None or source.eqn is None or source.eqn.primitive.name != "abs":
        return None
    (inner,) = source.operands
    return inner if inner.source is not None else None


class _Expansion:
    """The expansion of values into polynomials, with some values given."""

    def __init__(self, shape: tuple[int, ...], known: dict[int, Terms], choices: dict[Any, bool]):
        self.shape, self.known, self.choices = shape, known, choices
        self._memo: dict[int, Terms] = dict(known)
        self._depends: dict[Any, bool] = dict.fromkeys((*known, *choices), True)

    def of(self, value: Any) -> Terms:
        """Return the polynomial of a value.

        **Raises:** `_NoProof`.
        """
        if not is_slope(value):
            return _constant(self._fractions(np.asarray(value)))
        if value.source is None:
            raise _NoProof
        key = value.source.key
        if key not in self._memo:
            self._memo[key] = self._expand(value)
        return self._memo[key]

    def _fractions(self, array: np.ndarray) -> Any:
        if array.dtype.kind not in "fiu" or not np.isfinite(array).all():
            raise _NoProof
        if array.size == 1:
            return Fraction(array.item())
        if array.shape != self.shape:
            raise _NoProof
        return np.vectorize(Fraction, otypes=[object])(array.astype(float))

    def _expand(self, value: Any) -> Terms:
        source, shape = value.source, np.shape(value.low)
        if source.eqn is not None:
            name = source.eqn.primitive.name
            # Entry k of a result depends on entry k of the arguments alone, or all have one entry.
            arrays = [np.asarray(v.low if is_slope(v) else v) for v in source.operands]
            entrywise = all(v.size == 1 or v.shape == shape for v in arrays)
            is_float = all(is_real(v.aval) for v in (*source.eqn.invars[-1:], *source.eqn.outvars))
            if entrywise and is_float and (math.prod(shape) == 1 or shape == self.shape):
                if name in _MOVING and source.eqn.params.get("dimensions") is None:
                    return self.of(source.operands[0])
                if name == "select_n":
                    return self._choose(source)
                if name in _POLYNOMIAL:
                    arguments = [self.of(v) for v in source.operands]
                    return _POLYNOMIAL[name](source.eqn, *arguments)
                if name in _FUNCTIONS:
                    return self._function(name, source)
        if self._is_known(source):
            raise _NoProof
        return {frozenset({(source.key, 1)}): Fraction(1)}

    def _choose(self, source: Source) -> Terms:
        if len(source.operands) != 3:
            raise _NoProof
        which, no, yes = source.operands
        choice = self._decided(which)
        if choice is None:
            # `jax.vmap` of `lax.cond` selects between a value and itself.
            terms = self.of(no)
            if not _differ_by_rounding(terms, self.of(yes), 0.0):
                raise _NoProof
            return terms
        return self.of(yes if choice else no)

    def _chosen(self, which: Source) -> bool | None:
        """Return a Boolean value that is given, None if it is not."""
        inner = stripped(which)
        for key in (inner.key, which.key):
            if key in self.choices:
                return self.choices[key]
        relation = relation_of(inner)
        if relation is None or relation[0] not in self.choices:
            return None
        return self.choices[relation[0]] == relation[1]

    def _decided(self, value: Any) -> bool | None:
        """Return a Boolean value that is the same in every entry, None if it is not known."""
        if not is_slope(value):
            return bool(np.all(value)) if np.all(value) or not np.any(value) else None
        if value.source is None:
            return None
        given = self._chosen(value.source)
        source = stripped(value.source)
        if given is not None or source.eqn is None:
            return given
        name = source.eqn.primitive.name
        if name in COMPARISONS:
            return self._compared(name, *source.operands)
        if name not in ("and", "or", "not"):
            return None
        operands = [self._decided(v) for v in source.operands]
        if name == "not":
            return None if operands[0] is None else not operands[0]
        if (name == "or") in operands:
            return name == "or"
        return None if None in operands else name == "and"

    def _compared(self, name: str, left: Any, right: Any) -> bool | None:
        """Return the result of a comparison, the same in every entry, that does not switch here."""
        terms = _sum(self.of(left), self.of(right), -1)
        gaps = np.atleast_1d(np.asarray(terms.get(_ONE, 0), dtype=object))
        is_above, is_below = bool(np.all(gaps > 0)), bool(np.all(gaps < 0))
        if any(product != _ONE for product in terms) or not (is_above or is_below):
            return None
        return is_above == (name not in _FLIPPED)

    def _function(self, name: str, source: Source) -> Terms:
        arguments = [self.of(v) for v in source.operands]
        if all(set(terms) <= {_ONE} for terms in arguments):
            values = [terms.get(_ONE, Fraction(0)) for terms in arguments]
            found = _FUNCTIONS[name](*values)
            if found is not None:
                return _constant(found)
        frozen = tuple(
            frozenset((p, tuple(np.asarray(c, dtype=object).ravel())) for p, c in terms.items())
            for terms in arguments
        )
        return {frozenset({((name, str(source.eqn.params), frozen), 1)}): Fraction(1)}

    def _is_known(self, source: Source) -> bool:
        """Return whether a value depends on one that is given."""
        if source.key not in self._depends:
            self._depends[source.key] = any(
                v.source is None or self._is_known(v.source) for v in source.operands if is_slope(v)
            )
        return self._depends[source.key]


def stripped(source: Source) -> Source:
    """Return the source of a value before it was only reshaped, or repeated from one entry."""
    while source.eqn is not None and source.eqn.primitive.name in _MOVING:
        whole = own_axes(source.eqn.outvars[0].aval.shape)
        inner = source.operands[0]
        if operand_axes(source.eqn, whole, inner) not in (whole, ()):
            break
        source = inner.source
    return source


def _constant(value: Any) -> Terms:
    return {_ONE: value} if np.any(value != 0) else {}


def _sum(a: Terms, b: Terms, sign: int = 1) -> Terms:
    out = dict(a)
    for product, factor in b.items():
        total = out.get(product, Fraction(0)) + sign * factor
        out[product] = total
    return {p: c for p, c in out.items() if np.any(c != 0)}


def _product(a: Terms, b: Terms) -> Terms:
    if len(a) * len(b) > _MAX_TERMS:
        raise _NoProof
    out: Terms = {}
    for (p, c), (q, d) in ((one, two) for one in a.items() for two in b.items()):
        powers: dict[Any, int] = dict(p)
        for variable, power in q:
            powers[variable] = powers.get(variable, 0) + power
        out = _sum(out, {frozenset(powers.items()): c * d})
    return out


def _quotient(a: Terms, b: Terms) -> Terms:
    if set(b) != {_ONE} or np.any(b[_ONE] == 0):
        raise _NoProof
    return _product(a, {_ONE: 1 / b[_ONE]})


def _power(a: Terms, exponent: int) -> Terms:
    if not 0 <= exponent <= _MAX_POWER:
        raise _NoProof
    out: Terms = {_ONE: Fraction(1)}
    for _ in range(exponent):
        out = _product(out, a)
    return out


_POLYNOMIAL: dict[str, Callable[..., Terms]] = {
    "add": lambda eqn, a, b: _sum(a, b),
    "add_any": lambda eqn, a, b: _sum(a, b),
    "sub": lambda eqn, a, b: _sum(a, b, -1),
    "neg": lambda eqn, a: _sum({}, a, -1),
    "mul": lambda eqn, a, b: _product(a, b),
    "div": lambda eqn, a, b: _quotient(a, b),
    "square": lambda eqn, a: _product(a, a),
    "integer_pow": lambda eqn, a: _power(a, eqn.params["y"]),
}

_MOVING = frozenset({
    "broadcast_in_dim", "reshape", "squeeze", "expand_dims", "copy", "copy_p", "stop_gradient",
    "convert_element_type",
})  # fmt: skip
"""Operations that leave an array of one entry, or of the same shape, as it is."""


def _at(point: int, value: int) -> Callable[[Any], Any]:
    """Return a function that is known at one point."""
    return lambda x: Fraction(value) if np.all(x == point) else None


def _root(x: Any) -> Any:
    return x if np.all((x == 0) | (x == 1)) else None


_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: _at(0, 0) for name in (
        "sin", "tan", "asin", "atan", "sinh", "tanh", "asinh", "atanh", "expm1", "log1p", "erf",
    )},
    **{name: _at(0, 1) for name in ("exp", "exp2", "cos", "cosh", "erfc")},
    "log": _at(1, 0), "rsqrt": _at(1, 1),
    "sqrt": _root, "cbrt": _root,
    "logistic": lambda x: Fraction(1, 2) if np.all(x == 0) else None,
    "pow": lambda x, p: x if np.all((x == 0) | (x == 1)) and np.all(p > 0) else None,
    "abs": np.abs, "max": np.maximum, "min": np.minimum,
    "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high),
}  # fmt: skip
"""Values of functions at rational points where they are rational; None elsewhere."""
