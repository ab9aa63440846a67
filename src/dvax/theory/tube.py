"""A tube around a trajectory: its pieces, with constants and a linearisation that hold in it.

On a piece [a, b] the enclosures of constants and of the slopes of derivatives hold in one box. The
linearisation has a matrix for each of many intervals of time, which are made shorter where its rest is
large: where the law passes a kink, and its derivative is unknown while it may be on either side.

x_c is computed by `ETD2RK`, whose steps have an enclosed defect, or, for a small system that is affine
while no constraint changes, by `PiecewiseLinear`, whose defect is of the size of rounding errors,
however stiff the system is.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..evolution import ETD2RK, RESULTS, PiecewiseLinear, Solution, solve
from ..evolution.arguments import ADAPTIVE_STEPS
from ..evolution.piecewise.system import is_affine
from ..evolution.results import is_success
from ..problem import Problem
from ..programs.slope import Values, interval
from ..sets._weights import full_weights
from .certificate import Bound, bound_by_constants, continue_bound, disturbances, encloses_by
from .constants import Constants
from .error_ellipsoid import ErrorEllipsoid, Propagated, propagate
from .faces import Range
from .linearisation import MAX_UNKNOWNS, Linearisation, linearisation
from .local_derivatives import LocalDerivatives, of_region
from .modulus_status import modulus_statuses
from .projection_speed import slopes
from .region import Region
from .set_motion import set_motion
from .system import System
from .verify import constants_of, domain_of, intersect, response_box, without_limits

MAX_SAVED = 60
"""Largest number of saved times in a piece."""

MAX_GROWTH = 0.25
"""Largest product of the rate and the length of a piece. A shorter piece has a narrower tube."""

_MAX_SHARE, _MAX_SUM = 0.003, 1.0
"""Largest share of the rest of the linearisation in the error of a piece, and in the errors of all
pieces together. A piece may have the first, or its part of the second by length, if that is larger."""

_INTERVALS, _STEPS = 128, 8
"""Largest number of intervals of equal length in a piece, and the smallest mean number of steps of the
method in them: at their ends steps are charged twice."""

_MORE, _REFINEMENTS = 48, 3
"""Number of intervals by which those are cut whose rest is large, and how often."""

_INNER_TIMES = 4
"""Number of inner times of a piece that has one linearisation."""

_FIRST_RADII = (0.1, 1e-2, 1e-3, 1e-4)
"""Radii of the boxes around the initial state that are tried, relative to 1 + |x₀|."""

_WIDENINGS = 4
"""Number of widths of a tube that are tried."""

_MAX_BY_MODES = 16
"""Largest number of unknowns of x and u for which `PiecewiseLinear` replaces another method."""

_RTOL_BY_MODES = 1e-8
"""Smallest rtol for `PiecewiseLinear`."""

_SHARPER, _LOOSEST, _TIGHTEST = 0.01, 1e-5, 1e-9
"""Tolerance of x_c relative to that of the solution, and its limits."""


def share_limit(length: float, span: float) -> float:
    """Return the largest share of the rest in the error of a piece of a run of this span."""
    return max(_MAX_SHARE, _MAX_SUM * length / span)


class Piece(NamedTuple):
    """x_c on a piece of time; its bound by constants there, and the smallest rate of these; its best
    bounds of x and u; the ellipsoid of the error at its end, with the share of the rest in it; and
    whether the derivative of the law is known for most of the time."""

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
        of_rest = self.share / share_limit(length, span)
        by_constants = self.ellipsoid is None or at_kink
        return min(self.rate * length / MAX_GROWTH, of_rest) if by_constants else of_rest


class _Propagation(NamedTuple):
    """x_c with the intervals of its linearisation, which end at saved times with these numbers; and
    what an error becomes, with a bound on the distance of u_c from the law at x_c."""

    sol: Solution
    linear: Linearisation
    ends: list[int]
    found: Propagated
    of_law: np.ndarray

    @property
    def knows_law(self) -> bool:
        """Whether the derivative of the law is known for most of the time."""
        lengths = np.diff(np.asarray(self.sol.ts)[self.ends], prepend=self.start)
        return bool(lengths @ self.linear.knows_law > 0.5 * lengths.sum())

    @property
    def start(self) -> float:
        return float(self.sol.setup.setting["t0"])


class Tube:
    """Tubes around x_c, and its pieces."""

    def __init__(self, problem: Problem, sol: Solution, t0: float, end: float, max_steps: int):
        setup = sol.setup
        # A piece may have a part of all steps, so that there are some for a larger tolerance.
        self.max_steps = min(max(max_steps // 4, 1), ADAPTIVE_STEPS)
        self.problem, self.args, self.x0 = problem, setup.args, setup.x0
        self.span = end - t0
        # A tube is narrow: to cut it would gain little.
        self.system = System(problem, setup.x0, setup.args, max_cuts=0)
        self.local = LocalDerivatives(self.system)
        self.intervals = _INTERVALS if self.local.is_known else _INNER_TIMES
        more = _MORE * _REFINEMENTS if self.local.is_known else 0
        self.capacity = self.intervals + more + MAX_SAVED
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
        unknowns = self.size + sum(map(np.size, jtu.tree_leaves(self.system.u0)))
        self.by_modes = isinstance(setup.method, PiecewiseLinear) or (
            unknowns <= _MAX_BY_MODES
            and setup.dtype == np.float64  # with less precision its inputs have large errors
            and is_affine(problem, t0, setup.x0, setup.args)
        )
        # Factors of the tolerances of x_c, and of the smallest reach of a tube; and whether constants
        # need bounds of u.
        self.looseness, self.width, self.limits_u = 1.0, 1.0, False
        # Steps of x_c on the latest piece, whatever became of it, and whether their limit stopped it.
        self.latest_steps, self.is_stopped = 0, False
        self.is_unbounded = any(
            bool(np.isinf(v.low).any() or np.isinf(v.high).any()) for v in slopes(self.possible)
        )
        self.first = self._first_constants(t0, end, sol.us)

    def loosen(self, factor: float) -> None:
        """Multiply the tolerances of x_c, which are at most 100 times those that it starts with."""
        self.looseness = float(np.clip(factor * self.looseness, 1.0, 1.0 / _SHARPER))

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
            f"{found}; without constants, all that a bound needs are proved along the trajectory",
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
        self, a: float, b: float, saved: np.ndarray, before: Piece | None, initial_error: float
    ) -> Piece | str:
        """Return x_c on [a, b] with its bound, or why there is none."""
        error = initial_error if before is None else float(before.x[-1])
        nodes = np.linspace(a, b, self.intervals + 1)[1:]
        sol = self._solve(a, nodes, saved, before)
        if self.by_modes and not (bool(is_success(sol.result)) and sol.enclosed):
            self.by_modes = False
            return self.piece(a, b, saved, before, initial_error)
        if not bool(is_success(sol.result)):
            return f"ETD2RK, whose defect is enclosed, fails: {RESULTS[sol.result]}"
        assert sol.bounds is not None  # the constants are of a region
        (low, high), u = (_hull(*ends) for ends in sol.bounds)
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
            if not encloses_by(sol, constants):
                self._weaken(constants)
                sol = self._solve(a, nodes, saved, before)
            ball = ErrorEllipsoid.ball(error, self.size)
            start = ball if before is None or before.ellipsoid is None else before.ellipsoid
            along = self._propagated(sol, constants, start, reach, saved, before)
            if along is not None:
                sol = along.sol
            bound = self._bounded(sol, constants, before, error)
            why = bound.why or "x may leave every tube around the trajectory that was tried"
            piece = self._smaller(bound, constants, sol, along, reach)
            if piece is not None and np.isfinite(piece.x).all():
                self.width = max(1.0, self.width / 4.0)
                return piece
            self.width *= 4.0
        self.width = 1.0
        return why

    def _weaken(self, constants: Constants) -> None:
        """Enclose responses by moduli that these constants prove, with some room."""
        first = self.first
        moduli = (
            0.8 * min(float(constants.gamma), float(first.gamma)),
            1.25 * max(float(constants.L_F), float(first.L_F)),
            max(float(constants.norm_P_inv), float(first.norm_P_inv)),
        )
        where = lambda c: (c.gamma, c.L_F, c.norm_P_inv)  # noqa: E731
        self.first = eqx.tree_at(where, first, moduli)

    def _solve(
        self, a: float, nodes: np.ndarray, saved: np.ndarray, before: Piece | None
    ) -> Solution:
        """Return x_c from a on, saved at the nodes, at the end of the piece the last one."""
        dtype = _tree.dtype(self.x0)
        times = np.unique(np.concatenate([nodes, saved]).astype(dtype).astype(float))
        times = np.pad(times, (0, self.capacity - len(times)), "edge")
        x, step = self.x0, None
        if before is not None:
            x = jtu.tree_map(lambda rows: rows[-1], before.sol.xs)
            step = min(float(before.sol.stats["next_dt"]), nodes[-1] - a)
        rtol, atol = self.looseness * self.rtol, self.looseness * self.atol
        own: dict[str, Any] = {"method": ETD2RK(), "dt0": step, "rtol": rtol}
        if self.by_modes:
            own = {"method": PiecewiseLinear(), "rtol": max(rtol, _RTOL_BY_MODES)}
        found = solve(
            self.problem,
            x,
            a,
            nodes[-1],
            self.args,
            times,
            atol=atol,
            constants=self.first,
            horizon=self.span,
            max_steps=self.max_steps,
            throw=False,
            **own,
        )
        self.latest_steps = int(found.stats["steps"])
        self.is_stopped = bool(found.result == RESULTS.max_steps)
        return found

    def _smaller(
        self, bound: Bound, constants: Constants, sol: Solution, along: _Propagation | None,
        reach: float,
    ) -> Piece | None:  # fmt: skip
        """Return the piece with the smaller one of two bounds at each time: by constants, and by an
        ellipsoid. None: the distance of the trajectories is not proved to stay below `reach`, and may
        be so with a larger one."""
        x, u = np.asarray(bound.x, float), np.asarray(bound.u, float)
        rates = [constants.growth_rate, constants.one_sided]
        rate = min(float(v) for v in rates if v is not None)
        ball = ErrorEllipsoid.ball(x[-1], self.size) if self.size <= MAX_UNKNOWNS else None
        without = Piece(sol, bound, rate, x, u, ball, np.inf, False)
        if along is None:
            return without
        found, linear = along.found, along.linear
        if not found.largest < reach:
            return None if found.share < MAX_GROWTH else without
        x = np.fmin(x, found.bounds)
        gain = np.repeat(linear.gain, np.diff([0, *(k + 1 for k in along.ends)]))
        u = np.fmin(u, gain * x + along.of_law)
        ellipsoid = found.within(float(bound.x[-1]))
        return Piece(sol, bound, rate, x, u, ellipsoid, found.share, along.knows_law)

    def _propagated(
        self, sol: Solution, constants: Constants, start: ErrorEllipsoid, reach: float,
        saved: np.ndarray, before: Piece | None,
    ) -> _Propagation | None:  # fmt: skip
        """Return what an error becomes while it is below `reach`, or None if the linearisation is not
        known."""
        along = self._on_intervals(sol, None, constants, start, reach)
        for _ in range(_REFINEMENTS):
            nodes = None if along is None else self._finer(along)
            if along is None or nodes is None:
                break
            sol = self._solve(along.start, nodes, saved, before)
            finer = self._on_intervals(sol, nodes, constants, start, reach)
            if finer is None or not finer.found.share < 0.5 * along.found.share:
                break
            along = finer
        return along

    def _on_intervals(
        self, sol: Solution, nodes: np.ndarray | None, constants: Constants, start: ErrorEllipsoid,
        reach: float,
    ) -> _Propagation | None:  # fmt: skip
        """Return what an error becomes on intervals that end at the `nodes`, or on equal ones."""
        L = float(constants.L)
        if self.size > MAX_UNKNOWNS:
            return None
        disturbed, of_law = disturbances(self.problem, sol, constants)
        # The integrals are sums of as many numbers as there are steps.
        unit = int(sol.stats["steps"]) * float(jnp.finfo(sol.ts.dtype).eps)
        rounded = disturbed.integral + unit * disturbed.integral[-1]
        disturbed = disturbed._replace(integral=rounded)
        distances = reach, L * reach + float(np.max(of_law))
        region = self._around(sol, *distances, constants)
        if region is None:
            return None
        linear, ends = self._linearised(sol, nodes, region, *distances, L)
        if linear is None:
            return None
        times = np.asarray(sol.ts, float) - float(sol.setup.setting["t0"])
        found = propagate(linear, start, times, ends, disturbed)
        return _Propagation(sol, linear, ends, found, of_law)

    def _finer(self, along: _Propagation) -> np.ndarray | None:
        """Return the ends of intervals which are shorter where the rest is large; None if that is not
        needed, or not in a few intervals only."""
        shares, ts = along.found.shares, np.asarray(along.sol.ts, float)
        ends = ts[along.ends]
        room = min(_MORE, self._intervals_of(along.sol))
        (large,) = np.nonzero(shares > 0.05 * along.found.share)
        part = float(shares[large].sum())
        is_small = along.found.share <= share_limit(ends[-1] - along.start, self.span)
        if is_small or len(ends) == 1 or room < len(large) or part < 0.5 * along.found.share:
            return None
        begins = np.array([along.start, *ends[:-1]])
        nodes = [ends]
        for k in large:
            cuts = 1 + int((room - len(large)) * shares[k] / part)  # `room` in all
            nodes.append(np.linspace(begins[k], ends[k], cuts + 2)[1:-1])
        return np.unique(np.concatenate(nodes))

    def _intervals_of(self, sol: Solution) -> int:
        """Return into how many intervals x_c may be divided: steps whose defect is of the size of
        rounding errors may be charged several times."""
        return self.capacity if self.by_modes else int(sol.stats["steps"]) // _STEPS

    def _linearised(
        self, sol: Solution, nodes: Values, region: Region, of_x: float, of_u: float,
        L: float,
    ) -> tuple[Linearisation | None, list[int]]:  # fmt: skip
        """Return a linearisation for each of several intervals of time, or one for all, or None; and
        the numbers of the saved times at which the intervals end. Distances from x_c and u_c are at
        most `of_x` and `of_u`."""
        start, ts = float(sol.setup.setting["t0"]), np.asarray(sol.ts, float)
        last = len(ts) - 1
        if nodes is None:
            count = max(min(self.intervals, self._intervals_of(sol)), 1)
            nodes = np.linspace(start, ts[-1], count + 1)[1:]
        inner = np.unique(np.searchsorted(ts, nodes[:-1]))
        ends = [*(int(k) for k in inner[ts[inner] < ts[-1]]), last]
        if self.local.is_known and len(ends) > 1:
            firsts = [0, *(k + 1 for k in ends[:-1])]
            assert sol.bounds is not None
            ranges = zip(
                sol.bounds, (region.x, region.u), (self.weights, self.weights_u), (of_x, of_u)
            )
            boxes = []
            for (low, high), whole, weights, reach in ranges:
                margin = reach / np.sqrt(_flat_rows(weights, 0))
                least = np.minimum.reduceat(_flat_rows(low), firsts) - margin
                most = np.maximum.reduceat(_flat_rows(high), firsts) + margin
                low, high = (_flat_ends(whole, name) for name in ("low", "high"))
                boxes.append(
                    (Range(np.maximum(least, low), np.minimum(most, high)), Range(least, most))
                )
            times = Range(np.array([start, *ts[ends[:-1]]])[:, None], ts[ends][:, None])
            (x, _), (u, wide) = boxes
            J = self.local.at(region, times, x, u, self.capacity, wide)
            linear = None if J is None else linearisation(self.system, J, L)
            if linear is not None:
                return linear, ends
        assert sol.bounds is not None
        least, most = (
            _flat_rows(side, 0)[None] for side in _box(*sol.bounds.u, self.weights_u, of_u)
        )
        J = of_region(self.system, region, Range(least, most))
        return None if J is None else linearisation(self.system, J, L), [last]

    def _around(
        self, sol: Solution, of_x: float, of_u: float, constants: Constants
    ) -> Region | None:
        """Return the region of both trajectories while the norms of their distances are at most these,
        or None if it is not in the region of the constants."""
        assert sol.bounds is not None and constants.domain is not None
        t0, t1 = (float(sol.setup.setting[name]) for name in ("t0", "t1"))
        ends = zip(sol.bounds, (self.weights, self.weights_u), (of_x, of_u))
        x, u = (_box(*pair, weights, distance) for pair, weights, distance in ends)
        if not constants.domain.includes(x, u):
            return None
        response = intersect(jtu.tree_map(interval, *u), self.possible)
        return Region(interval(t0, t1), jtu.tree_map(interval, *x), response)

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
        self, sol: Solution, constants: Constants, before: Piece | None, error: float
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


def _hull(low: Tree, high: Tree) -> tuple[Tree, Tree]:
    """Return the smallest box that contains the boxes of all rows."""
    least, most = (
        jtu.tree_map(lambda rows, f=f: f(np.asarray(rows, float), axis=0), tree)
        for f, tree in ((np.min, low), (np.max, high))
    )
    return least, most


def _box(low: Tree, high: Tree, weights: Tree, distance: float) -> tuple[Tree, Tree]:
    """Return bounds of all elements at most at this distance from ones in the boxes of the rows."""
    reach = jtu.tree_map(lambda w: distance / np.sqrt(w), weights)
    return _widened(*_hull(low, high), reach)


def _flat_rows(tree: Tree, axes: int = 1) -> Values:
    """Return the leaves of a tree in one array, behind this number of axes that they share."""
    leaves = [np.asarray(leaf, float) for leaf in jtu.tree_leaves(tree)]
    return np.concatenate([leaf.reshape(*leaf.shape[:axes], -1) for leaf in leaves], axis=axes)


def _flat_ends(tree: Tree, name: str) -> Values:
    """Return the ends of that name of a tree of intervals in one array."""
    return np.concatenate([getattr(v, name).ravel() for v in slopes(tree)])
