"""Sampling and ascent over a region: counterexamples to a modulus, and lower bounds of it."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..programs.derivatives_of_operations import has_derivative
from ..programs.slope import is_slope
from ..sets._weights import flat_roots, full_weights
from ..spaces import AbstractSpace
from .region import Region
from .system import System

_STARTS, _ASCENT_STEPS = 256, 60
"""Number of starting points of a search, and of ascent steps from each."""

_MAX_ENTRIES = 2_000_000
"""Largest number of entries of all starting points together: in high dimensions there are fewer."""

_ROUNDING_FACTOR = 1e4
"""Assumed rounding error of F, in units of ε times its norm."""

_NEAREST = 1e-6
"""Smallest distance of two points whose products tell a sign."""

_JUMP_HALVINGS = 70
"""Number of halvings of a segment, after which its ends are equal or neighbouring numbers."""

_JUMP_SHARE = 1e-3
"""Share of the largest change of a function, above which a change between neighbours is a jump and not
rounding."""

_MAX_DENSE_SIZE = 64
"""Up to this size the norm of a derivative is computed from singular values."""


class CounterexamplePair(NamedTuple):
    """Two points y and z of K(t) that contradict the modulus of F at (t, x).

    `forward` = ⟨F(y), z − y⟩ ≥ 0, but `backward` = ⟨F(z), z − y⟩ < γ‖z − y‖² for every γ above `gamma`.
    """

    t: float
    x: Tree
    y: Tree
    z: Tree
    gamma: float
    forward: float
    backward: float


class Jump(NamedTuple):
    """A function changes by `height` between `place` and the next number."""

    height: float
    place: Tree


class SlopeSearch(NamedTuple):
    """A lower bound on a Lipschitz modulus, and a jump of the function, if one was found."""

    value: float
    jump: Jump | None


def search_slope(system: System, region: Region, name: str, by: str) -> SlopeSearch:
    """Return a lower bound on the Lipschitz modulus of `name` ("f" or "h") in `by` ("x" or "u").

    A search in a bounded region takes the largest norm of the derivative, where there is one, and the
    largest difference quotient between near and far points, and halves the segments between far points
    towards a jump.
    """
    fn = getattr(system.problem, name)
    out = system.state if name == "f" else system.control
    into = system.state if by == "x" else system.control

    def with_argument(t: Any, x: Tree, u: Tree, v: Tree) -> Tree:
        """Evaluate the function with v in place of x or u."""
        return fn(t, v, u, system.args) if by == "x" else fn(t, x, v, system.args)

    def norm(point: tuple) -> jax.Array:
        t, x, u = point
        return _norm(partial(with_argument, t, x, u), x if by == "x" else u, out, into)

    low, high = _bounds(region)
    starts = _points(low, high, _STARTS, 1)
    t, *at = jtu.tree_map(lambda leaf: leaf[0], starts)
    known = has_derivative(partial(with_argument, t, *at), at[0 if by == "x" else 1])
    best = [jax.jit(lambda starts: _climb(norm, starts, low, high)[1])(starts)] if known else []
    others = _points(low, high, _STARTS, 2)
    quotients = []
    k = 1 if by == "x" else 2
    for fraction in (1.0, 1e-3, 1e-6):
        ends = jtu.tree_map(lambda a, b, r=fraction: a + r * (b - a), starts[k], others[k])
        quotients.append(
            jax.vmap(lambda p, v: _quotient(with_argument, p, v, out, into, by))(starts, ends)
        )
    slopes = jnp.concatenate([*best, *quotients])
    value = float(jnp.max(jnp.where(jnp.isfinite(slopes), slopes, 0.0)))
    return SlopeSearch(value, _jump(with_argument, starts, starts[k], others[k], out))


def _jump(fn: Callable, points: tuple, starts: Tree, ends: Tree, out: AbstractSpace) -> Jump | None:
    """Return the largest jump of fn(t, x, u, v) in v that halving of segments finds, or None.

    The change over two neighbouring numbers is a jump if it is more than a share of the largest change
    over a whole segment. A function with such a slope is resolved by no step.
    """

    def change(point: tuple, v: Tree, w: Tree) -> jax.Array:
        size = out.norm(_tree.sub(fn(*point, v), fn(*point, w)))
        return jnp.where(jnp.isfinite(size), size, 0.0)

    def halve(point: tuple, v: Tree, w: Tree) -> tuple[jax.Array, jax.Array, Tree]:
        def half(k: Any, ends: tuple[Tree, Tree]) -> tuple[Tree, Tree]:
            v, w = ends
            middle = jtu.tree_map(lambda a, b: 0.5 * (a + b), v, w)
            is_first = change(point, v, middle) >= change(point, middle, w)
            return _tree.where(is_first, v, middle), _tree.where(is_first, middle, w)

        first, second = jax.lax.fori_loop(0, _JUMP_HALVINGS, half, (v, w))
        return change(point, v, w), change(point, first, second), first

    whole, last, places = jax.jit(jax.vmap(halve))(points, starts, ends)
    worst = int(jnp.argmax(last))
    height = float(last[worst])
    if not height > _JUMP_SHARE * float(jnp.max(whole)):
        return None

    def place(leaf: jax.Array, end: jax.Array) -> jax.Array:
        # Halving towards 0 ends at a rounding of the segment.
        at = leaf[worst]
        return jnp.where(jnp.abs(at) <= 1e-12 * jnp.abs(end[worst]), 0.0, at)

    return Jump(height, jtu.tree_map(place, places, ends))


def find_counterexample(system: System, region: Region) -> CounterexamplePair | None:
    """Search a bounded region for two points that no strongly pseudomonotone F admits.

    The pair has a modulus `gamma` below zero, so it refutes every positive one. The result is None if
    none was found.
    """
    low, high = _bounds(region)
    ends = (*low, low[2]), (*high, high[2])
    starts = _points(*ends, 4 * _STARTS, 3, on_faces=True)
    return _pair(*_most_violated(_Law.of(system), starts, *ends))


class Monotonicity(NamedTuple):
    """The smallest ⟨F(y) − F(z), y − z⟩/‖y − z‖² that a search finds, an upper bound on the modulus of
    strong monotonicity of F; and a counterexample to strong pseudomonotonicity, if it is negative and
    one was found from there."""

    value: float
    counterexample: CounterexamplePair | None


def smallest_monotonicity(system: System, region: Region) -> Monotonicity:
    """Return the result of a search over a bounded region."""
    law, (low, high) = _Law.of(system), _bounds(region)
    width = jtu.tree_map(jnp.subtract, high[2], low[2])
    shortest, longest = jnp.asarray(1e-3), jnp.asarray(1.0)
    ends = (*low, _tree.scale(-1.0, width), shortest), (*high, width, longest)
    value, worst = _least_monotone(law, _points(*ends, _STARTS, 4, on_faces=True), *ends)
    if not float(value) < 0:
        return Monotonicity(float(value), None)
    return Monotonicity(float(value), _pair(*_between_signs(law, worst, low[:2], high[:2])))


class _Products(NamedTuple):
    """y and z in K(t), ⟨F(y), z − y⟩, ⟨F(z), z − y⟩, ‖z − y‖ and ‖F(y)‖ + ‖F(z)‖."""

    y: Tree
    z: Tree
    forward: jax.Array
    backward: jax.Array
    length: jax.Array
    norms: jax.Array

    @property
    def gain(self) -> jax.Array:
        """By how much the signs of both products contradict strong pseudomonotonicity."""
        return jnp.minimum(self.forward, -self.backward)


class _Law(eqx.Module):
    """The law of a problem with its parameters: one compiled search serves all their values."""

    problem: Any
    args: Any
    control: AbstractSpace

    @classmethod
    def of(cls, system: System) -> "_Law":
        return cls(system.problem, _tree.as_arrays(system.args), system.control)

    def products(self, t: Any, x: Tree, u: Tree, w: Tree) -> _Products:
        """Return the products for the projections y of Pu and z of Pw onto K(t)."""
        problem, args, space = self.problem, self.args, self.control
        P, K, F = problem.operator(args), problem.set_at(t, args), problem.frozen(t, x, args)
        y, z = K.project(P.apply(u), space), K.project(P.apply(w), space)
        Fy, Fz, d = F(y), F(z), _tree.sub(z, y)
        forward, backward = space.inner(Fy, d), space.inner(Fz, d)
        return _Products(y, z, forward, backward, space.norm(d), space.norm(Fy) + space.norm(Fz))


@eqx.filter_jit
def _most_violated(law: _Law, starts: Any, low: Any, high: Any) -> tuple[Any, Tree, _Products, Any]:
    """Return t, x, the products and their gain less its rounding error for the clearest counterexample
    that an ascent from many starts finds; it is one if the gain is positive."""

    def violation(v: tuple) -> jax.Array:
        products = law.products(*v)
        near = products.length > _NEAREST
        gain = products.gain / jnp.maximum(products.length, _NEAREST) ** 2
        return jnp.where(near, gain, -jnp.inf)

    candidates = _climb(violation, starts, low, high)[0]
    products = jax.vmap(lambda v: law.products(*v))(candidates)
    gain = _certain(products)
    first = lambda tree: jtu.tree_map(lambda leaf: leaf[jnp.argmax(gain)], tree)  # noqa: E731
    t, x, *_ = first(candidates)
    return t, x, first(products), jnp.max(gain)


@eqx.filter_jit
def _least_monotone(law: _Law, starts: Any, low: Any, high: Any) -> tuple[Any, Any]:
    """Return the smallest quotient that an ascent from many starts finds, and (t, x, u, w) there. The
    variables are t, x, u and the direction and length of w − u."""

    def second(u: Tree, direction: Tree, length: Any) -> Tree:
        return jtu.tree_map(
            lambda p, e, a, b: jnp.clip(p + length.astype(e.dtype) * e, a, b),
            u, direction, low[2], high[2],
        )  # fmt: skip

    def negative_quotient(v: tuple) -> jax.Array:
        t, x, u, direction, length = v
        products = law.products(t, x, u, second(u, direction, length))
        square = products.length**2
        # The rounding error of a product of near points.
        rounding = 64 * jnp.finfo(square.dtype).eps * products.norms * products.length
        product = products.backward - products.forward + rounding
        return jnp.where(square > 1e-12, -product / jnp.maximum(square, 1e-12), -jnp.inf)

    points, values = _climb(negative_quotient, starts, low, high)
    values = jnp.where(jnp.isfinite(values), values, -jnp.inf)
    t, x, u, direction, length = jtu.tree_map(lambda leaf: leaf[jnp.argmax(values)], points)
    return -jnp.max(values), (t, x, u, second(u, direction, length))


@eqx.filter_jit
def _between_signs(law: _Law, point: Any, low: Any, high: Any) -> tuple[Any, Tree, _Products, Any]:
    """Return what `_most_violated` does for the u and w of a point, at the t and x of a box where both
    products have one size and other signs, if there are any on the segment along which they change
    fastest."""
    t, x, u, w = point

    def middle(place: Any) -> jax.Array:
        t, x = place
        products = law.products(t, x, u, w)
        return 0.5 * (products.forward + products.backward)

    slope = jax.grad(middle)((t, x))
    is_rising = jtu.tree_map(lambda g: g > 0, slope)

    def halve(_: Any, segment: tuple[Any, Any]) -> tuple[Any, Any]:
        below, above = segment
        half = jtu.tree_map(lambda a, b: 0.5 * (a + b), below, above)
        is_below = middle(half) < 0
        return _tree.where(is_below, half, below), _tree.where(is_below, above, half)

    segment = (
        jtu.tree_map(jnp.where, is_rising, low, high),
        jtu.tree_map(jnp.where, is_rising, high, low),
    )
    t, x = jax.lax.fori_loop(0, _JUMP_HALVINGS, halve, segment)[0]
    products = law.products(t, x, u, w)
    return t, x, products, _certain(products)


def _certain(products: _Products) -> jax.Array:
    """Return the gain less its rounding error; −∞ for points that are too near."""
    eps = jnp.finfo(products.length.dtype).eps
    gain = products.gain - _ROUNDING_FACTOR * eps * products.norms * products.length
    return jnp.where((products.length > _NEAREST) & jnp.isfinite(gain), gain, -jnp.inf)


def _pair(t: Any, x: Tree, products: _Products, gain: Any) -> CounterexamplePair | None:
    if not float(gain) > 0:
        return None
    return CounterexamplePair(
        float(t), x, products.y, products.z, float(products.backward / products.length**2),
        float(products.forward), float(products.backward),
    )  # fmt: skip


def _climb(
    value: Callable[[Any], jax.Array], starts: Any, low: Any, high: Any
) -> tuple[Any, jax.Array]:
    """Return the points after sign-gradient ascent with decreasing steps, accepted if they increase
    `value`, and the values there."""
    width = jtu.tree_map(jnp.subtract, high, low)

    def step(k: Any, carry: tuple) -> tuple:
        point, best, slope, trial = carry
        new_value, new_slope = jax.value_and_grad(value)(trial)
        better = new_value > best
        point, slope = _tree.where(better, trial, point), _tree.where(better, new_slope, slope)
        fraction = 0.3 * 0.9**k
        trial = jtu.tree_map(
            lambda p, g, w, a, b: jnp.clip(p + fraction * w * jnp.sign(jnp.nan_to_num(g)), a, b),
            point, slope, width, low, high,
        )  # fmt: skip
        return point, jnp.where(better, new_value, best), slope, trial

    def climb(point: Any) -> tuple[Any, jax.Array]:
        least = jnp.full_like(jax.eval_shape(value, point), -jnp.inf)
        start = point, least, _tree.zeros_like(point), point
        return jax.lax.fori_loop(0, _ASCENT_STEPS + 1, step, start)[:2]

    return jax.vmap(climb)(starts)


def _quotient(
    fn: Callable, point: tuple, end: Tree, out: AbstractSpace, into: AbstractSpace, by: str
) -> jax.Array:
    """Return ‖fn(end) − fn(start)‖/‖end − start‖ less a bound on the rounding error, where start is
    the x or u of `point`."""
    t, x, u = point
    start = x if by == "x" else u
    a, b = fn(t, x, u, end), fn(t, x, u, start)
    length = into.norm(_tree.sub(end, start))
    eps = jnp.finfo(length.dtype).eps
    change = out.norm(_tree.sub(a, b)) - 64 * eps * (out.norm(a) + out.norm(b))
    return jnp.where(length > 0, change / jnp.where(length > 0, length, 1.0), 0.0)


def _norm(
    fn: Callable[[Tree], Tree], v: Tree, out: AbstractSpace, into: AbstractSpace
) -> jax.Array:
    """Return ‖∂fn‖ at v from singular values, or for large arrays by a few power iterations."""
    size = sum(leaf.size for leaf in jtu.tree_leaves(v))
    value, derivative = jax.linearize(fn, v)
    if size <= _MAX_DENSE_SIZE:
        flat, unravel = jax.flatten_util.ravel_pytree(v)
        roots = flat_roots(into, v)
        rows = jax.vmap(lambda e: derivative(unravel(e / roots)))(jnp.eye(size, dtype=flat.dtype))
        matrix = jax.vmap(lambda row: jax.flatten_util.ravel_pytree(row)[0])(rows)
        matrix = matrix * flat_roots(out, value)[None, :]
        square = matrix @ matrix.T
        return jnp.sqrt(
            jnp.linalg.norm(square, ord="fro") if size == 1 else _largest_eigenvalue(square)
        )
    transpose = jax.linear_transpose(derivative, v)
    d = jtu.tree_map(jnp.ones_like, v)
    gain = jnp.zeros(())
    for _ in range(8):
        d = _tree.scale(1.0 / jnp.maximum(into.norm(d), 1e-300), d)
        image = derivative(d)
        gain = out.norm(image)
        (d,) = transpose(jtu.tree_map(jnp.multiply, image, full_weights(out, image)))
        d = jtu.tree_map(jnp.divide, d, full_weights(into, d))
    return gain


def _largest_eigenvalue(square: jax.Array) -> jax.Array:
    return jnp.maximum(jnp.linalg.eigvalsh(square)[-1], 1e-300)


def _bounds(region: Region) -> tuple[Any, Any]:
    ends = (
        jtu.tree_map(lambda v, i=i: jnp.asarray(v[i]), tuple(region)[:3], is_leaf=is_slope)
        for i in (0, 1)
    )
    return next(ends), next(ends)


def _points(low: Any, high: Any, count: int, seed: int, on_faces: bool = False) -> Any:
    """Return random points, uniform in a box, including its centre and two corners. With `on_faces`,
    about half of the entries of every second point lie at an end: monotone functions have their
    extremes there."""
    rng = np.random.default_rng(seed)
    size = sum(leaf.size for leaf in jtu.tree_leaves(low))
    count = max(4, min(count, _MAX_ENTRIES // size))

    def draw(a: jax.Array, b: jax.Array) -> jax.Array:
        fraction = rng.random((count, *a.shape))
        if on_faces:
            ends = rng.integers(0, 4, fraction[::2].shape)
            fraction[::2] = np.where(ends < 2, ends, fraction[::2])
        fraction[0], fraction[1], fraction[2] = 0.0, 1.0, 0.5
        low, high = np.asarray(a), np.asarray(b)
        return jnp.asarray(low + fraction * (high - low), a.dtype)

    return jtu.tree_map(draw, low, high)
