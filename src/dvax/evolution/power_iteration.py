"""The largest slope of what a method treats explicitly, by power iteration along the steps.

A derivative of the run is a solution of the linearised equation v' = (A + Df̃)v, by the steps that the
state has chosen. Where the state stands still, or moves along a line, its error is zero for any step
size, however fast v changes: a spring that starts at rest, differentiated in its position, would take
steps beyond the limit of stability, and v would grow without bound. So where a derivative is wanted
the step size is limited by σ, the spectral radius of B = Df̃ (of A + Df̃ for a method that is explicit
in A), whatever the state does (`Adaptive`). For a method that linearises, B is φ₁(h(A + J))(Df̃ − J)
with the J of the start of the step: what a change of Df̃ adds in a step, divided by h.

Each step applies B twice to a direction d, at its end, and where f̃ depends on t at its start and at
the samples inside too:

    σ = √(‖B²d‖/‖d‖),   d ← B²d/‖B²d‖ + p/10,   ‖p‖ = 1.

The square makes σ independent of the units of positions and velocities: for x'' = −ω²x it is ω for any
d. The pattern p contains all frequencies, and its entries are as large as those of x: entries in other
units would be amplified by the ratio of the units. It keeps a part of d in entries that a held response
decouples now, and not later. σ is an estimate, from below for a normal B within a factor of 1.1 after
some steps.

Where the fastest solutions decay, others remain: the slope of a second direction, in which they have
decayed, limits the steps as well (`remaining`).
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._jax.jaxprs import has_operation
from .._tree import Tree
from ..spaces import AbstractSpace

_SHARE = 0.1
"""Share of the pattern p in the next direction."""

_PRESENT = 1e-6
"""Share of the pattern that is added to what has not decayed: what is excited later is seen."""

_OF_ZERO = 1e-6
"""Entry of the pattern where x is zero, relative to the largest one."""

_ALONG = 0.7
"""Cosine from which a vector points along another one: it is 1 for an eigenvector of a real eigenvalue,
and below 0.71 for eigenvalues whose imaginary parts exceed the real ones."""


def pattern(space: AbstractSpace, x: Tree) -> Tree:
    """Return p, a state of norm 1 in which all frequencies are present, with entries as large as those
    of x; all alike where x is zero."""
    leaves, tree = jtu.tree_flatten(x)
    largest = jnp.max(jnp.stack([jnp.max(jnp.abs(leaf), initial=0.0) for leaf in leaves]))
    least = jnp.where(largest > 0.0, _OF_ZERO * largest, 1.0)
    count, entries = 0, []
    for leaf in leaves:
        # A chirp that neighbouring entries, and equal parts of the state, do not repeat.
        k = jnp.arange(count, count + leaf.size, dtype=leaf.dtype).reshape(leaf.shape)
        size = jnp.where(leaf == 0.0, least, jnp.abs(leaf))
        entries.append(size * jnp.cos(1.0 + k * (1.0 + 0.6180339887 * k)))
        count += leaf.size
    return _normalised(space, jtu.tree_unflatten(tree, entries))


def linearised(fn: Callable[[Tree, Any], Tree], x: Tree, p: Any) -> Callable[[Tree, Any], Tree]:
    """Return (v, q) ↦ Dfn(x, p)(v, q). Where code has a derivative of its own in reverse alone
    (`jax.custom_vjp`), v ↦ Dₓfn v is transposed, which has the same spectrum, and q is ignored."""
    push = jax.linearize(fn, x, p)[1]
    # JAX refuses such code when it compiles, and not here.
    if has_operation(jax.make_jaxpr(push)(x, p), {"custom_lin"}):
        pull = jax.vjp(lambda x: fn(x, p), x)[1]
        return lambda v, q: pull(v)[0]
    return push


class Refined(NamedTuple):
    """What one application of B² to the direction d shows.

    - `slope`: σ;
    - `is_damped`: v decays where it changes fastest;
    - `first`: Bd;
    - `direction`: the next d.
    """

    slope: Any
    is_damped: Any
    first: Tree
    direction: Tree


def images(
    push: Callable[[Tree, jax.Array], Tree], vectors: tuple[Tree, ...], count: int
) -> tuple[list[tuple[Tree, Tree]], Tree]:
    """Return (Bv, B²v) for each v, and the `count` rows of G, where push(v, w) is Bv + Gᵀw: by a loop,
    so that the derivative is in the program once."""

    def apply(v: Tree, start: tuple[Tree, Any, jax.Array]) -> tuple[Tree, Tree]:
        fresh, begins, weights = start
        image = push(_tree.where(begins, fresh, v), weights)
        return image, image

    many = 2 * len(vectors)
    zeros = [_tree.zeros_like(vectors[0])] * count
    starts = [v for v in vectors for _ in range(2)] + zeros
    fresh = jtu.tree_map(lambda *leaves: jnp.stack(leaves), *starts)
    begins = (jnp.arange(many + count) % 2 == 0) | (jnp.arange(many + count) >= many)
    weights = jnp.concatenate([jnp.zeros((many, count)), jnp.eye(count)])
    _, found = lax.scan(apply, vectors[0], (fresh, begins, weights))
    row = lambda k: jtu.tree_map(lambda leaf: leaf[k], found)  # noqa: E731
    twice = [(row(2 * k), row(2 * k + 1)) for k in range(len(vectors))]
    return twice, jtu.tree_map(lambda leaf: leaf[many:], found)


def refine(space: AbstractSpace, d: Tree, one: Tree, two: Tree, p: Tree) -> Refined:
    """Return what Bd (`one`) and B²d (`two`) show. A B that is zero or not finite leaves the direction
    as it is, and σ = 0: it limits nothing.

    v decays where Bd points against d, and B²d along it: an oscillation has −ω²d there, though its
    velocities alone may point anywhere."""
    length = space.norm(two)
    size = length / space.norm(d)
    known = jnp.isfinite(size) & (size > 0.0)
    unit = _tree.scale(1.0 / jnp.where(known, length, 1.0), two)
    mixed = _tree.add(unit, _tree.scale(_SHARE, p))
    slope = jnp.where(known, jnp.sqrt(size), 0.0)
    return Refined(slope, _decays(space, d, one, two), one, _tree.where(known, mixed, d))


def _decays(space: AbstractSpace, v: Tree, one: Tree, two: Tree) -> Any:
    """Return whether Bv (`one`) points against v, and B²v (`two`) along it."""
    length = space.norm(two)
    is_real = space.inner(v, two) > _ALONG * space.norm(v) * length
    return is_real & (space.inner(one, two) < -_ALONG * space.norm(one) * length)


def variation(
    space: AbstractSpace, nodes: tuple[float, ...], rows: Tree, least: Any = 0.0
) -> tuple[Any, Any]:
    """Return hω of a function of θ with these rows at the nodes in [0, 1], as if it were a multiple of
    e^{ihωθ}: (m! |divided difference|/|function|)^{1/m} for the highest order m. It is 0 for a
    polynomial of a lower degree, and for two nodes or fewer. |function| counts as `least` at least.
    Return |function| too."""
    m = len(nodes) - 1
    largest = jnp.max(jax.vmap(space.norm)(rows))
    if m < 2:
        return jnp.zeros(()), largest
    weights = [1.0 / math.prod(a - b for b in nodes if b != a) for a in nodes]
    difference = jtu.tree_map(
        lambda leaf: jnp.tensordot(jnp.asarray(weights, leaf.dtype), leaf, 1), rows
    )
    size = jnp.maximum(largest, least)
    known = jnp.isfinite(size) & (size > 0.0)
    share = math.factorial(m) * space.norm(difference) / jnp.where(known, size, 1.0)
    return jnp.where(known, share ** (1.0 / m), 0.0), largest


def remaining(
    space: AbstractSpace, e: Tree, one: Tree, two: Tree, slope: Any, p: Tree
) -> tuple[Any, Any, Tree]:
    """Return the slope √(‖B²e‖/‖e‖) of what has not decayed, from Be (`one`) and B²e (`two`), whether
    it decays now, and the next e,

        e ← e + τBe + τ²B²e/2 + 10⁻⁶p,   τ = 1/σ,

    in which the fastest decay is halved, and an oscillation stays. σ is the `slope`."""
    size = space.norm(two) / space.norm(e)
    known = jnp.isfinite(size) & (slope > 0.0)
    tau = 1.0 / jnp.where(known, slope, 1.0)
    after = _tree.add(e, _tree.add(_tree.scale(tau, one), _tree.scale(0.5 * tau**2, two)))
    after = _tree.add(_normalised(space, after), _tree.scale(_PRESENT, p))
    slope = jnp.where(known, jnp.sqrt(size), 0.0)
    return slope, _decays(space, e, one, two), _tree.where(known, after, e)


def _normalised(space: AbstractSpace, d: Tree) -> Tree:
    length = space.norm(d)
    return _tree.scale(1.0 / jnp.where(length > 0.0, length, 1.0), d)
