"""The law of day-to-day traffic, and Newton's method for it on the flows of links.

The law u = argmin over K of ½‖u − x‖² + ρ Φ(Δu) has as many unknowns as there are paths, but costs
depend on link flows alone:

    u = y(v) := proj_K(x − ρ Δᵀc(v)),    where v solves  r(v) = v − Δy(v) = 0.

The derivative of y is −ρ P Δᵀ D with D = diag c′(v) and P = I − mean over the paths of a pair that
carry flow, so Newton's direction solves, symmetrised by s = √D,

    (I + ρ s S s) g = −s r,    S = Δ P Δᵀ,    dv = −r − ρ S s g.

It ascends the concave dual function of the law, ½‖y − x‖² + ρ(⟨c, Δy − v⟩ + Φ(v)) at c = c(v), whose
slope along dv is −ρ⟨r, D dv⟩ ≥ 0; a line search on it makes the method safe.

Only pairs with two paths or more have a choice, and only links that not all paths of a pair share
matter to it (`Paths.differences`). Few links have ρ Dᵢ Sᵢᵢ ≫ 0: on these the matrix is formed and
factorised, and the block preconditions conjugate gradients for the whole system. The paths that carry
flow change from one iteration to the next, which the block need not follow: it is formed once a law,
and again where conjugate gradients become slow with it.

They need not be solved exactly: along g/s the slope is ρ⟨g, −sr⟩, which is positive for every iterate g
of conjugate gradients. So dv = g/s where costs react, and −r − ρSsg elsewhere, where s may be 0.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ...errors import input_error
from ...problem import FrozenOperator
from ...signals import AbstractSignal
from ...vi import AbstractSolver, Answer, FrozenVI
from ...vi.iteration import Trial, iterate
from .costs import LinkCosts
from .paths import Incidence, Paths

_BLOCK = 768
"""The most links that the factorised block holds."""
_STIFF = 0.1
"""Links below this ρ Dᵢ Sᵢᵢ are left to the conjugate gradients."""

_LINEAR = 1e-2
_PRODUCTS = 500
"""Relative residual of the linear systems, and the most products."""
_SLOW = 16
"""Products after which the block is formed anew: they cost as much as that."""

_ASCENT = 1e-4
_SHORTEST = 1e-9
"""Share of the predicted ascent that a step must reach, and the least share of a step."""


class Proposal(eqx.Module):
    """h = x − ρ Δᵀc(Δu)."""

    incidence: Incidence
    costs: LinkCosts
    capacity: AbstractSignal
    rho: jax.Array

    def __call__(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        c = self.costs.costs(self.incidence.flows(u), self.capacity(t))
        return x - self.rho * self.incidence.along(c)


class Choices(eqx.Module):
    """The paths of pairs that have several, as far as they differ (`Paths.differences`).

    `rows` are their numbers among all paths, `pair` numbers their pairs, `incidence` holds the links
    of each, `many` how many of them a link is on. `block` are the links of the factorised block; the
    entries of S there are the sums, over
    `cells`, of one number a path (`of_row`: whether it carries flow) and of one a pair of links
    (`first`, `second`: rows of `key_pair`, a pair and a link of the block each, whose flow-carrying
    paths `key_row` → `key` count).
    """

    rows: jax.Array
    pair: jax.Array
    incidence: Incidence
    many: jax.Array
    block: jax.Array
    cells: jax.Array
    of_row: jax.Array
    first: jax.Array
    second: jax.Array
    key: jax.Array
    key_row: jax.Array
    key_pair: jax.Array
    pairs: int = eqx.field(static=True)

    def __init__(self, paths: Paths, stiffness: np.ndarray, flows: np.ndarray):
        """The block is where `stiffness`, ρ c′ of a link, times Sᵢᵢ at these path flows is large."""
        found = paths.differences(np.zeros(len(paths.sizes)))
        lengths = np.diff(found.ends)
        row = np.repeat(np.arange(len(lengths)), lengths)
        pair = np.repeat(np.arange(len(found.sizes)), found.sizes)
        many = np.bincount(found.links, minlength=paths.count)
        used = (flows[found.rows] > 0).astype(float)
        carried = stiffness * _diagonal(pair, row, found.links, used, paths.count)
        block = np.sort(np.argsort(-carried, kind="stable")[:_BLOCK])
        block = block[carried[block] > _STIFF]
        place = np.full(paths.count, -1)
        place[block] = np.arange(len(block))
        inside = place[found.links] >= 0
        row, at = row[inside], place[found.links[inside]]
        # Within a path its links of the block, each with those before it.
        order = np.lexsort((at, row))
        row, at = row[order], at[order]
        high, low = _combinations(row)
        of_row, cells = row[high], at[high] * len(block) + at[low]
        # Within a pair likewise, each link of it once.
        key, inverse = np.unique(pair[row] * max(len(block), 1) + at, return_inverse=True)
        key_pair, key_at = np.divmod(key, max(len(block), 1))
        first, second = _combinations(key_pair)
        more = key_at[first] * len(block) + key_at[second]
        whole = lambda a: jnp.asarray(a, jnp.int32)  # noqa: E731
        self.rows, self.pair, self.block = whole(found.rows), whole(pair), whole(block)
        self.incidence = Incidence(lengths, found.links, paths.count)
        self.many = jnp.asarray(many, float)
        self.cells, self.of_row = whole(np.concatenate([cells, more])), whole(of_row)
        self.first, self.second = whole(first), whole(second)
        self.key, self.key_row, self.key_pair = whole(inverse), whole(row), whole(key_pair)
        self.pairs = len(found.sizes)

    def each(self, a: jax.Array) -> jax.Array:
        """One number a pair, on its rows."""
        return a.at[self.pair].get(mode="promise_in_bounds")

    def sums(self, q: jax.Array) -> jax.Array:
        """Σ q over the rows of every pair."""
        return jax.ops.segment_sum(q, self.pair, self.pairs, indices_are_sorted=True)

    def matrix(self, used: jax.Array, count: jax.Array) -> jax.Array:
        """The lower triangle of S on the block, for the rows that are `used`, `count` of each pair."""
        size = len(self.block)
        taken = used.at[self.key_row].get(mode="promise_in_bounds")
        keys = len(self.key_pair)
        n = jnp.zeros(keys, used.dtype).at[self.key].add(taken, mode="promise_in_bounds")
        share = n / count.at[self.key_pair].get(mode="promise_in_bounds")
        of_rows = used.at[self.of_row].get(mode="promise_in_bounds")
        of_pairs = n.at[self.first].get(mode="promise_in_bounds")
        of_pairs = of_pairs * share.at[self.second].get(mode="promise_in_bounds")
        flat = jnp.zeros(size * size, used.dtype)
        values = jnp.concatenate([of_rows, -of_pairs])
        return flat.at[self.cells].add(values, mode="promise_in_bounds").reshape(size, size)


def _diagonal(
    pair: np.ndarray, row: np.ndarray, links: np.ndarray, used: np.ndarray, count: int
) -> np.ndarray:
    """Sᵢᵢ of every link, where `row` and `links` say which paths are on which link."""
    key, inverse = np.unique(pair[row] * count + links, return_inverse=True)
    n = np.bincount(inverse, used[row])
    share = n / np.maximum(np.bincount(pair, used), 1.0)[key // count]
    return np.bincount(key % count, n * (1.0 - share), minlength=count)


def _combinations(group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All (i, j) with j ≤ i in the same group, for groups that lie side by side."""
    begin = np.searchsorted(group, group)
    many = np.arange(len(group)) - begin + 1
    first = np.repeat(np.arange(len(group)), many)
    offset = np.arange(many.sum()) - np.repeat(np.cumsum(many) - many, many)
    return first, begin[first] + offset


class _State(NamedTuple):
    """v, and there Δᵀc(v) as `_Law._along` has it, y, w = Δy and the dual function."""

    v: jax.Array
    along: jax.Array
    y: jax.Array
    w: jax.Array
    dual: jax.Array


class _Method(NamedTuple):
    """Where Newton's method stands: `inverse` is that of a Cholesky factor of the block, `products`
    are those that the last linear system took with it."""

    at: _State
    inverse: jax.Array
    products: jax.Array


class LinkNewton(AbstractSolver):
    """Newton's method on link flows (see above), for the law of `Traffic` alone.

    It starts from the guess or from the flows at `equilibrium`, whichever has the larger dual
    function. ‖w‖ is that of w = ρ Δᵀ(c(Δy) − c(v)), less its mean over the paths of every pair, which
    is a normal to K: an element of F(y) + N_K(y).

    **Arguments:** `least`, the smallest ‖w‖ that is asked for, whatever the tolerance, where rounding
    allows it (see `rounding`); `max_steps`.

    **Raises:** `dvax.InputError` for any other law.
    """

    choices: Choices
    equilibrium: jax.Array
    least: float
    max_steps: int = 300

    def solve(self, vi: FrozenVI, y0: jax.Array, tol: Any) -> Answer:
        law = _Law(self.choices, vi)
        start = law.K.project(lax.stop_gradient(y0), vi.space)
        own = law.respond(law.link_flows(start))
        other = law.respond(self.equilibrium)
        better = other.dual > own.dual
        at = jax.tree_util.tree_map(lambda a, b: jnp.where(better, a, b), other, own)

        def begin(*_: Any) -> _Method:
            size = len(self.choices.block)
            return _Method(at, jnp.zeros((size, size), start.dtype), jnp.asarray(_PRODUCTS))

        def advance(_: FrozenVI, method: _Method) -> tuple[_Method, Trial]:
            new, calls = law.ascend(method)
            w, value = law.certificate(new.at)
            one = jnp.ones((), w.dtype)
            return new, Trial(new.at.y, w, value, one, [new.at.y], calls)

        tol = jnp.maximum(jnp.maximum(tol, self.least), law.rounding(at))
        return iterate(vi, at.y, tol, begin, advance, self.max_steps, initial_evaluations=2)


class _Law:
    """The law at a time and a state."""

    def __init__(self, choices: Choices, vi: FrozenVI):
        if not (isinstance(vi.F, FrozenOperator) and isinstance(vi.F.h, Proposal)):
            raise input_error(
                "dvax.models.traffic.LinkNewton", f"the operator {vi.F!r}"[:80],
                "it solves the law of a dvax.models.Traffic alone",
                "Use dvax.vi.Accelerated()",
            )  # fmt: skip
        frozen: FrozenOperator = vi.F
        F, K, h = jax.tree_util.tree_map(lax.stop_gradient, (frozen.x, vi.K, frozen.h))
        self.x, self.K, self.space, self.choices = F, K, vi.space, choices
        self.costs, self.rho, self.whole = h.costs, h.rho, h.incidence
        self.capacity = lax.stop_gradient(h.capacity(frozen.t))
        self.most = h.costs.most
        self.fixed: Any = None

    def link_flows(self, y: jax.Array) -> jax.Array:
        """Δy, from which the flows are derived that no choice changes."""
        v = self.whole.flows(y)
        self.fixed = v - self.choices.incidence.flows(self._rows(y))
        return v

    def respond(self, v: jax.Array) -> _State:
        """y(v) and what belongs to it."""
        c = self.costs.costs(v, self.capacity)
        along = self._along(c)
        z = self.x.at[self.choices.rows].add(-self.rho * along)
        y = self.K.project(z, self.space)
        w = self.fixed + self.choices.incidence.flows(self._rows(y))
        away = y - self.x
        terms = c * (w - v) + self.costs.integrals(v, self.capacity)
        return _State(v, along, y, w, 0.5 * jnp.sum(away * away) + self.rho * jnp.sum(terms))

    def ascend(self, method: _Method) -> tuple[_Method, jax.Array]:
        """(where a step of Newton's method leads, how many points it tried)."""
        at = method.at
        r = at.v - at.w
        D = self.costs.slopes(at.v, self.capacity)
        dv, inverse, products = self._newton(r, D, self._rows(at.y), method)
        slope = jnp.maximum(-self.rho * jnp.sum(r * D * dv), 0.0)
        # Below the rounding of the dual function nothing is a descent.
        blur = 8 * jnp.finfo(r.dtype).eps * jnp.abs(at.dual)

        def attempt(length: Any) -> tuple[_State, jax.Array]:
            new = self.respond(jnp.clip(at.v + length * dv, 0.0, self.most))
            return new, new.dual >= at.dual + _ASCENT * length * slope - blur

        def goes_on(carry: tuple) -> jax.Array:
            length, _, enough, _ = carry
            return ~enough & (length > _SHORTEST)

        def shorter(carry: tuple) -> tuple:
            length, _, _, tried = carry
            return 0.5 * length, *attempt(0.5 * length), tried + 1

        one = jnp.ones((), r.dtype)
        _, new, _, tried = lax.while_loop(goes_on, shorter, (one, *attempt(one), jnp.asarray(1)))
        return _Method(new, inverse, products), tried

    def certificate(self, at: _State) -> tuple[jax.Array, jax.Array]:
        """(w ∈ F(y) + N_K(y), F(y) less a normal), both on all paths."""
        after = self._along(self.costs.costs(at.w, self.capacity))
        rows, nothing = self.choices.rows, jnp.zeros_like(at.y)
        w = nothing.at[rows].set(self.rho * (after - at.along))
        return w, (at.y - self.x).at[rows].add(self.rho * after)

    def rounding(self, at: _State) -> jax.Array:
        """What rounding makes of ‖w‖, roughly, whatever the iteration: an estimate.

        y(v) is the projection of x − ρΔᵀc, each number of which is off by a rounding of its terms; Δ
        sums these up, v is rounded, and w = ρΔᵀ(c(Δy) − c(v)) makes ρ c′ of what they are apart and
        has the roundings of c itself. Their squares add up, as for independent numbers.
        """
        choices, eps = self.choices, jnp.finfo(at.v.dtype).eps
        c, D = (f(at.v, self.capacity) for f in (self.costs.costs, self.costs.slopes))
        z = jnp.abs(self._rows(self.x)) + self.rho * choices.incidence.along(c)
        flows = choices.incidence.flows(z * z) + at.v**2
        return 4 * eps * self.rho * jnp.sqrt(jnp.sum(choices.many * (D**2 * flows + c**2)))

    def _newton(
        self, r: jax.Array, D: jax.Array, y: jax.Array, method: _Method
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """(dv for the residual r, the inverse that it was found with, the products that it took)."""
        choices, rho, s = self.choices, self.rho, jnp.sqrt(D)
        used = jnp.where(y > 0, 1.0, 0.0)
        count = jnp.maximum(choices.sums(used), 1.0)

        def apply(q: jax.Array) -> jax.Array:
            a = used * choices.incidence.along(q)
            return choices.incidence.flows(a - used * choices.each(choices.sums(a) / count))

        block = choices.block

        def formed() -> jax.Array:
            inner, unit = s[block], jnp.eye(len(block), dtype=s.dtype)
            matrix = rho * inner[:, None] * inner[None, :] * choices.matrix(used, count)
            factor = jnp.linalg.cholesky(matrix + unit, symmetrize_input=False)
            return jax.scipy.linalg.solve_triangular(factor, unit, lower=True)

        inverse = lax.cond(method.products > _SLOW, formed, lambda: method.inverse)

        def nearly(g: jax.Array) -> jax.Array:
            return g.at[block].set((inverse @ g[block]) @ inverse)

        g, Ssg, products = _conjugate_gradients(apply, nearly, s, rho, -s * r)
        # Of an inexact g the first has the smaller error in s dv where costs react, and the second
        # has one that does not grow as s → 0.
        stiff = rho * D * choices.many > _STIFF
        dv = jnp.where(stiff, g / jnp.where(stiff, s, 1.0), -r - rho * Ssg)
        return dv, inverse, products

    def _rows(self, y: jax.Array) -> jax.Array:
        return y.at[self.choices.rows].get(mode="promise_in_bounds")

    def _along(self, c: jax.Array) -> jax.Array:
        """The costs of paths less their mean over the pair: a constant a pair changes nothing, and
        without it fewer digits are lost."""
        a = self.choices.incidence.along(c)
        number = jnp.maximum(self.choices.sums(jnp.ones_like(a)), 1.0)
        return a - self.choices.each(self.choices.sums(a) / number)


def _conjugate_gradients(
    apply: Callable[[jax.Array], jax.Array],
    precondition: Callable[[jax.Array], jax.Array],
    s: jax.Array,
    rho: jax.Array,
    b: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(g, S s g, products) with (I + ρ s S s) g = b nearly, S being what `apply` applies."""

    def goes_on(carry: tuple) -> jax.Array:
        _, _, r, _, _, products = carry
        return (jnp.sum(r * r) > goal) & (products < _PRODUCTS)

    def step(carry: tuple) -> tuple:
        g, Ssg, r, p, size, products = carry
        Ssp = apply(s * p)
        Ap = p + rho * s * Ssp
        length = size / jnp.sum(p * Ap)
        r = r - length * Ap
        z = precondition(r)
        new = jnp.sum(r * z)
        p_new = z + (new / size) * p
        return g + length * p, Ssg + length * Ssp, r, p_new, new, products + 1

    goal = _LINEAR**2 * jnp.sum(b * b)
    p, nothing = precondition(b), jnp.zeros_like(b)
    start = nothing, nothing, b, p, jnp.sum(b * p), jnp.asarray(0)
    g, Ssg, *_, products = lax.while_loop(goes_on, step, start)
    return g, Ssg, products
