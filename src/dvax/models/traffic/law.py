"""The law of day-to-day traffic, and Newton's method for it in the link flows.

The law u = argmin over K of ½‖u − x‖² + ρ Φ(Δu) has one unknown a path, but costs depend only on link
flows:

    u = y(v) := proj_K(x − ρ Δᵀc(v)),    where v solves  r(v) = v − Δy(v) = 0.

The derivative of y is −ρ P Δᵀ D with D = diag c′(v) and P = I − mean over the paths of a pair that
carry flow. Newton's direction, symmetrised by s = √D, solves

    (I + ρ s S s) g = −s r,    S = Δ P Δᵀ,    dv = −r − ρ S s g.

It is an ascent direction of the concave dual function of the law, ½‖y − x‖² + ρ(⟨c, Δy − v⟩ + Φ(v)) at
c = c(v), whose slope along dv is −ρ⟨r, D dv⟩ ≥ 0. A line search on this merit function ensures global
convergence.

Only pairs with at least two paths, and only links that are not on all paths of a pair, enter the system
(`Paths.differences`). ρ Dᵢ Sᵢᵢ is large for few links. The matrix is formed and factorised on these
links. This block, with the diagonal 1 + ρ Dᵢ Sᵢᵢ for all other links, is a preconditioner of conjugate
gradients for the whole system. The set of paths that carry flow changes from one iteration to the next.
The block is formed once for each law, and again if conjugate gradients need many products with it; the
diagonal of S is that of the equilibrium.

The linear system is solved inexactly: along g/s the slope is ρ⟨g, −sr⟩, which is positive for every
iterate g of conjugate gradients. So dv = g/s for links with stiff costs, and −r − ρSsg for the others,
where s may be 0.
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

_MAX_BLOCK_LINKS = 1024
"""Largest number of links in the factorised block."""
_STIFF_LINK = 0.1
"""Links with a smaller ρ Dᵢ Sᵢᵢ are not in the factorised block."""

_CG_TOLERANCE = 1e-2
_MAX_PRODUCTS = 500
"""Relative residual of the linear systems, and largest number of products."""
_REFACTORISE_PRODUCTS = 32
"""The block is formed again if a system needs this many products more than the first system with this
block. Forming it takes about as long."""

_ASCENT_FRACTION = 1e-4
_MIN_STEP_LENGTH = 1e-9
"""Fraction of the predicted ascent that a step must attain (Armijo), and the shortest step length."""


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
    """The paths of pairs with several paths, restricted to links that differ (`Paths.differences`).

    `rows` are their numbers among all paths, `pair` the numbers of their pairs, `incidence` the
    links of each, `paths_per_link` the number of these paths on each link, and `diagonal` the entries
    Sᵢᵢ at given flows. `block` are the links of the factorised block. The entries of S on the block are
    sums into `cells` of one number a path (`of_row`: whether it carries flow) and of one number a
    combination of links (`first`, `second`: indices into `key_pair`, which lists (pair, link of the
    block); `key_row` → `key` counts the paths that carry flow)."""

    rows: jax.Array
    pair: jax.Array
    incidence: Incidence
    paths_per_link: jax.Array
    diagonal: jax.Array
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
        """Choose the block as the links with a large `stiffness` (ρ c′) times Sᵢᵢ at these flows."""
        differences = paths.differences(np.zeros(len(paths.sizes)))
        lengths = np.diff(differences.ends)
        row = np.repeat(np.arange(len(lengths)), lengths)
        pair = np.repeat(np.arange(len(differences.sizes)), differences.sizes)
        paths_per_link = np.bincount(differences.links, minlength=paths.count)
        used = (flows[differences.rows] > 0).astype(float)
        diagonal = _diagonal(pair, row, differences.links, used, paths.count)
        weight = stiffness * diagonal
        block = np.sort(np.argsort(-weight, kind="stable")[:_MAX_BLOCK_LINKS])
        block = block[weight[block] > _STIFF_LINK]
        position = np.full(paths.count, -1)
        position[block] = np.arange(len(block))
        inside = position[differences.links] >= 0
        row, at = row[inside], position[differences.links[inside]]
        # For each path: all ordered combinations of its links in the block.
        order = np.lexsort((at, row))
        row, at = row[order], at[order]
        high, low = _combinations(row)
        of_row, path_cells = row[high], at[high] * len(block) + at[low]
        # For each pair: all ordered combinations of its links in the block, each link once.
        key, inverse = np.unique(pair[row] * max(len(block), 1) + at, return_inverse=True)
        key_pair, key_at = np.divmod(key, max(len(block), 1))
        first, second = _combinations(key_pair)
        pair_cells = key_at[first] * len(block) + key_at[second]

        def int32(a: np.ndarray) -> jax.Array:
            return jnp.asarray(a, jnp.int32)

        self.rows, self.pair, self.block = int32(differences.rows), int32(pair), int32(block)
        self.incidence = Incidence(lengths, differences.links, paths.count)
        self.paths_per_link = jnp.asarray(paths_per_link, float)
        self.diagonal = jnp.asarray(diagonal, float)
        self.cells = int32(np.concatenate([path_cells, pair_cells]))
        self.of_row = int32(of_row)
        self.first, self.second = int32(first), int32(second)
        self.key, self.key_row, self.key_pair = int32(inverse), int32(row), int32(key_pair)
        self.pairs = len(differences.sizes)

    def to_rows(self, a: jax.Array) -> jax.Array:
        """Return, for every row, the number of its pair."""
        return a.at[self.pair].get(mode="promise_in_bounds")

    def sums(self, q: jax.Array) -> jax.Array:
        """Return Σ q over the rows of every pair."""
        return jax.ops.segment_sum(q, self.pair, self.pairs, indices_are_sorted=True)

    def matrix(self, used: jax.Array, count: jax.Array) -> jax.Array:
        """Return the lower triangle of S on the block.

        `used` is 1 for rows that carry flow, and `count` is their number for each pair."""
        size = len(self.block)
        used_by_key = used.at[self.key_row].get(mode="promise_in_bounds")
        keys = len(self.key_pair)
        n = jnp.zeros(keys, used.dtype).at[self.key].add(used_by_key, mode="promise_in_bounds")
        fraction = n / count.at[self.key_pair].get(mode="promise_in_bounds")
        of_rows = used.at[self.of_row].get(mode="promise_in_bounds")
        of_pairs = n.at[self.first].get(mode="promise_in_bounds")
        of_pairs = of_pairs * fraction.at[self.second].get(mode="promise_in_bounds")
        flat = jnp.zeros(size * size, used.dtype)
        values = jnp.concatenate([of_rows, -of_pairs])
        return flat.at[self.cells].add(values, mode="promise_in_bounds").reshape(size, size)


def _diagonal(
    pair: np.ndarray, row: np.ndarray, links: np.ndarray, used: np.ndarray, count: int
) -> np.ndarray:
    """Return Sᵢᵢ of every link; the path `row[k]` contains the link `links[k]`."""
    key, inverse = np.unique(pair[row] * count + links, return_inverse=True)
    n = np.bincount(inverse, used[row])
    fraction = n / np.maximum(np.bincount(pair, used), 1.0)[key // count]
    return np.bincount(key % count, n * (1.0 - fraction), minlength=count)


def _combinations(group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all (i, j) with j ≤ i in the same group, for a sorted `group`."""
    begin = np.searchsorted(group, group)
    counts = np.arange(len(group)) - begin + 1
    first = np.repeat(np.arange(len(group)), counts)
    offset = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return first, begin[first] + offset


class _State(NamedTuple):
    """v, the centred path costs Δᵀc(v), y, w = Δy and the dual function at v."""

    v: jax.Array
    path_costs: jax.Array
    y: jax.Array
    w: jax.Array
    dual: jax.Array


class _Method(NamedTuple):
    """The state of Newton's method.

    `inverse` is the inverse of a Cholesky factor of the block, `products` the numbers of products that
    the first and the last linear system needed with it.
    """

    at: _State
    inverse: jax.Array
    products: tuple[jax.Array, jax.Array]


class LinkNewton(AbstractSolver):
    """Newton's method in the link flows (see the module), for the law of `Traffic` only.

    The initial point is the guess or the flow at `equilibrium`, whichever has the larger dual
    function. The residual is w = ρ Δᵀ(c(Δy) − c(v)) minus its mean over the paths of every pair. This
    mean is normal to K, so w ∈ F(y) + N_K(y).

    **Arguments:** `least`: a lower limit of the tolerance of ‖w‖; `max_steps`. The tolerance is also at
    least the estimated roundoff.

    **Raises:** `dvax.InputError` for any other law.
    """

    choices: Choices
    equilibrium: jax.Array
    least: float
    max_steps: int = 300

    def solve(self, vi: FrozenVI, y0: jax.Array, tol: Any) -> Answer:
        law = _Law(self.choices, vi)
        start = law.K.project(lax.stop_gradient(y0), vi.space)
        from_guess = law.respond(law.link_flows(start))
        from_equilibrium = law.respond(self.equilibrium)
        better = from_equilibrium.dual > from_guess.dual
        at = jax.tree_util.tree_map(
            lambda a, b: jnp.where(better, a, b), from_equilibrium, from_guess
        )

        def begin(*_: Any) -> _Method:
            size = len(self.choices.block)
            none, many = jnp.asarray(0), jnp.asarray(_MAX_PRODUCTS)
            return _Method(at, jnp.zeros((size, size), start.dtype), (none, many))

        def advance(_: FrozenVI, method: _Method) -> tuple[_Method, Trial]:
            new, calls = law.ascend(method)
            w, value = law.certificate(new.at)
            one = jnp.ones((), w.dtype)
            return new, Trial(new.at.y, w, value, one, [new.at.y], calls)

        tol = jnp.maximum(jnp.maximum(tol, self.least), law.roundoff(at))
        # `roundoff` knows the terms of this law, which are larger than y.
        own = vi._replace(rtol=None)
        return iterate(own, at.y, tol, begin, advance, self.max_steps, initial_evaluations=2)


class _Law:
    """The law at a fixed time and state."""

    def __init__(self, choices: Choices, vi: FrozenVI):
        if not (isinstance(vi.F, FrozenOperator) and isinstance(vi.F.h, Proposal)):
            raise input_error(
                "dvax.models.traffic.LinkNewton", f"the operator {vi.F!r}"[:80],
                "it solves the law of dvax.models.Traffic alone",
                "Use dvax.vi.Accelerated()",
            )  # fmt: skip
        frozen: FrozenOperator = vi.F
        F, K, h = jax.tree_util.tree_map(lax.stop_gradient, (frozen.x, vi.K, frozen.h))
        self.x, self.K, self.space, self.choices = F, K, vi.space, choices
        self.costs, self.rho, self.all_paths = h.costs, h.rho, h.incidence
        self.capacity = lax.stop_gradient(h.capacity(frozen.t))
        self.most = h.costs.most
        self.fixed: Any = None

    def link_flows(self, y: jax.Array) -> jax.Array:
        """Return Δy, and store the link flows that do not depend on the choice of paths."""
        v = self.all_paths.flows(y)
        self.fixed = v - self.choices.incidence.flows(self._rows(y))
        return v

    def respond(self, v: jax.Array) -> _State:
        """Return the state at v: path costs, y(v), Δy(v) and the dual function."""
        c = self.costs.costs(v, self.capacity)
        path_costs = self._centred_path_costs(c)
        z = self.x.at[self.choices.rows].add(-self.rho * path_costs)
        y = self.K.project(z, self.space)
        w = self.fixed + self.choices.incidence.flows(self._rows(y))
        offset = y - self.x
        terms = c * (w - v) + self.costs.integrals(v, self.capacity)
        dual = 0.5 * jnp.sum(offset * offset) + self.rho * jnp.sum(terms)
        return _State(v, path_costs, y, w, dual)

    def ascend(self, method: _Method) -> tuple[_Method, jax.Array]:
        """Return (the method after a Newton step with line search, the number of trial points)."""
        at = method.at
        r = at.v - at.w
        D = self.costs.slopes(at.v, self.capacity)
        dv, inverse, products = self._newton(r, D, self._rows(at.y), method)
        slope = jnp.maximum(-self.rho * jnp.sum(r * D * dv), 0.0)
        # A decrease of the dual function within its roundoff is accepted.
        roundoff = 8 * jnp.finfo(r.dtype).eps * jnp.abs(at.dual)

        def attempt(length: Any) -> tuple[_State, jax.Array]:
            new = self.respond(jnp.clip(at.v + length * dv, 0.0, self.most))
            return new, new.dual >= at.dual + _ASCENT_FRACTION * length * slope - roundoff

        def unfinished(carry: tuple) -> jax.Array:
            length, _, accepted, _ = carry
            return ~accepted & (length > _MIN_STEP_LENGTH)

        def halve(carry: tuple) -> tuple:
            length, _, _, trials = carry
            return 0.5 * length, *attempt(0.5 * length), trials + 1

        one = jnp.ones((), r.dtype)
        _, new, _, trials = lax.while_loop(unfinished, halve, (one, *attempt(one), jnp.asarray(1)))
        return _Method(new, inverse, products), trials

    def certificate(self, at: _State) -> tuple[jax.Array, jax.Array]:
        """Return (w ∈ F(y) + N_K(y), F(y) minus a normal), both on all paths."""
        path_costs = self._centred_path_costs(self.costs.costs(at.w, self.capacity))
        rows, zero = self.choices.rows, jnp.zeros_like(at.y)
        w = zero.at[rows].set(self.rho * (path_costs - at.path_costs))
        return w, (at.y - self.x).at[rows].add(self.rho * path_costs)

    def roundoff(self, at: _State) -> jax.Array:
        """Return an estimate of the roundoff in ‖w‖.

        y(v) is the projection of x − ρΔᵀc, whose entries have the roundoff of their terms. Δ adds these
        up, v has its own roundoff, and w = ρΔᵀ(c(Δy) − c(v)) multiplies the difference by ρ c′ and adds
        the roundoff of c. The estimate adds squares, as for independent errors.
        """
        choices, eps = self.choices, jnp.finfo(at.v.dtype).eps
        c, D = (f(at.v, self.capacity) for f in (self.costs.costs, self.costs.slopes))
        z = jnp.abs(self._rows(self.x)) + self.rho * choices.incidence.along(c)
        flows = choices.incidence.flows(z * z) + at.v**2
        squares = choices.paths_per_link * (D**2 * flows + c**2)
        return 4 * eps * self.rho * jnp.sqrt(jnp.sum(squares))

    def _newton(
        self, r: jax.Array, D: jax.Array, y: jax.Array, method: _Method
    ) -> tuple[jax.Array, jax.Array, tuple[jax.Array, jax.Array]]:
        """Return (dv for the residual r, the inverse of the block factor, the numbers of products)."""
        choices, rho, s = self.choices, self.rho, jnp.sqrt(D)
        used = jnp.where(y > 0, 1.0, 0.0)
        count = jnp.maximum(choices.sums(used), 1.0)

        def apply(q: jax.Array) -> jax.Array:
            a = used * choices.incidence.along(q)
            return choices.incidence.flows(a - used * choices.to_rows(choices.sums(a) / count))

        block = choices.block

        def factorise() -> jax.Array:
            inner, unit = s[block], jnp.eye(len(block), dtype=s.dtype)
            matrix = rho * inner[:, None] * inner[None, :] * choices.matrix(used, count)
            factor = jnp.linalg.cholesky(matrix + unit, symmetrize_input=False)
            return jax.scipy.linalg.solve_triangular(factor, unit, lower=True)

        first, last = method.products
        is_old = last > first + _REFACTORISE_PRODUCTS
        inverse = lax.cond(is_old, factorise, lambda: method.inverse)

        outside = 1.0 / (1.0 + rho * D * choices.diagonal)

        def precondition(g: jax.Array) -> jax.Array:
            return (outside * g).at[block].set((inverse @ g[block]) @ inverse)

        g, Ssg, products = _conjugate_gradients(apply, precondition, s, rho, -s * r)
        # For an inexact g, the first formula has the smaller error in s dv on stiff links. The error
        # of the second remains bounded as s → 0.
        stiff = rho * D * choices.paths_per_link > _STIFF_LINK
        dv = jnp.where(stiff, g / jnp.where(stiff, s, 1.0), -r - rho * Ssg)
        return dv, inverse, (jnp.where(is_old, products, first), products)

    def _rows(self, y: jax.Array) -> jax.Array:
        return y.at[self.choices.rows].get(mode="promise_in_bounds")

    def _centred_path_costs(self, c: jax.Array) -> jax.Array:
        """Return the path costs minus their mean over each pair.

        A constant for each pair does not change the law; subtracting it reduces cancellation."""
        a = self.choices.incidence.along(c)
        number = jnp.maximum(self.choices.sums(jnp.ones_like(a)), 1.0)
        return a - self.choices.to_rows(self.choices.sums(a) / number)


def _conjugate_gradients(
    apply: Callable[[jax.Array], jax.Array],
    precondition: Callable[[jax.Array], jax.Array],
    s: jax.Array,
    rho: jax.Array,
    b: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return (g, S s g, number of products) for (I + ρ s S s) g = b, where `apply` applies S."""

    def unfinished(carry: tuple) -> jax.Array:
        _, _, r, _, _, products = carry
        return (jnp.sum(r * r) > goal) & (products < _MAX_PRODUCTS)

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

    goal = _CG_TOLERANCE**2 * jnp.sum(b * b)
    p, zero = precondition(b), jnp.zeros_like(b)
    start = zero, zero, b, p, jnp.sum(b * p), jnp.asarray(0)
    g, Ssg, *_, products = lax.while_loop(unfinished, step, start)
    return g, Ssg, products
