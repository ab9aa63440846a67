"""Error bounds along a trajectory, piece by piece in time.

Constants of the whole space may not exist, and those of a region around a whole trajectory are large:
errors then seem to grow everywhere as fast as they do in the worst place. Here time is cut into pieces,
and each piece has the constants and the derivatives of a tube around the trajectory on it (`tube`).

Let x_c be computed on [a, b] with an enclosed defect, and let an ellipsoid contain x_c(a) − x(a). It is
mapped along the linearised system (`linearisation`, `error_ellipsoid`), if that proves that x stays in
the tube. The next piece starts from x_c(b) with the ellipsoid at b. So x_c is a trajectory with a
bound, and the distance from x_c of the solution that is to be bounded is added.

`certificate` bounds ‖x_c − x‖ by the constants of the tube. Where the rest of the linearisation is
large, as for a law at a kink, this bound may be smaller, and the ellipsoid becomes a ball. Where there
is no ellipsoid, pieces with the same semigroup share one factor M (`continue_bound`): with
L̃(s) of the piece that contains s, Gronwall's lemma for e^{−ωt}‖x_c − x‖ gives the factor
e^{∫(ω + ML̃)}, which M multiplies once.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._captured import current
from .._tree import Tree
from ..evolution import Solution
from ..problem import Problem
from ..spaces import AbstractSpace
from .certificate import Bound, last_state
from .status import Status, weakest
from .tube import MAX_SAVED, Piece, Tube

_FIRST_PIECES = 32
"""Number of pieces from which the search for their length starts."""

_MAX_AT_KINK = 4
"""Number of pieces in a row with an unknown derivative of the law, after which the law is taken to stay
at a kink: then the growth by constants limits the pieces. A kink that is crossed takes fewer."""

_SHORTEST = 2.0**-14
"""Shortest piece, as a part of the run."""

_USELESS = 1e6
"""Bound, relative to 1 + ‖x_c‖, that is not followed any further."""


class _Row(NamedTuple):
    """x_c and its response at a saved time with their bounds, those of `Bound` in its order, and what
    they rest on."""

    x: Tree
    u: Tree
    bounds: tuple[Any, ...]
    status: Status


class BoundAlong:
    """The bounds of a solution that is known part by part, from constants along it.

    **Arguments:** `sol`: its first part; `times`: the saved times of all parts, since pieces may be
    longer than parts; `end`: the last time of the run; `initial_error`: a bound on the error at its
    first one; `max_steps`: after so many steps of x_c the bound is infinite, and its tolerance is
    larger if more are expected.

    **Raises:** `dvax.InputError` if the code of f and h proves no constants around the initial state.
    """

    def __init__(
        self, problem: Problem, sol: Solution, times: np.ndarray, end: float,
        initial_error: float = 0.0, max_steps: int = 5_000_000,
    ):  # fmt: skip
        self.problem = problem = current(problem)
        self.dtype = sol.ts.dtype
        self.t = self._rounded(float(sol.setup.setting["t0"]))
        # In the precision of the solution, to which a saved time is one of these.
        self.times = np.unique(times.astype(self.dtype)).astype(float)
        self.end = max(self._rounded(end), float(self.times[-1]))
        self.initial_error = initial_error
        self.rows: dict[float, _Row] = {}
        self.span = self.end - self.t
        self.tube = Tube(problem, sol, self.t, self.end, max_steps)
        self.length, self.why = self.span / _FIRST_PIECES, ""
        self.before: Piece | None = None
        self.unknown = 0  # pieces in a row with an unknown derivative of the law
        self.steps, self.max_steps = 0, max_steps

    def _rounded(self, t: float) -> float:
        """Return a time in the precision of the solution: x_c is computed in it."""
        return float(np.asarray(t, self.dtype))

    def bound(self, sol: Solution) -> Bound:
        """Return the bound of the next part."""
        ts = np.asarray(sol.ts, float)
        while ts[-1] not in self.rows and not self.why:
            self._advance()
        found = [self.rows[t] for t in ts if t in self.rows]
        assert self.why or len(found) == len(ts), "a saved time that was not announced"
        # The next part may have the last time of this one again.
        self.rows = {t: row for t, row in self.rows.items() if t >= ts[-1]}
        return _assembled(self.problem, sol, found, self.why if len(found) < len(ts) else "")

    def _advance(self) -> None:
        """Add the rows of the next piece, which has all saved times since the end of the one before."""
        assert self.t < self.end
        # A saved time at the start belongs to the first piece.
        left = self.times[self.times > self.t if self.before else self.times >= self.t]
        b = min(self.t + self.length, self.end)
        b = self.end if self.end - b < 1e-3 * self.length else b
        # More saved times than a piece has room for end it.
        b = self._rounded(min(b, left[MAX_SAVED - 1]) if len(left) > MAX_SAVED else b)
        if b <= self.t:
            self.why = f"a piece would have to be shorter than the rounding of t = {self.t:.6g}"
            return
        saved = left[: np.searchsorted(left, b, side="right")]
        piece = self._next(b, saved)
        if piece is not None:
            self.rows |= dict(zip(saved.tolist(), _rows(piece, saved), strict=True))

    def _next(self, b: float, saved: np.ndarray) -> Piece | None:
        """Return the next piece, if it may end at b; otherwise make it shorter, or say why there is
        none."""
        a, at_kink = self.t, self.unknown >= _MAX_AT_KINK
        piece = self.tube.piece(a, b, saved, self.before, self.initial_error)
        self.steps += self.tube.latest_steps
        # A piece that is too long is not like those that follow.
        is_piece, before = isinstance(piece, Piece), self.tube.looseness
        self._limit_steps(b, (self.end - b) / (b - a) if is_piece else 1.0, is_piece)
        if self.tube.is_stopped and self.tube.looseness > before and not self.why:
            return None
        is_too_long = isinstance(piece, str) or piece.excess(b - a, self.span, at_kink) > 1.0
        if is_too_long and not self.why and b - a > _SHORTEST * self.span:
            self.length = 0.5 * (b - a)
            return None
        if isinstance(piece, str):
            self.why = self.why or f"{piece}, from t = {a:.6g} to t = {b:.6g}"
            return None
        size = float(self.problem.spaces(piece.sol.setup.x0)[0].norm(_last(piece.sol.xs)))
        if piece.x[-1] > _USELESS * (1.0 + size):
            self.why = f"at t = {b:.6g} it has grown to {_USELESS:.0g} times the solution"
            return None
        self.unknown = 0 if piece.knows_law else self.unknown + 1
        if piece.excess(self.length, self.span, at_kink) < 0.25:
            self.length = min(2.0 * self.length, self.span / 8)
        self.t, self.before = b, piece
        return piece

    def _limit_steps(self, b: float, more: float, is_reached: bool) -> None:
        """Say that x_c had too many steps, or loosen its tolerance for `more` pieces like the last."""
        left = self.max_steps - self.steps
        if left < 0:
            self.why = (
                f"the trajectory along which it is proved took {self.steps} steps "
                f"{'to' if is_reached else 'and did not reach'} t = {b:.6g}"
            )
        elif self.tube.is_stopped:
            self.tube.loosen(np.inf)
        else:
            # Steps of order 2 are as long as the root of the tolerance.
            self.tube.loosen((more * self.tube.latest_steps / (left + 1)) ** 2)


def bound_along(problem: Problem, sol: Solution, initial_error: float, max_steps: int) -> Bound:
    """Return the bound of a solution from constants along it. The arguments are checked.

    **Raises:** `dvax.InputError` if the code of f and h proves no constants around the initial state.
    """
    t0, t1 = (float(sol.setup.setting[name]) for name in ("t0", "t1"))
    last = float(sol.ts[-1])
    end = last if last > t0 else t1
    along = BoundAlong(problem, sol, np.asarray(sol.ts), end, initial_error, max_steps)
    bound = along.bound(sol)
    if along.steps <= max_steps or not bound.why:
        return bound
    return dataclasses.replace(
        bound, why=f"{bound.why}; a larger max_steps of dvax.bound_error follows it further"
    )


def _last(rows: Tree) -> Tree:
    return jtu.tree_map(lambda leaf: leaf[-1], rows)


def _rows(piece: Piece, saved: np.ndarray) -> list[_Row]:
    """Return the rows of a piece at the saved times in it."""
    at = np.searchsorted(np.asarray(piece.sol.ts, float), saved)
    x, u, bound = piece.x, piece.u, piece.bound
    columns = (x, u, bound.x_paper, bound.u_paper, x, u)
    row = lambda k: lambda rows: np.asarray(rows)[k]  # noqa: E731
    return [
        _Row(
            jtu.tree_map(row(k), piece.sol.xs),
            jtu.tree_map(row(k), piece.sol.us),
            tuple(float(column[k]) for column in columns),
            bound.status,
        )
        for k in at
    ]


def _assembled(problem: Problem, sol: Solution, rows: list[_Row], why: str) -> Bound:
    """Return the bounds of x_c with the distance of the solution from it, infinite after the rows."""
    count, found = len(sol.ts), len(rows)
    bounds = np.full((6, count), np.inf)
    if rows:
        state, control = problem.spaces(sol.setup.x0)
        stacked = lambda name: jtu.tree_map(  # noqa: E731
            lambda *leaves: jnp.asarray(np.stack(leaves)), *(getattr(row, name) for row in rows)
        )
        first = lambda tree: jtu.tree_map(lambda leaf: leaf[:found], tree)  # noqa: E731
        of_x = _distances(state, first(sol.xs), stacked("x"))
        of_u = _distances(control, first(sol.us), stacked("u"))
        distances = np.stack([np.asarray(of_x), np.asarray(of_u)] * 3)
        bounds[:, :found] = np.array([row.bounds for row in rows]).T + distances
    statuses: list[Status] = [row.status for row in rows]
    status = weakest(*statuses) if statuses else "estimated"
    x, u, x_paper, u_paper, x_sharp, u_sharp = (jnp.asarray(v, sol.ts.dtype) for v in bounds)
    return Bound(
        sol.ts, x, u, x_paper, u_paper, x_sharp, u_sharp,
        status, None, why, last_state(sol),
    )  # fmt: skip


@eqx.filter_jit
def _distances(space: AbstractSpace, rows: Tree, others: Tree) -> jax.Array:
    return jax.vmap(space.norm)(_tree.sub(rows, others))
