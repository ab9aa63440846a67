"""Error bounds along a trajectory, piece by piece in time.

Constants of the whole space may not exist, and those of a region around a whole trajectory are large:
errors then seem to grow everywhere as fast as they do in the worst place. Here time is cut into pieces,
and each piece has the constants and the derivatives of a tube around the trajectory on it.

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

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..evolution import ETD2RK, RESULTS, Solution, solve
from ..evolution.results import is_success
from ..problem import Problem
from ..programs.slope import interval
from .certificate import Bound, bound_by_constants, continue_bound, disturbances
from .constants import Constants
from .error_ellipsoid import ErrorEllipsoid, propagate
from .linearisation import MAX_UNKNOWNS, linearisation
from .modulus_status import modulus_statuses
from .projection_speed import slopes
from .region import Region
from .set_motion import set_motion
from .status import Status, weakest
from .system import System
from .verify import (
    constants_of,
    domain_of,
    intersect,
    response_box,
    without_limits,
)
from .weights import full_weights

_FIRST_PIECES = 32
"""Number of pieces from which the search for their length starts."""

_MAX_GROWTH = 0.25
"""Largest product of the rate and the length of a piece. A shorter piece has a narrower tube."""

_MAX_SHARE, _MAX_SUM = 0.003, 1.0
"""Largest share of the rest of the linearisation in the error of a piece, and in the errors of all
pieces together. A piece may have the first, or its part of the second by length, if that is larger."""

_MAX_AT_KINK = 4
"""Number of pieces in a row with an unknown derivative of the law, after which the law is taken to stay
at a kink: then the growth by constants limits the pieces. A kink that is crossed takes fewer."""

_SHORTEST = 2.0**-14
"""Shortest piece, as a part of the run."""

_USELESS = 1e6
"""Bound, relative to 1 + ‖x_c‖, that is not followed any further."""

_INNER_TIMES, _MAX_SAVED = 4, 60
"""Number of times in a piece at which its bound is computed, and of saved times in it."""

_FIRST_RADII = (0.1, 1e-2, 1e-3, 1e-4)
"""Radii of the boxes around the initial state that are tried, relative to 1 + |x₀|."""

_WIDENINGS = 4
"""Number of widths of a tube that are tried."""

_SHARPER, _LOOSEST, _TIGHTEST = 0.01, 1e-5, 1e-9
"""Tolerance of x_c relative to that of the solution, and its limits."""


class _Piece(NamedTuple):
    """x_c on a piece of time; its bound by constants there, and the smallest rate of these; its best
    bounds of x and u; the ellipsoid of the error at its end, with the share of the rest in it; and
    whether the derivative of the law is known."""

    sol: Solution
    bound: Bound
    rate: float
    x: np.ndarray
    u: np.ndarray
    ellipsoid: ErrorEllipsoid | None
    share: float
    knows_law: bool

    def excess(self, length: float, span: float, at_kink: bool) -> float:
        """Return by which factor a piece of this length is too long in a run of this span; `at_kink`:
        the law stays at a kink."""
        of_rest = self.share / max(_MAX_SHARE, _MAX_SUM * length / span)
        by_constants = self.ellipsoid is None or at_kink
        return min(self.rate * length / _MAX_GROWTH, of_rest) if by_constants else of_rest


class _Row(NamedTuple):
    """x_c and its response at a saved time with their bounds: those of `Bound`, in its order."""

    x: Tree
    u: Tree
    bounds: tuple[Any, ...]


def bound_along(problem: Problem, sol: Solution, initial_error: float) -> Bound:
    """Return the bound of a solution from constants along it. The arguments are checked.

    **Raises:** `dvax.InputError` if the code of f and h proves no constants around the initial state.
    """
    ts = np.asarray(sol.ts, float)
    t0, t1 = (float(sol.setup.setting[name]) for name in ("t0", "t1"))
    end = float(ts[-1]) if ts[-1] > t0 else t1
    tube = _Tube(problem, sol, t0, end)
    before: _Piece | None = None
    a, length, why = t0, (end - t0) / _FIRST_PIECES, ""
    norm = jax.vmap(problem.spaces(sol.setup.x0)[0].norm)
    unknown = 0  # pieces in a row with an unknown derivative of the law
    rows: list[_Row] = []
    statuses: list[Status] = []
    while len(rows) < len(ts):
        left = ts[len(rows) :]
        # More saved times than a piece has room for end it; one of them may be t0.
        different = np.unique(left)
        b = min(a + length, end)
        b = end if end - b < 1e-3 * length else b
        b = min(b, different[_MAX_SAVED - 1]) if len(different) > _MAX_SAVED else b
        # A saved time at t0 belongs to the first piece.
        saved = left[: np.searchsorted(left, b, side="right")]
        piece = tube.piece(a, b, saved, before, initial_error)
        span, at_kink = end - t0, unknown >= _MAX_AT_KINK
        if b - a > _SHORTEST * span and (
            isinstance(piece, str) or piece.excess(b - a, span, at_kink) > 1.0
        ):
            length = 0.5 * (b - a)
            continue
        if isinstance(piece, str):
            why = f"{piece}, from t = {a:.6g} to t = {b:.6g}"
            break
        if piece.x[-1] > _USELESS * (1.0 + float(norm(piece.sol.xs)[-1])):
            why = f"at t = {b:.6g} it has grown to {_USELESS:.0g} times the solution"
            break
        unknown = 0 if piece.knows_law else unknown + 1
        if piece.excess(length, span, at_kink) < 0.25:
            length = min(2.0 * length, (end - t0) / 8)
        rows += _rows(piece, saved)
        statuses.append(piece.bound.status)
        a, before = b, piece
    return _assembled(problem, sol, rows, statuses, why)


class _Tube:
    """Tubes around x_c, and its pieces."""

    def __init__(self, problem: Problem, sol: Solution, t0: float, end: float):
        setup = sol.setup
        self.problem, self.args, self.x0 = problem, setup.args, setup.x0
        self.span = end - t0
        # A tube is narrow: to cut it would gain little.
        self.system = System(problem, setup.x0, setup.args, max_cuts=0)
        knots = np.asarray(problem.knots(t0, end, setup.x0, setup.args), float)
        self.possible = response_box(self.system, set_motion(self.system, t0, end, knots))
        adaptive = np.isnan(float(setup.setting["dt"]))
        rtol, atol = (float(setup.setting[name]) for name in ("rtol", "atol"))
        least = max(_TIGHTEST, 200.0 * float(jnp.finfo(setup.dtype).eps))
        sharper = _SHARPER * (rtol if adaptive else 1e-6)
        self.rtol = float(np.clip(sharper, least, max(least, _LOOSEST)))
        self.atol = _SHARPER * atol if adaptive else self.rtol
        of_space = lambda space, like: jtu.tree_map(  # noqa: E731
            lambda w: np.asarray(w, float), full_weights(space, like)
        )
        self.weights = of_space(self.system.state, setup.x0)
        self.weights_u = of_space(self.system.control, self.system.u0)
        self.size = sum(map(np.size, jtu.tree_leaves(setup.x0)))
        # Factor of the smallest reach of a tube, which the pieces adapt.
        self.limits_u, self.width = False, 1.0
        self.is_unbounded = any(
            bool(np.isinf(v.low).any() or np.isinf(v.high).any()) for v in slopes(self.possible)
        )
        self.first = self._first_constants(t0, end, sol.us)

    def _first_constants(self, t0: float, end: float, us: Tree) -> Constants:
        """Return constants around the initial state and the responses `us`, for the tolerance of laws
        that are iterated."""
        found: Constants | str = ""
        u = tuple(
            jtu.tree_map(lambda rows, f=f: f(np.asarray(rows, float), axis=0), us)
            for f in (np.min, np.max)
        )
        for radius in _FIRST_RADII:
            x0 = jtu.tree_map(lambda v: np.asarray(v, float), self.x0)
            around = jtu.tree_map(lambda v, r=radius: r * (1.0 + np.abs(v)), x0)
            found = self.constants(t0, end, *_widened(x0, x0, around))
            if isinstance(found, str) and self.is_unbounded:
                found = self.constants(t0, end, *_widened(x0, x0, around), self._near(u, radius))
            if isinstance(found, Constants):
                return found
        raise input_error(
            "dvax.bound_error(constants)", "None",
            f"without constants, they are proved along the trajectory: {found}",
            "Pass dvax.verify(problem, x0, x=(low, high), declared={…}).constants",
        )  # fmt: skip

    def constants(
        self, a: float, b: float, low: Tree, high: Tree, u: tuple[Tree, Tree] | None = None
    ) -> Constants | str:
        """Return the constants for a ≤ t ≤ b and low ≤ x ≤ high, and for u between these bounds where
        they are given, or why there are none."""
        time, states = interval(a, b), jtu.tree_map(interval, low, high)
        responses, limits = self.possible, None
        if u is not None:
            given = jtu.tree_map(interval, *u)
            responses = intersect(given, self.possible)
            limits = without_limits(given, self.possible)
        region = Region(time, states, responses)
        moduli = modulus_statuses(self.system, region, None, {})
        for name, entry in moduli.by_name.items():
            if entry.status != "proved":
                return f"{name} is not proved: {entry.reason}"
        domain = domain_of(time, states, limits, self.args, self.problem)
        found = constants_of(self.system, region, moduli, domain)
        return "γ is not positive, or a modulus is infinite" if found is None else found

    def _near(self, u: tuple[Tree, Tree], margin: float) -> tuple[Tree, Tree]:
        """Return bounds of u that are wider by a part of its size, inside those of the set."""
        wider = jtu.tree_map(
            lambda v, w: 0.1 * (w - v) + margin * (1.0 + np.maximum(np.abs(v), np.abs(w))), *u
        )
        return _widened(*u, wider)

    def piece(
        self, a: float, b: float, saved: np.ndarray, before: _Piece | None, initial_error: float
    ) -> _Piece | str:
        """Return x_c on [a, b] with its bound, or why there is none."""
        inner = np.linspace(a, b, _INNER_TIMES + 1)[1:]
        times = np.unique(np.concatenate([inner, saved]))
        times = np.pad(times, (0, _INNER_TIMES + _MAX_SAVED - len(times)), "edge")
        x, error, step = self.x0, initial_error, None
        if before is not None:
            x = jtu.tree_map(lambda rows: rows[-1], before.sol.xs)
            error = float(before.x[-1])
            step = min(float(before.sol.stats["next_dt"]), b - a)
        sol = solve(
            self.problem, x, a, b, self.args, times, rtol=self.rtol, atol=self.atol,
            method=ETD2RK(), constants=self.first, dt0=step, horizon=self.span, throw=False,
        )  # fmt: skip
        if not bool(is_success(sol.result)):
            return f"ETD2RK, whose defect is enclosed, fails: {RESULTS[sol.result]}"
        assert sol.bounds is not None  # the constants are of a region
        (low, high), u = (
            tuple(jtu.tree_map(lambda rows: np.asarray(rows[-1], float), v) for v in ends)
            for ends in sol.bounds
        )
        why = "an entry of the trajectory has no bound"
        if not _tree.has_only_finite((low, high, u)):
            return why
        for _ in range(_WIDENINGS):
            reach = self.width * self._least_reach(low, high, error)
            box = _widened(low, high, self._margin(low, high, reach))
            near = self._near(u, 0.02 * np.sqrt(self.width))
            constants = self.constants(a, b, *box, near if self.limits_u else None)
            if isinstance(constants, str) and self.is_unbounded and not self.limits_u:
                # f may be steep in a u that is large, and u is not.
                self.limits_u = True
                constants = self.constants(a, b, *box, near)
            if isinstance(constants, str):
                return constants
            bound = self._bounded(sol, constants, before, error)
            piece = self._sharpened(sol, constants, bound, before, error, reach)
            if piece is not None and np.isfinite(piece.x).all():
                self.width = max(1.0, self.width / 4.0)
                return piece
            self.width *= 4.0
        self.width = 1.0
        return bound.why

    def _sharpened(
        self, sol: Solution, constants: Constants, bound: Bound, before: _Piece | None,
        error: float, reach: float,
    ) -> _Piece | None:  # fmt: skip
        """Return the piece with the smaller one of two bounds at each time: by constants, and by an
        ellipsoid. None: the distance of the trajectories is not proved to stay below `reach`, and may
        be so with a larger one."""
        x, u = np.asarray(bound.x, float), np.asarray(bound.u, float)
        rates = [constants.growth_rate, constants.one_sided]
        rate, L = min(float(v) for v in rates if v is not None), float(constants.L)
        without = _Piece(sol, bound, rate, x, u, None, np.inf, False)
        if self.size > MAX_UNKNOWNS:
            return without
        ball = lambda radius: ErrorEllipsoid.ball(radius, self.size)  # noqa: E731
        without = without._replace(ellipsoid=ball(x[-1]))
        start = ball(error) if before is None or before.ellipsoid is None else before.ellipsoid
        integral, of_x, of_law = disturbances(self.problem, sol, constants)
        region = self._around(sol, reach, L * reach + float(np.max(of_law)), constants)
        linear = None if region is None else linearisation(self.system, region, L)
        if linear is None:
            return without
        times = np.asarray(sol.ts, float) - float(sol.setup.setting["t0"])
        found = propagate(linear, start, times, integral, of_x)
        if not found.largest < reach:
            return None if found.share < _MAX_GROWTH else without
        x = np.fmin(x, found.bounds)
        u = np.fmin(u, linear.gain * x + of_law)
        ellipsoid = found.within(float(bound.x[-1]))
        return _Piece(sol, bound, rate, x, u, ellipsoid, found.share, linear.knows_law)

    def _around(
        self, sol: Solution, of_x: float, of_u: float, constants: Constants
    ) -> Region | None:
        """Return the region of both trajectories while the norms of their distances are at most these,
        or None if it is not in the region of the constants."""
        assert sol.bounds is not None and constants.domain is not None
        t0, t1 = (float(sol.setup.setting[name]) for name in ("t0", "t1"))
        ends = zip(sol.bounds, (self.weights, self.weights_u), (of_x, of_u))
        x, u = (self._box(*pair, weights, distance) for pair, weights, distance in ends)
        if not constants.domain.includes(x, u):
            return None
        response = intersect(jtu.tree_map(interval, *u), self.possible)
        return Region(interval(t0, t1), jtu.tree_map(interval, *x), response)

    def _box(self, low: Tree, high: Tree, weights: Tree, distance: float) -> tuple[Tree, Tree]:
        """Return bounds of all elements at most at this distance from ones between the last rows."""
        last = lambda tree: jtu.tree_map(lambda rows: np.asarray(rows[-1], float), tree)  # noqa: E731
        reach = jtu.tree_map(lambda w: distance / np.sqrt(w), weights)
        return _widened(last(low), last(high), reach)

    def _least_reach(self, low: Tree, high: Tree, error: float) -> float:
        """Return the smallest bound on errors for which a tube is tried, if it is `error` at first."""
        ends = [jtu.tree_leaves(tree) for tree in (low, high, self.weights)]
        squares = (np.sum(w * np.maximum(np.abs(v), np.abs(z)) ** 2) for v, z, w in zip(*ends))
        size = np.sqrt(sum(map(np.sum, ends[2])))
        own = self.atol * size + self.rtol * np.sqrt(sum(squares))
        return float(2.0 * error + 4.0 * own)

    def _margin(self, low: Tree, high: Tree, reach: float) -> Tree:
        """Return how much wider than the boxes of x_c a tube is, for errors up to `reach`."""
        return jtu.tree_map(
            lambda v, z, w: 0.02 * (z - v) + reach / np.sqrt(w), low, high, self.weights
        )

    def _bounded(
        self, sol: Solution, constants: Constants, before: _Piece | None, error: float
    ) -> Bound:
        M = float(constants.M)
        if before is None or M == 1.0 or M * error < float(before.bound.x[-1]):
            return bound_by_constants(self.problem, sol, constants, error)
        same_rates = (before.bound.x_sharp is None) == (constants.one_sided is None)
        if same_rates:
            return continue_bound(self.problem, sol, constants, before.bound)
        return bound_by_constants(self.problem, sol, constants, before.bound)


def _widened(low: Tree, high: Tree, margin: Tree) -> tuple[Tree, Tree]:
    return jtu.tree_map(np.subtract, low, margin), jtu.tree_map(np.add, high, margin)


def _rows(piece: _Piece, saved: np.ndarray) -> list[_Row]:
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
        )
        for k in at
    ]


def _assembled(
    problem: Problem, sol: Solution, rows: list[_Row], statuses: list[Status], why: str
) -> Bound:
    """Return the bounds of x_c with the distance of the solution from it, infinite after the rows."""
    count, found = len(sol.ts), len(rows)
    bounds = np.full((6, count), np.inf)
    if rows:
        state, control = problem.spaces(sol.setup.x0)
        stacked = lambda name: jtu.tree_map(  # noqa: E731
            lambda *leaves: jnp.asarray(np.stack(leaves)), *(getattr(row, name) for row in rows)
        )
        first = lambda tree: jtu.tree_map(lambda leaf: leaf[:found], tree)  # noqa: E731
        of_x = jax.vmap(state.norm)(_tree.sub(first(sol.xs), stacked("x")))
        of_u = jax.vmap(control.norm)(_tree.sub(first(sol.us), stacked("u")))
        distances = np.stack([np.asarray(of_x), np.asarray(of_u)] * 3)
        bounds[:, :found] = np.array([row.bounds for row in rows]).T + distances
    x, u, x_paper, u_paper, x_sharp, u_sharp = (jnp.asarray(v, sol.ts.dtype) for v in bounds)
    return Bound(
        sol.ts, x, u, x_paper, u_paper, x_sharp, u_sharp, weakest(*statuses) if statuses else
        "estimated", None, why,
    )  # fmt: skip
