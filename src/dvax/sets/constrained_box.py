"""Boxes with linear conditions: bounds on the unknowns and on a few sums of them."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .. import _tree
from .._small_matrices import MAX_ROWS, combine, product, solve, solve_constant, times
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from ._dual_active_set import SLACK
from ._moving import jvp_of_moving
from ._weights import inverse_weights
from .abstract import AbstractSet

_DAMPING = 64.0
"""Multiple of eps that is added to the diagonal of the Newton matrix, relative to its largest value."""
_LINEAR = 1e-6
"""Part of the gaps of the rows that a Newton step leaves, from which the dual function counts as linear
along it."""
_DEPENDENT = 1e-8
"""Singular value of rows of length one below which they count as dependent."""
_LINE_SEARCH = 400
"""Maximum number of points of a line search. Bisection alone needs about 60, and more for a maximiser
much nearer than the end of the search."""


class ConstrainedBox(AbstractSet):
    """K = {y : lower ≤ y ≤ upper, low ≤ R y ≤ high}, with plain sums (R y)ₖ = Σᵢ Rₖᵢ yᵢ whatever the
    space's weights. A row with low = high is an equation.

    With multipliers μ of the rows, proj_K(z) = clip(z − W⁻¹Rᵀμ, lower, upper), where W has the weights
    of the space. μ maximises the dual function of the projection, which is concave and piecewise
    quadratic, and has as many variables as there are rows. Newton's method with an exact line search
    maximises it. A step adds the row that is violated most, and removes a row whose multiplier
    reaches 0. The method ends with the exact piece, so the rows hold to roundoff (relative 2e-12 in
    double precision). An iteration costs a few products with R, where `Polyhedron` treats every
    bound as a row of its own. R may have many rows, but few may be active: an iteration changes at
    most 16 multipliers, so that with more active rows convergence is slow.

    The derivative, in z and all data, is that of the projection onto the active bounds and rows. A row
    that holds with equality counts as active, even with the multiplier 0. If all entries of an active
    row are at their bounds, one of them moves with the row: the derivative is then the one-sided one
    for a row that is tightened. With more than 16 active rows it is NaN.

    **Arguments:** `lower`, `upper`: numbers or vectors; `R`: a matrix, one row a condition; `low`,
    `high`: vectors. All bounds may be infinite.

    **Raises:** `dvax.InputError` if the set is empty, entries of R are not finite, or shapes differ.
    The projection is NaN if traced data describe an empty set, or if the method does not converge.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K = dvax.sets.ConstrainedBox(0.0, 1.0, jnp.ones((1, 3)), jnp.array([2.0]), jnp.array([2.0]))
    >>> [round(float(v), 12) for v in K.project(jnp.array([3.0, 0.5, 0.1]), dvax.spaces.Euclidean(3))]
    [1.0, 0.7, 0.3]

    ```
    """

    lower: jax.Array
    upper: jax.Array
    R: jax.Array
    low: jax.Array
    high: jax.Array

    def __init__(self, lower: Any, upper: Any, R: Any, low: Any, high: Any):
        name = "dvax.sets.ConstrainedBox"
        self.lower = _tree.as_array(lower, f"{name}(lower)")
        self.upper = _tree.as_array(upper, f"{name}(upper)")
        self.R = _tree.as_array(R, f"{name}(R)")
        self.low = _tree.as_array(low, f"{name}(low)")
        self.high = _tree.as_array(high, f"{name}(high)")
        rows = jnp.shape(self.R)[:1]
        if jnp.ndim(self.R) != 2 or not (jnp.shape(self.low) == jnp.shape(self.high) == rows):
            raise input_error(
                f"{name}(R, low, high)",
                f"shapes {jnp.shape(self.R)}, {jnp.shape(self.low)} and {jnp.shape(self.high)}",
                "R must be a matrix, and low and high must have one number for each of its rows",
                "Give R the shape (conditions, unknowns), and low and high (conditions,)",
            )
        _tree.require(
            lambda: np.all(np.isfinite(np.asarray(self.R))), f"{name}(R)", self.R,
            "the entries of R must be finite", "Correct the entries that are not",
        )  # fmt: skip
        for first, second, low_end, high_end in (
            ("lower", "upper", self.lower, self.upper), ("low", "high", self.low, self.high),
        ):  # fmt: skip
            _tree.require(
                lambda a=low_end, b=high_end: _are_intervals(np.asarray(a), np.asarray(b)),
                f"{name}({first}, {second})", (low_end, high_end),
                f"{first} ≤ {second}, {first} < +∞ and {second} > −∞ must hold, or the set is empty",
                "Swap the bounds, or widen the interval",
            )  # fmt: skip

        data = self.lower, self.upper, self.R, self.low, self.high
        if _tree.is_concrete(data):
            _check_nonempty(name, *map(np.asarray, data))

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        return _nearest(*self._data(z, space))[0]

    def multipliers(self, z: Tree, space: AbstractSpace) -> jax.Array:
        """Return the multipliers μ of the rows: W(z − proj_K(z)) − Rᵀμ is normal to the box there.

        μₖ > 0 where the row is at `high`, and μₖ < 0 where it is at `low`. If F(y) = Wy − Wz is the
        derivative of a cost, μₖ is the change of the least cost with −low or −high."""
        return _nearest(*self._data(z, space))[1]

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        """Return the distances of z − W⁻¹Rᵀμ to both bounds, and for each row its slack, or −|μ| if
        the row is active. An equation never switches: its entry is −1."""
        z, inverse_w, lower, upper, R, low, high = self._data(z, space)
        y, multiplier, _, exact = _nearest(z, inverse_w, lower, upper, R, low, high)
        shifted, sums = z - inverse_w * combine(multiplier, R), times(R, y)
        # The derivative of the difference, with the value to which the steps have summed.
        shifted = shifted + lax.stop_gradient(exact - shifted)
        # A row is released where the derivative no longer counts it as active.
        slack = jnp.minimum(high - sums, sums - low) - _tolerance(y, R, low, high)
        of_rows = jnp.where(multiplier == 0, slack, -jnp.abs(multiplier))
        return [shifted - lower, upper - shifted, jnp.where(low == high, -1.0, of_rows)]

    def _data(self, z: Tree, space: AbstractSpace) -> tuple[Any, ...]:
        # Bounds given as Python numbers take the type of z.
        lower, upper = (
            jnp.broadcast_to(jnp.asarray(b, jnp.result_type(b, z)), z.shape)
            for b in (self.lower, self.upper)
        )
        return z, inverse_weights(space, z), lower, upper, self.R, self.low, self.high

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        n = jnp.shape(self.R)[1]
        shapes = jnp.shape(self.lower), jnp.shape(self.upper)
        fits = not isinstance(like, tuple) and jnp.shape(like) == (n,)
        if not fits or any(shape not in ((), (1,), (n,)) for shape in shapes):
            raise input_error(
                "dvax.sets.ConstrainedBox",
                f"{n} columns of R, and bounds of the shapes {shapes[0]} and {shapes[1]}",
                f"R must have one column, and lower and upper one number (or one for all), for each "
                f"entry of the vector y = P u, of shape {_tree.shapes(like)}",
                "Give R the shape (conditions, unknowns)",
            )


def bounds_and_rows(
    K: ConstrainedBox, z: jax.Array, space: AbstractSpace
) -> tuple[jax.Array, jax.Array, tuple[jax.Array, ...], tuple[jax.Array, ...], jax.Array]:
    """Return the projection y, the normal v there, the multipliers and slacks of the upper and the
    lower bounds and of both ends of the rows, and how roundoff in active rows moves y."""
    z, inverse_w, lower, upper, R, low, high = data = K._data(z, space)
    y, mu, free, shifted = _nearest(*data)
    beyond, sums = shifted - y, times(R, y)  # normal to the box
    multipliers = tuple(
        jnp.maximum(sign * a, 0.0) for a in (beyond / inverse_w, mu) for sign in (1.0, -1.0)
    )
    of_rows = []
    for is_active, slack in ((mu > 0.0, high - sums), (mu < 0.0, sums - low)):
        is_held = is_active | (low == high) | (slack <= _tolerance(y, R, low, high))
        of_rows.append(jnp.where(is_held, 0.0, slack))
    slacks = upper - y, y - lower, *of_rows
    condition = _condition(R, (mu != 0.0) | (low == high), free, jnp.sqrt(inverse_w))
    return y, beyond + inverse_w * combine(mu, R), multipliers, slacks, condition


def _condition(R: Any, is_active: Any, free: Any, root: Any) -> jax.Array:
    """Return 1/σ for the smallest singular value σ of the active rows of length one, on the entries at
    no bound. Rows that depend on others up to roundoff are left out, as the projection does."""
    scaled = R * root[None, :]
    lengths = jnp.sqrt(jnp.sum(scaled * scaled, axis=1))
    scaled = (
        scaled * (jnp.where(is_active, 1.0, 0.0) / jnp.where(lengths > 0, lengths, 1.0))[:, None]
    )
    chosen = _largest(is_active.astype(jnp.int32), min(*R.shape, MAX_ROWS))
    sizes = jnp.linalg.svd(scaled[chosen] * free[None, :], compute_uv=False)
    return 1.0 / jnp.min(jnp.where(sizes > _DEPENDENT, sizes, 1.0), initial=1.0)


class _State(NamedTuple):
    """Multipliers, z − W⁻¹Rᵀμ, y and R y there, the added row (−1: none), and whether the iteration is
    over.

    z − W⁻¹Rᵀμ is the sum of all steps. Far from the set it is much smaller than both of its terms, and
    their difference would not have the digits in which the rows hold."""

    multiplier: jax.Array
    shifted: jax.Array
    y: jax.Array
    sums: jax.Array
    added: jax.Array
    count: jax.Array
    over: jax.Array


@jax.custom_jvp
def _nearest(
    z: jax.Array, inverse_w: jax.Array, lower: jax.Array, upper: jax.Array,
    R: jax.Array, low: jax.Array, high: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:  # fmt: skip
    """Return the projection y, the multipliers μ, 1 for entries at no bound and else 0, and the
    z − W⁻¹Rᵀμ of which y is the nearest point in the box; y is NaN if the method failed."""
    m = R.shape[0]
    width = min(m, MAX_ROWS)
    eps = jnp.finfo(z.dtype).eps
    index = jnp.arange(m)
    is_equation = low == high
    damping = _DAMPING * eps * times(R * R, inverse_w)
    damping = jnp.where(damping > 0, damping, 1.0)

    def excess_of(sums: jax.Array) -> jax.Array:
        """Return how far each row lies above `high` (positive) or below `low` (negative)."""
        return jnp.maximum(sums - high, 0.0) + jnp.minimum(sums - low, 0.0)

    def advance(s: _State) -> _State:
        on_high = s.multiplier > 0
        excess = excess_of(s.sums)
        # The derivative of the dual function in the multipliers that are not 0.
        gap = jnp.where(on_high, s.sums - high, s.sums - low)
        is_active = is_equation | (s.multiplier != 0) | (index == s.added)
        gap = jnp.where(s.multiplier == 0, excess, gap)
        # The rows of a Newton step: the active ones with the largest gaps.
        least = _tolerance(s.y, R, low, high)
        priority = jnp.where(is_active, 1.0 + jnp.abs(gap) / least, 0.0)
        chosen = _largest(priority, width)
        used = is_active[chosen]
        rows = jnp.where(used[:, None], R[chosen], 0.0)
        is_free = (s.shifted > lower) & (s.shifted < upper)
        scaled = rows * jnp.where(is_free, inverse_w, 0.0)[None, :]
        # A row that holds stays as it is, if it could only be moved by a large change.
        is_fixed = jnp.all(scaled == 0, axis=1) | (s.added >= 0)
        pull = jnp.where(is_fixed & (jnp.abs(gap) <= least)[chosen], 0.0, gap[chosen])
        pull = jnp.where(used, pull, 0.0)
        diagonal = jnp.where(used, damping[chosen], 1.0)
        matrix = product(scaled, rows.T) + jnp.diag(diagonal)
        step = jnp.where(used, solve_constant(matrix, pull), 0.0)
        # The step of an added row has the sign of its gap, up to rounding: the others hold.
        old = s.multiplier[chosen]
        is_new = (old == 0) & ~is_equation[chosen]
        step = jnp.where(is_new, jnp.copysign(step, pull), step)
        direction = combine(step, rows)
        change = -inverse_w * direction
        # Where the rows are dependent on the free entries, as those whose entries are all at bounds,
        # the dual function is linear up to the next piece, however far that is, and damping alone
        # limits the step. It ends where all entries are through their bounds, or the ascent is over:
        # with larger multipliers rows would lose their digits.
        ascent = jnp.sum(step * pull)
        is_linear = jnp.max(jnp.abs(diagonal * step), initial=0.0) > _LINEAR * jnp.max(
            jnp.abs(pull), initial=0.0
        )
        speed = jnp.where(lower < upper, jnp.abs(change), 0.0)
        is_moved = speed > _LINEAR * jnp.max(speed, initial=0.0)
        rate = jnp.where(is_moved, jnp.abs(direction), jnp.inf)
        inside = jnp.minimum(upper - lower, ascent / rate)
        farthest = 2.0 * jnp.max((jnp.abs(s.shifted - s.y) + inside) / (inverse_w * rate))
        full = jnp.where(is_linear & jnp.any(is_moved), farthest, 1.0)
        # A multiplier of an inequality keeps its sign; it leaves the active rows at 0.
        towards_zero = ~is_equation[chosen] & (old * step < 0)
        ratios = jnp.where(towards_zero, -old / jnp.where(towards_zero, step, 1.0), jnp.inf)
        most = jnp.minimum(full, jnp.min(ratios))
        slope_bound = jnp.sum(step * (s.sums[chosen] - pull))
        length = _line_search(s.shifted, change, lower, upper, direction, slope_bound, most, eps)
        leaves = towards_zero & (ratios <= length)
        new = jnp.where(leaves, 0.0, old + length * step)
        multiplier = new if width == m else s.multiplier.at[chosen].set(new)
        return check(multiplier, s.shifted + length * change, s.count + 1)

    def check(multiplier: jax.Array, shifted: jax.Array, count: Any) -> _State:
        """Return the state at these multipliers, with the row to add."""
        y = jnp.clip(shifted, lower, upper)
        sums = times(R, y)
        excess, least = excess_of(sums), _tolerance(y, R, low, high)
        gap = jnp.where(multiplier > 0, sums - high, sums - low)
        is_active = is_equation | (multiplier != 0)
        unsolved = jnp.where(is_equation, excess, jnp.where(multiplier != 0, gap, 0.0))
        is_solved = jnp.all(jnp.abs(unsolved) <= least)
        violation = jnp.where(is_active, 0.0, jnp.abs(excess) / least)
        row = jnp.argmax(violation)
        is_violated = violation[row] > 1.0
        added = jnp.where(is_solved & is_violated, row, -1)
        over = (is_solved & ~is_violated) | ~jnp.all(jnp.isfinite(multiplier))
        return _State(multiplier, shifted, y, sums, added, jnp.asarray(count), over)

    def unfinished(s: _State) -> jax.Array:
        return ~s.over & (s.count < 100 + 10 * m)

    end = lax.while_loop(unfinished, advance, check(jnp.zeros(m, z.dtype), z, 0))
    is_valid = end.over & jnp.all(jnp.isfinite(end.multiplier))
    is_valid &= jnp.all(lower <= upper) & jnp.all(low <= high)
    # Not by y: XLA computes bounds that depend on t again for this comparison, possibly with other
    # roundings than those to which y is equal.
    is_free = (end.shifted > lower) & (end.shifted < upper)
    y = jnp.where(is_valid, end.y, jnp.nan)
    return y, end.multiplier, is_free.astype(z.dtype), end.shifted


def _largest(priority: jax.Array, width: int) -> Any:
    """Return the indices of the `width` largest entries; if these are all entries, a slice of all."""
    return slice(None) if width == len(priority) else lax.top_k(priority, width)[1]


def _tolerance(y: jax.Array, R: Any, low: Any, high: Any) -> jax.Array:
    """Return the violation of each row that counts as roundoff."""
    bound = jnp.maximum(
        jnp.where(jnp.isfinite(low), jnp.abs(low), 0.0),
        jnp.where(jnp.isfinite(high), jnp.abs(high), 0.0),
    )
    lengths = jnp.sqrt(jnp.sum(R * R, axis=1))
    eps, tiny = jnp.finfo(y.dtype).eps, jnp.finfo(y.dtype).tiny
    # Not 0, where y or a row is 0: gaps are divided by it.
    return lax.stop_gradient(eps**SLACK * (bound + lengths * jnp.sqrt(jnp.sum(y * y))) + tiny)


def _line_search(
    start: jax.Array, change: jax.Array, lower: jax.Array, upper: jax.Array,
    direction: jax.Array, bound: jax.Array, most: jax.Array, eps: Any,
) -> jax.Array:  # fmt: skip
    """Return the maximiser in (0, most] of the dual function along a direction of ascent.

    Its derivative d·clip(start + αc) − bound, with d the direction and c = −W⁻¹d, decreases and is
    piecewise linear: Newton's method with bisection as a safeguard finds its zero."""

    def slope(alpha: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        moved = start + alpha * change
        y = jnp.clip(moved, lower, upper)
        second = jnp.sum(jnp.where((moved > lower) & (moved < upper), direction * change, 0.0))
        size = jnp.sum(jnp.abs(direction * y)) + jnp.abs(bound)
        return jnp.sum(direction * y) - bound, second, size

    def unfinished(state: tuple) -> jax.Array:
        return ~state[-1] & (state[-2] < _LINE_SEARCH)

    def advance(state: tuple) -> tuple:
        low, high, alpha, count, _ = state
        first, second, size = slope(alpha)
        low, high = jnp.where(first > 0, alpha, low), jnp.where(first > 0, high, alpha)
        newton = alpha - first / jnp.where(second < 0, second, -1.0)
        inside = (second < 0) & (newton > low) & (newton < high)
        new = jnp.where(inside, newton, 0.5 * (low + high))
        done = (jnp.abs(first) <= 8 * eps * size) | (high - low <= 2 * eps * high)
        return low, high, jnp.where(done, alpha, new), count + 1, done

    at_end = slope(most)
    # A full step within one piece ends where the derivative is zero up to roundoff.
    enough = at_end[0] >= -64 * eps * at_end[2]
    zero = jnp.zeros_like(most)
    first_guess = jnp.where(enough, most, 0.5 * most)
    state = (zero, most, first_guess, jnp.asarray(0), enough)
    return lax.while_loop(unfinished, advance, state)[2]


def _nearest_jvp(primals: tuple, tangents: tuple) -> tuple:
    """The derivative of the projection onto the active bounds and rows, which are fixed."""
    # A constant R may be an array of NumPy, which no traced index selects from.
    primals = tuple(map(jnp.asarray, primals))
    y, multiplier, free, shifted = _nearest(*primals)
    sums = times(primals[4], y)
    least = _tolerance(y, *primals[4:])
    # A row that holds with equality is active, as in every set.
    at_high = jnp.where(multiplier == 0, sums >= primals[6] - least, multiplier > 0)
    at_low = jnp.where(multiplier == 0, sums <= primals[5] + least, multiplier < 0)
    is_active = at_high | at_low
    width = min(*primals[4].shape, MAX_ROWS)
    chosen = _largest(is_active.astype(jnp.int32), width)
    active, on_high = is_active[chosen], at_high[chosen]
    at_lower = shifted <= primals[2]
    outwards = jnp.where(active, jnp.where(on_high, 1.0, -1.0), 0.0)
    rows, movable = outwards[:, None] * primals[4][chosen], primals[2] < primals[3]
    is_free = (free > 0) | _released(rows, free, shifted - y, primals[1], movable)
    # Beyond 16 active rows the derivative is not available.
    factor = jnp.where(jnp.sum(is_active) <= width, jnp.ones((), y.dtype), jnp.nan)

    def project_on_face(z, inverse_w, lower, upper, R, low, high) -> jax.Array:
        rows = jnp.where(active[:, None], R[chosen], 0.0)
        bound = jnp.where(active, jnp.where(on_high, high[chosen], low[chosen]), 0.0)
        fixed = jnp.where(at_lower, lower, upper)
        base = jnp.where(is_free, z, jnp.where(jnp.isfinite(fixed), fixed, 0.0))
        scaled = rows * jnp.where(is_free, inverse_w, 0.0)[None, :]
        # Rows that depend on others make the matrix singular.
        damping = _DAMPING * jnp.finfo(z.dtype).eps * times(rows * rows, inverse_w)
        diagonal = jnp.where(damping > 0, damping, 1.0)
        matrix = product(scaled, rows.T) + jnp.diag(lax.stop_gradient(diagonal))
        right = jnp.where(active, times(rows, base) - bound, 0.0)
        return base - combine(solve(matrix, right), scaled)

    dy = jvp_of_moving(project_on_face, primals, tangents)
    constant = multiplier, free, shifted
    return (y, *constant), (factor * dy, *(jnp.zeros_like(v) for v in constant))


def _released(
    rows: jax.Array, free: jax.Array, beyond: jax.Array, inverse_w: jax.Array, movable: jax.Array
) -> jax.Array:
    """Return which entries leave their bounds where the limits of the active rows change: for each row
    with no free entry, the one that has to move first where the row is tightened. With no such entry
    the derivative at a vertex would violate the row.

    `rows` point outwards, `beyond` is how far entries would be above (+) or below (−) their bounds."""
    rates = jnp.abs(rows) * inverse_w[None, :]
    is_held = ~jnp.any((rates > 0) & (free > 0)[None, :], axis=1)
    candidate = (rates > 0) & movable[None, :]
    inwards = candidate & (rows * beyond[None, :] >= 0)
    # An equation at the end of its range can only be relaxed.
    candidate = jnp.where(jnp.any(inwards, axis=1, keepdims=True), inwards, candidate)
    distance = jnp.abs(beyond)[None, :] / jnp.where(candidate, rates, 1.0)
    first = jnp.argmin(jnp.where(candidate, distance, jnp.inf), axis=1)
    is_first = candidate & (first[:, None] == jnp.arange(rows.shape[1])[None, :])
    return jnp.any(is_held[:, None] & is_first, axis=0)


_nearest.defjvp(_nearest_jvp, symbolic_zeros=True)


def _are_intervals(low: np.ndarray, high: np.ndarray) -> Any:
    return np.all((low <= high) & (low < np.inf) & (high > -np.inf))


def _check_nonempty(
    name: str,
    lower: np.ndarray,
    upper: np.ndarray,
    R: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
) -> None:
    """Raise an `InputError` if no y within the bounds satisfies all rows.

    Solve the linear programme: minimise v ≥ 0 subject to low − v ≤ R y ≤ high + v, with rows whose
    largest entry is 1."""
    import scipy.optimize  # a slow import that only this function needs

    n = R.shape[1]
    if any(end.shape not in ((), (1,), (n,)) for end in (lower, upper)):
        return  # `check` explains the shapes
    scale = np.max(np.abs(R), axis=1, initial=0.0)
    scale = np.where(scale > 0, scale, 1.0)
    rows = np.vstack([R, -R]) / np.concatenate([scale, scale])[:, None]
    ends = np.concatenate([high, -low]) / np.concatenate([scale, scale])
    is_bounded = ends < np.inf
    box = np.stack([np.broadcast_to(lower, n), np.broadcast_to(upper, n)], axis=1)
    answer = scipy.optimize.linprog(
        np.append(np.zeros(n), 1.0),
        A_ub=np.hstack([rows, -np.ones((len(ends), 1))])[is_bounded],
        b_ub=ends[is_bounded],
        bounds=[*box.tolist(), (0.0, None)],
    )
    size = np.max(np.abs(ends[is_bounded]), initial=0.0) or 1.0
    # If the linear programme fails, accept the set: the projection checks its own result.
    violation = answer.x[-1] if answer.status == 0 else 0.0
    if violation > 1e-6 * size:
        raise input_error(
            f"{name}(lower, upper, R, low, high)",
            f"{len(low)} rows that no y within the bounds satisfies: the smallest possible violation, "
            f"for rows with the largest entry 1, is {violation:.3g}",
            "the set must not be empty, or the law has no solution",
            "Widen low and high, or the bounds of the unknowns",
        )
