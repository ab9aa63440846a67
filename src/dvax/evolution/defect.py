"""How far a step's polynomial p is from f̃ along the trajectory x_h that it makes: δ = p − f̃(·, x_h)."""

from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax

from .. import _tree
from .._tree import Tree
from ..generators import (
    AbstractGenerator,
    AbstractMatrixFree,
    Dense,
    FlowStep,
    Growth,
    Product,
    Rotation,
    Sparse,
)
from ..generators.spectral_state import values
from ..programs.branches import branches
from ..programs.enclosure import LinearEnclosure, is_enclosure
from ..spaces import AbstractSpace
from .bounds import Bounds
from .enclosed_projection import widened
from .evaluations import Evaluation
from .excursions import trusted_length
from .flow import Flow, Rate
from .method import AbstractMethod, combined, extrapolation, polynomial

_SAFETY = 4.0
"""By how many times its interpolation error z is taken to be uncertain between the samples."""

_MARGIN = 1.25
"""Factor of a defect that is estimated from samples, since a step with two kinks, as an excursion has,
may have more than `safety` allows for; of the generated problems one bound was too small without it."""

_MOMENT = 0.3
"""Part of the mean modulus of a defect of mean zero that its first moment may have."""

_UNRESOLVED = 0.1
"""Part of the mean modulus of a defect that a polynomial through its samples may not show."""

ROUNDINGS = 8.0
"""Roundings that a step makes of x and of h f̃."""

_SETTLES = 1e-3
"""Part of x by which a change of f̃ within a short step may change x over the run."""


class Sample(NamedTuple):
    """The defect of one step: its modulus entry by entry for the step control (`error`), and its signed
    mean where it cancels (`signed`, else None), and its `mean` with its sign; whether the regime
    changes inside (`kinked`); integrated for certificates; the rates along x_h that
    it was made from, the last one at the end; and where x_h and u_h have been."""

    thetas: tuple[float, ...]
    rates: list[Rate]
    error: Tree
    defect: jax.Array
    law_defect: jax.Array
    bounds: Bounds
    signed: Tree | None = None
    mean: Tree | None = None
    kinked: Any = True


def enclosed(
    flow: Flow, growth: Growth, ends: tuple[Any, Any], arc: FlowStep, rates: tuple[Rate, Rate],
    span: Any,
) -> Sample:  # fmt: skip
    """|δ(θ)| ≤ (1−θ)(|δ(0)| + dev) + θ(|δ(1)| + dev) entry by entry, with dev from a linear
    enclosure, since p is a line; so ∫‖δ‖ is at most the mean of the norms of the two brackets
    (the norm of their mean would be too little: ends may lie in different entries). δ(0) is
    rounding, unless data jumps where nobody said it would. The step lies between the times `ends`.

    Where an entry has no bound, as next to the zero of √s, the defect is infinite, and so is what
    it certifies; in a step that is short in a run of this `span` the step control goes by how far f̃
    moves from one end to the other.

    The response may differ from the u of the enclosure, by what `flow` bounds: this is the defect of
    the law."""
    ends, arc, growth, span = lax.stop_gradient((ends, arc, growth, span))
    h, x0, x1, c = values(tuple(arc))
    short = h <= trusted_length(span)
    space = flow.state_space(x0)
    bend = flow.generator.chord_deviation(arc, space, growth)
    x = jtu.tree_map(LinearEnclosure, x0, x1, bend)
    time = LinearEnclosure(*ends, jnp.zeros_like(h))
    along, u, law_residual, apart, effect = flow.enclosure(time, x, *rates)
    at_start = jtu.tree_map(
        lambda q, p: jnp.abs(q.a - p) + q.dev, along, c[0], is_leaf=is_enclosure
    )
    at_end = jtu.tree_map(
        lambda q, p: jnp.abs(q.b - p) + q.dev, along, polynomial(c, 1.0), is_leaf=is_enclosure
    )
    error = _tree.scale(0.5, _tree.add(at_start, at_end))
    varies = jtu.tree_map(lambda q: jnp.abs(q.b - q.a), along, is_leaf=is_enclosure)
    # Not where f̃ grows without bound, as 1/t does.
    most = lambda tree: jnp.max(jnp.stack([jnp.max(jnp.abs(v)) for v in jtu.tree_leaves(tree)]))  # noqa: E731
    size = most((x0, x1))
    settles = short & jnp.isfinite(size) & (most(varies) * span <= _SETTLES * size)
    error = jtu.tree_map(lambda e, v: jnp.where(settles & (e == jnp.inf), v, e), error, varies)
    defect = 0.5 * h * (space.norm(at_start) + space.norm(at_end))
    if flow.interpolated:
        # Any part of f̃ may have the effect.
        mean = effect / jnp.sqrt(space.size()).astype(effect.dtype)
        error = jtu.tree_map(lambda e: e + mean, error)
        u = widened(u, apart, flow.problem.spaces(x0)[1])
    bounds = Bounds.of_enclosures(x, u)
    return Sample((), [rates[1]], error, defect, h * law_residual, bounds)


def sampled(
    flow: Flow,
    method: AbstractMethod,
    h: Any,
    x0: Tree,
    c: Any,
    evaluations: list[Evaluation],
    slope: Any,
    propagate: Callable[[tuple[Tree, ...]], Tree] | None,
) -> Sample:
    """δ at the start, at the samples of the method inside and at the end of the step.

    Between the samples δ is taken to be a line plus a bump (a parabola, or the tent of a kink):
    then ∫|δ| ≤ h(½|δ(0)| + ½|δ(1)| + max |δ(θ) − (1 − θ)δ(0) − θδ(1)|), whatever the place of the
    kink, up to the `safety` of the method and a margin for steps with two; where the regime does not
    change inside, certificates take the polynomial through the samples instead. δ(0) is zero for a
    method whose polynomial starts at f̃(t₀, x₀), as most do.

    Over a smooth step of a method with a `quadrature`, `signed` is the signed mean |∫δ|/h, with a share
    of the mean modulus for ∫ (1 − θ) h B δ, where `slope` = h‖B‖ and B = A + Df̃: to first order the
    error of x₁ is ∫ e^{(1−θ)hB} δ. A method that linearises has B at hand: `propagate` maps the
    coefficients of a polynomial to that integral, times h, and `signed` is it for the polynomial
    through the samples. The integral for certificates stays that of the modulus.
    """
    thetas = method.samples
    along = [evaluations[0], *evaluations[-1 - len(thetas) :]]
    _, *inner, last = (one.rate for one in along)
    start, *middle, end = (
        _tree.sub(flow.nonlinear_part(one.x, one.rate.value), polynomial(c, theta))
        for theta, one in zip((0.0, *thetas, 1.0), along, strict=True)
    )
    bumps = []
    for theta, defect in zip(thetas, middle, strict=True):
        line = _tree.add(_tree.scale(1.0 - theta, start), _tree.scale(theta, end))
        bumps.append(jtu.tree_map(jnp.abs, _tree.sub(defect, line)))

    # How well z, the unconstrained value of the law, is predicted by its other samples.
    zs = [one.rate.z for one in along]
    weights = extrapolation((0.0, *thetas, 1.0))
    doubt = jtu.tree_map(
        lambda *z: _SAFETY * sum(w * v for w, v in zip(weights, z, strict=True)), *zs
    )
    unseen = _unseen(flow, along[1:], doubt)
    ends = _tree.scale(0.5, start), _tree.scale(0.5, end)
    bump = _largest(bumps)
    kinked = _kinked(flow, lax.stop_gradient(along))
    error = jtu.tree_map(lambda *parts: sum(map(jnp.abs, parts)), *ends, bump)
    signed = None
    defects, nodes = (start, *middle, end), (0.0, *thetas, 1.0)
    if propagate is not None:
        mean = _tree.scale(1.0 / h, propagate(_interpolant(nodes, defects)))
        signed = jtu.tree_map(
            lambda m, e: jnp.where(kinked, e, jnp.abs(m) + _UNRESOLVED * e), mean, error
        )
        signed = _tree.add(signed, unseen)
    else:
        weights = method.quadrature or _interpolatory(nodes)
        mean = combined(*zip(weights, defects, strict=True))
    if method.quadrature is not None:
        # A defect of mean zero still acts on the way through the step.
        share = jnp.minimum(_MOMENT * jnp.where(jnp.isfinite(slope), slope, jnp.inf), 1.0)
        signed = jtu.tree_map(
            lambda m, e: jnp.where(kinked, e, jnp.minimum(jnp.abs(m) + share * e, e)), mean, error
        )
        signed = _tree.add(signed, unseen)
    error = _tree.add(error, unseen)
    space = flow.state_space(x0)
    # Entries with a kink by their bump, the others by their polynomial.
    pick = lambda of_kinked: lambda v: jnp.where(kinked == of_kinked, v, 0.0)  # noqa: E731
    parts = [jtu.tree_map(pick(True), part) for part in (*ends, bump)]
    smooth = [jtu.tree_map(pick(False), one) for one in defects]
    mean_norm = sum(map(space.norm, (*parts, unseen))) + _mean_norm(space, nodes, smooth)
    defect = _MARGIN * method.safety * h * mean_norm
    law_defect = h * jnp.max(jnp.stack([one.rate.residual for one in along]))
    places = [(one.x, flow.operator.inverse(one.rate.y)) for one in lax.stop_gradient(along)]
    bounds = reduce(Bounds.hull, [Bounds((x, x), (u, u)) for x, u in places])
    return Sample(thetas, [*inner, last], error, defect, law_defect, bounds, signed, mean, kinked)


def roundoff(space: AbstractSpace, A: AbstractGenerator, arc: FlowStep, inset: Any) -> jax.Array:
    """Return a disturbance that is at least the roundoff of a step, so that bounds cover it as well.

    Propagation and summation are taken to have relative errors of `ROUNDINGS` ε, and so is the length h
    of the step, on which x depends as h‖x'‖. At both ends f̃ is evaluated within the step, in all by
    `inset` away from them: f̃ is then the polynomial Σcₖθᵏ with another θ, which changes it by less than
    2 Σk‖cₖ‖ inset/h. In a step of an analytic semigroup h‖Ax‖ is of the size of ‖x‖, and is left out.
    """
    h, x0, x1, c = lax.stop_gradient(values(tuple(arc)))
    size = jnp.maximum(space.norm(x0), space.norm(x1))
    terms = [space.norm(v) for v in c]
    speed = sum(terms) + (space.norm(A.apply(x1)) if _may_oscillate(A) else 0.0)
    change = sum(k * term for k, term in enumerate(terms))
    return ROUNDINGS * jnp.finfo(h.dtype).eps * (size + h * speed) + 2.0 * inset * change


def _may_oscillate(A: AbstractGenerator) -> bool:
    """Return whether x' = Ax may turn fast, unlike diffusion."""
    if isinstance(A, Product):
        return any(map(_may_oscillate, A.parts))
    return isinstance(A, Dense | Rotation | Sparse | AbstractMatrixFree)


def _interpolant(nodes: tuple[float, ...], values: tuple[Tree, ...]) -> tuple[Tree, ...]:
    """Return the coefficients of the polynomial with these values at the nodes."""
    rows = np.linalg.inv(np.vander(nodes, increasing=True)).tolist()
    return tuple(combined(*zip(row, values, strict=True)) for row in rows)


def _mean_norm(space: AbstractSpace, nodes: tuple[float, ...], values: list[Tree]) -> Any:
    """Return ∫₀¹‖q‖ of the polynomial q with these values at the nodes, by Simpson's rule."""
    c = _interpolant(nodes, tuple(values))
    count = 2 * (len(nodes) - 1)
    weights = np.array([1.0, *[4.0 if j % 2 else 2.0 for j in range(1, count)], 1.0]) / (
        3.0 * count
    )
    thetas = jnp.linspace(0.0, 1.0, count + 1, dtype=jtu.tree_leaves(c)[0].dtype)
    norms = jax.vmap(lambda theta: space.norm(polynomial(c, theta)))(thetas)
    return jnp.dot(jnp.asarray(weights, norms.dtype), norms)


def _interpolatory(nodes: tuple[float, ...]) -> tuple[float, ...]:
    """Return the weights of the interpolatory quadrature on [0, 1] with these nodes."""
    powers = np.vander(nodes, increasing=True).T
    return tuple(np.linalg.solve(powers, 1.0 / np.arange(1.0, len(nodes) + 1.0)).tolist())


def _kinked(flow: Flow, evaluations: list[Evaluation]) -> Any:
    """Return whether the regime changes between two of the evaluations, as far as the switches of K and
    the branches of f and h show; true if K has no switches. For a pointwise flow, return that of each
    entry."""
    problem, args = flow.problem, flow.args
    known = [flow.switches_of(one.t, one.x, one.rate) for one in evaluations]
    if known[0] is None:
        return jnp.asarray(True)

    def signs(one: Evaluation, switches: list[jax.Array]) -> list[jax.Array]:
        u, found = flow.operator.inverse(one.rate.y), list(switches)
        for fn in (problem.f, problem.h):
            found += branches(lambda t, x, u, fn=fn: fn(t, x, u, args), one.t, one.x, u)
        return [s > 0 for s in found]

    kinked = jnp.asarray(False)
    rows = [signs(one, s) for one, s in zip(evaluations, known, strict=True) if s is not None]
    for series in zip(*rows, strict=True):
        stacked = jnp.stack(series)
        changed = jnp.any(stacked[1:] != stacked[:-1], axis=0)
        is_entrywise = flow.pointwise and changed.shape == evaluations[0].x.shape
        kinked = kinked | (changed if is_entrywise else jnp.any(changed))
    return kinked


def _unseen(flow: Flow, evaluations: list[Evaluation], doubt: Tree) -> Tree:
    """The most that is hidden at any of them; where projections are iterated, from one place of
    the program, as in `evaluations`."""
    masked = lambda v: flow.masked_error(v.t, v.x, v.rate, doubt)  # noqa: E731
    if not flow.iterates:
        return _largest([masked(one) for one in evaluations])
    stacked = lax.map(masked, jtu.tree_map(lambda *leaves: jnp.stack(leaves), *evaluations))
    return jtu.tree_map(lambda leaf: jnp.max(leaf, axis=0), stacked)


def _largest(trees: list[Tree]) -> Tree:
    """Entry by entry."""
    return reduce(lambda a, b: jtu.tree_map(jnp.maximum, a, b), trees)
