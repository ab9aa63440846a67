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
factorised, and conjugate gradients preconditioned by that block solve the whole system in some ten
iterations. Without it they need hundreds, and first-order methods a thousand on Chicago's sketch
network.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ...errors import InputError, InputProblem
from ...problem import FrozenOperator
from ...signals import AbstractSignal
from ...vi import AbstractSolver, Answer, Frozen
from ...vi.iteration import Trial, iterate
from .costs import LinkCosts
from .paths import Incidence, Paths

_BLOCK = 1024
"""The most links that the factorised block holds: it takes 10 ms."""
_STIFF = 0.1
"""Links below this ρ Dᵢ Sᵢᵢ are left to the conjugate gradients."""

_LINEAR = 1e-5
_PRODUCTS = 500
"""Relative residual of the linear systems, and the most products. dv has the error of g times ρ s: with
10⁻³ the steps on Chicago's sketch network do not ascend, with 10⁻⁵ they are as good as exact."""

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
    of each. `block` are the links of the factorised block; the entries of S there are the sums, over
    `cells`, of one number a path (`of_row`: whether it carries flow) and of one a pair of links
    (`first`, `second`: rows of `key_pair`, a pair and a link of the block each, whose flow-carrying
    paths `key_row` → `key` count).
    """

    rows: jax.Array
    pair: jax.Array
    incidence: Incidence
    block: jax.Array
    cells: jax.Array
    of_row: jax.Array
    first: jax.Array
    second: jax.Array
    key: jax.Array
    key_row: jax.Array
    key_pair: jax.Array
    pairs: int = eqx.field(static=True)

    def __init__(self, paths: Paths, stiffness: np.ndarray):
        """`stiffness` is ρ c′ of every link: where it is large, times its paths, is the block."""
        found = paths.differences(np.zeros(len(paths.sizes)))
        lengths = np.diff(found.ends)
        row = np.repeat(np.arange(len(lengths)), lengths)
        pair = np.repeat(np.arange(len(found.sizes)), found.sizes)
        carried = stiffness * np.bincount(found.links, minlength=paths.count)
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


def _combinations(group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All (i, j) with j ≤ i in the same group, for groups that lie side by side."""
    begin = np.searchsorted(group, group)
    many = np.arange(len(group)) - begin + 1
    first = np.repeat(np.arange(len(group)), many)
    offset = np.arange(many.sum()) - np.repeat(np.cumsum(many) - many, many)
    return first, begin[first] + offset


class _State(NamedTuple):
    """v, and y, w = Δy and the dual function there."""

    v: jax.Array
    y: jax.Array
    w: jax.Array
    dual: jax.Array


class LinkNewton(AbstractSolver):
    """Newton's method on link flows (see above), for the law of `Traffic` alone.

    It starts from the guess or from the flows at `equilibrium`, whichever has the larger dual
    function. ‖w‖ is that of w = ρ Δᵀ(c(Δy) − c(v)), less its mean over the paths of every pair, which
    is a normal to K: an element of F(y) + N_K(y).

    **Arguments:** `least`, the smallest ‖w‖ that is asked for, whatever the tolerance; `max_steps`.

    **Raises:** `dvax.InputError` for any other law.
    """

    choices: Choices
    equilibrium: jax.Array
    least: float
    max_steps: int = 300

    def solve(self, vi: Frozen, y0: jax.Array, tol: Any) -> Answer:
        law = _Law(self.choices, vi)

        def begin(_: Frozen, y: jax.Array) -> _State:
            own = law.respond(law.link_flows(y))
            other = law.respond(self.equilibrium)
            better = other.dual > own.dual
            return jax.tree_util.tree_map(lambda a, b: jnp.where(better, a, b), other, own)

        def advance(_: Frozen, at: _State) -> tuple[_State, Trial]:
            new, calls = law.ascend(at)
            w, value = law.certificate(new)
            one = jnp.ones((), new.v.dtype)
            return new, Trial(new.y, w, value, one, [new.y], calls)

        tol = jnp.maximum(tol, self.least)
        return iterate(vi, y0, tol, begin, advance, self.max_steps, begun=2)


class _Law:
    """The law at a time and a state."""

    def __init__(self, choices: Choices, vi: Frozen):
        if not (isinstance(vi.F, FrozenOperator) and isinstance(vi.F.h, Proposal)):
            raise InputError(
                InputProblem(
                    "dvax.models.traffic.LinkNewton", f"the operator {vi.F!r}"[:80],
                    "it solves the law of a dvax.models.Traffic alone",
                    "Use dvax.vi.Accelerated()",
                )
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
        z = self.x.at[self.choices.rows].add(-self.rho * self._along(c))
        y = self.K.project(z, self.space)
        w = self.fixed + self.choices.incidence.flows(self._rows(y))
        away = y - self.x
        terms = c * (w - v) + self.costs.integrals(v, self.capacity)
        return _State(v, y, w, 0.5 * jnp.sum(away * away) + self.rho * jnp.sum(terms))

    def ascend(self, at: _State) -> tuple[_State, jax.Array]:
        """(the state after a step of Newton's method, how many points it tried)."""
        r = at.v - at.w
        D = self.costs.slopes(at.v, self.capacity)
        dv = self._newton(r, D, self._rows(at.y))
        slope = -self.rho * jnp.sum(r * D * dv)
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
        return new, tried

    def certificate(self, at: _State) -> tuple[jax.Array, jax.Array]:
        """(w ∈ F(y) + N_K(y), F(y) less a normal), both on all paths."""
        after, before = (self._along(self.costs.costs(v, self.capacity)) for v in (at.w, at.v))
        rows, nothing = self.choices.rows, jnp.zeros_like(at.y)
        w = nothing.at[rows].set(self.rho * (after - before))
        return w, (at.y - self.x).at[rows].add(self.rho * after)

    def _newton(self, r: jax.Array, D: jax.Array, y: jax.Array) -> jax.Array:
        """dv for the residual r."""
        choices, s = self.choices, jnp.sqrt(D)
        used = jnp.where(y > 0, 1.0, 0.0)
        count = jnp.maximum(choices.sums(used), 1.0)

        def apply(q: jax.Array) -> jax.Array:
            a = used * choices.incidence.along(q)
            return choices.incidence.flows(a - used * choices.each(choices.sums(a) / count))

        def whole(g: jax.Array) -> jax.Array:
            return g + self.rho * s * apply(s * g)

        block = choices.block
        inner = s[block]
        matrix = self.rho * inner[:, None] * inner[None, :] * choices.matrix(used, count)
        unit = jnp.eye(len(block), dtype=s.dtype)
        factor = jnp.linalg.cholesky(matrix + unit, symmetrize_input=False)

        def nearly(g: jax.Array) -> jax.Array:
            part = jax.scipy.linalg.cho_solve((factor, True), g[block])
            return g.at[block].set(part)

        g, _ = jax.scipy.sparse.linalg.cg(whole, -s * r, tol=_LINEAR, maxiter=_PRODUCTS, M=nearly)
        return -r - self.rho * apply(s * g)

    def _rows(self, y: jax.Array) -> jax.Array:
        return y.at[self.choices.rows].get(mode="promise_in_bounds")

    def _along(self, c: jax.Array) -> jax.Array:
        """The costs of paths less their mean over the pair: a constant a pair changes nothing, and
        without it fewer digits are lost."""
        a = self.choices.incidence.along(c)
        number = jnp.maximum(self.choices.sums(jnp.ones_like(a)), 1.0)
        return a - self.choices.each(self.choices.sums(a) / number)
