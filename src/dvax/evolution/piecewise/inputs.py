"""The inputs g(t) and q(t) of an affine system as polynomials in pieces.

Between two knots of the data they are analytic. A stretch on which they are lines is one piece; others
are halved until Chebyshev interpolation has converged, which its coefficients and further points show.
The points are no fraction of a period apart from each other, so that a wave does not pass for a
constant.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..._tree import Tree
from ...problem import Problem
from .radau import STAGES

Array = np.ndarray

_POINTS = np.cos(np.pi * (np.arange(STAGES + 1) + 0.5) / (STAGES + 1))
_TO_COEFFICIENTS = np.linalg.inv(np.polynomial.chebyshev.chebvander(_POINTS, STAGES))
_LINE = np.array([-0.93, -0.5441, 0.0713, 0.4129, 0.8537])
_EXTRA = np.array([-0.9871, -0.4127, 0.0317, 0.3719, 0.8853])
_NOISE = 64.0
"""Roundings of t and of the value that a sample may be off by."""


class Piece(NamedTuple):
    """(g, q) on [start, start + length], by Chebyshev coefficients, a row each degree; `noise` is what
    rounding of t and of the values leaves undetermined. `error`, how far the polynomial was off at
    points that did not make it, is an estimate and no bound."""

    start: float
    length: float
    coefficients: Array
    noise: Array
    error: Array

    def at(self, places: Array) -> Array:
        """(g, q), a row each place in [0, 1]."""
        if len(self.coefficients) == 1:
            return np.broadcast_to(self.coefficients[0], (len(places), self.error.size))
        s = 2.0 * np.asarray(places) - 1.0
        return np.polynomial.chebyshev.chebval(s, self.coefficients).T

    def local(self, begin: float, length: float) -> Array:
        """The coefficients of the polynomial on a part of the piece, those left out that are rounding:
        on a part that is short the samples would differ by nothing else."""
        c = self.coefficients
        s, share = 2.0 * (begin + 0.5 * length) / self.length - 1.0, length / self.length
        if len(c) <= 2:
            return np.stack([c[0] + s * c[1], share * c[1]]) if len(c) == 2 else c
        values = np.polynomial.chebyshev.chebval(s + share * _POINTS, c).T
        found = _TO_COEFFICIENTS @ values
        seen = np.abs(found) > _CHOPPED * np.abs(c).sum(axis=0)
        degree = int(np.flatnonzero(seen.any(axis=1)).max(initial=1))
        return (
            np.where(np.arange(degree + 1)[:, None] < 2, 1.0, seen[: degree + 1])
            * found[: degree + 1]
        )


def values(coefficients: Array, basis: Array) -> Array:
    """The polynomials at the points of a basis (a row each, a column each degree)."""
    return basis[:, : len(coefficients)] @ coefficients


def basis(places: Array) -> Array:
    """Chebyshev polynomials at places in [0, 1]."""
    return np.polynomial.chebyshev.chebvander(2.0 * places - 1.0, STAGES)


_CHOPPED = 16.0 * np.finfo(float).eps


class Unresolved(Exception):
    """No polynomial fits the inputs around a time, on however short a piece; or they are not finite
    there, or need more pieces than there may be. `result` is the name of that in `dvax.RESULTS`."""

    def __init__(self, t: float, result: str):
        super().__init__(t)
        self.t, self.result = t, result


@eqx.filter_jit
def _samples(problem: Problem, args: Any, x: Tree, u: Tree, ts: Any) -> Any:
    def one(t: Any) -> Any:
        f, h = problem.f(t, x, u, args), problem.h(t, x, u, args)
        return jnp.concatenate([f.ravel(), -h.ravel()])

    return jax.vmap(one)(ts)


def pieces(problem: Problem, stops: Array, x0: Any, args: Any, most: int) -> list[Piece]:
    """Those of all stretches between `stops`.

    **Raises:** `Unresolved` where a stretch of a few roundings of t, or `most` pieces, do not do.
    """
    dtype = jnp.result_type(x0)
    x, u = jnp.zeros_like(x0), problem.zero_control(x0)
    eps = float(jnp.finfo(dtype).eps)

    def sampled(starts: Array, lengths: Array, places: Array) -> Array:
        """Values at these places of every stretch: [stretch, place, entry]."""
        ts = (starts[:, None] + lengths[:, None] * (0.5 + 0.5 * places)).ravel()
        # In powers of two: the program is compiled for few counts.
        padded = np.pad(ts, (0, (1 << (len(ts) - 1).bit_length()) - len(ts)), mode="edge")
        values = np.asarray(_samples(problem, args, x, u, jnp.asarray(padded, dtype)), float)
        values = values[: len(ts)].reshape(len(starts), len(places), -1)
        bad = ~np.isfinite(values).all(axis=(1, 2))
        if bad.any():
            raise Unresolved(float(starts[bad][0]), "nonfinite")
        return values

    done: list[Piece] = []
    starts, lengths = stops[:-1], np.diff(stops)
    values = sampled(starts, lengths, _LINE)
    slope = (values[:, -1] - values[:, 0]) / (_LINE[-1] - _LINE[0])
    middle = values[:, 0] - _LINE[0] * slope
    off = np.abs(values - middle[:, None] - _LINE[:, None] * slope[:, None]).max(axis=1)
    ends = np.abs(starts) + lengths
    noise = _NOISE * eps * (np.abs(values).max(axis=1) + np.abs(slope) * (ends / lengths)[:, None])
    lines = (off <= noise).all(axis=1)
    for k in np.flatnonzero(lines):
        rows = np.stack([middle[k], slope[k]])
        flat = np.all(np.abs(slope[k]) <= noise[k])
        done.append(Piece(starts[k], lengths[k], rows[:1] if flat else rows, noise[k], 0 * off[k]))
    starts, lengths = starts[~lines], lengths[~lines]
    places = np.concatenate([_POINTS, _EXTRA])
    while len(starts):
        values = sampled(starts, lengths, places)
        nodes, extra = values[:, : STAGES + 1], values[:, STAGES + 1 :]
        c = np.einsum("ij,kjl->kil", _TO_COEFFICIENTS, nodes)
        basis = np.polynomial.chebyshev.chebvander(_EXTRA, STAGES)
        off = np.abs(np.einsum("ij,kjl->kil", basis, c) - extra).max(axis=1)
        steep = np.abs(c[:, 1:]).sum(axis=1)
        near = ((np.abs(starts) + lengths) / lengths)[:, None]
        noise = _NOISE * eps * (np.abs(c).sum(axis=1) + steep * near)
        tail = np.abs(c[:, -3:]).max(axis=1)
        good = ((off <= noise) & (tail <= noise)).all(axis=1)
        error = np.maximum(off - noise, 0.0)
        done += [
            Piece(starts[k], lengths[k], c[k], noise[k], error[k]) for k in np.flatnonzero(good)
        ]
        starts, lengths = starts[~good], lengths[~good]
        short = lengths <= 1e3 * eps * (np.abs(starts) + lengths)
        if short.any():
            raise Unresolved(float(starts[short][0]), "step_too_small")
        if len(done) + len(starts) > most:
            raise Unresolved(float(stops[0]), "max_steps")
        half = 0.5 * lengths
        starts = np.stack([starts, starts + half], axis=1).ravel()
        lengths = np.repeat(half, 2)
    return _joined(sorted(done, key=lambda piece: piece.start))


def _joined(pieces: list[Piece]) -> list[Piece]:
    """The same pieces, continuous where they meet within their noise: the value of the one with less of
    it is taken, and a line is added to the other. A steep edge far from t = 0 is not known better."""
    changes = np.zeros((len(pieces), 2, len(pieces[0].noise)))
    for k in range(len(pieces) - 1):
        left, right = pieces[k], pieces[k + 1]
        apart = right.at(np.zeros(1))[0] - left.at(np.ones(1))[0]
        same = np.abs(apart) <= left.noise + right.noise
        changes[k, 1] = np.where(same & (left.noise > right.noise), apart, 0.0)
        changes[k + 1, 0] = np.where(same & (left.noise <= right.noise), -apart, 0.0)
    found = []
    for piece, (first, last) in zip(pieces, changes, strict=True):
        c = piece.coefficients
        if first.any() or last.any():
            c = np.concatenate([c, np.zeros((max(0, 2 - len(c)), c.shape[1]))])
            c[0] += 0.5 * (first + last)
            c[1] += 0.5 * (last - first)
        found.append(piece._replace(coefficients=c))
    return found


def continuous(before: Piece, after: Piece) -> bool:
    """Whether the inputs go on from one piece to the next without a jump."""
    end, start = before.at(np.ones(1))[0], after.at(np.zeros(1))[0]
    size = np.abs(before.coefficients).sum(axis=0) + np.abs(after.coefficients).sum(axis=0)
    return bool(np.all(np.abs(end - start) <= 8.0 * _NOISE * np.finfo(float).eps * size))
