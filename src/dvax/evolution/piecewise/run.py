"""From switching to switching: steps in one mode, and the mode that follows.

A step solves the equations of its mode by collocation and samples what has a sign to keep in that mode.
Where bounds on these polynomials cannot exclude a change of sign, the change is located, and the step
ends there. Steps end at the ends of the input's pieces as well. After a change the longest step is
tried first, then the time scales of the mode, so that the number of steps follows from the number of
scales that are excited and not from how far they are apart. Times within a piece are kept relative to
its start, in two parts: a transient of 10⁻¹⁸ s is resolved at any t.
"""

import jax.numpy as jnp
import numpy as np

from .. import meter
from . import radau
from .inputs import Piece, basis, continuous, values
from .lengths import longer, shorter, two_sum, until
from .modes import Condition, Equations, Mode, changed, first_mode
from .murty import implicit_mode, law_mode
from .records import Attempt, Crossing, MaskedViolation, Row, Step
from .signs import locate_event, masked_violation
from .system import Affine

Array = np.ndarray


class Run:
    """The trajectory of a system from x0 over its pieces, which are those of the `given` system; it is
    computed in the variables of the `pivoted` one.

    `weights` are the norms of the unit vectors of the state space; `tol` = (rtol, atol), of which a
    polynomial may lack 10⁻⁴.
    """

    def __init__(
        self, given: Affine, pivoted: Affine, pieces: list[Piece], x0: Array, weights: Array,
        tol: tuple[float, float], max_steps: int, times: Array, dense: bool, track_bounds: bool,
        progress: bool,
    ):  # fmt: skip
        self.given, self.system, self.pieces, self.x = given, pivoted, pieces, x0
        self.weights, self.max_steps = weights, max_steps
        rtol, atol = tol
        self.tol, self.least = float(np.clip(1e-4 * rtol, 1e-12, 1e-6)), 1e-4 * atol
        self.rtol, self.atol, self.masked_error = rtol, atol, 0.0 * x0
        self.largest = np.zeros((2, len(given.low)))
        # The members w are in proportion to their law.
        self.least_p = self.least * np.where(pivoted.swapped, np.diag(given.M), 1.0)
        self.times, self.dense = times, dense
        self.equations: dict[Mode, Equations] = {}
        self.mode = first_mode(given)
        self.scale, self.off, self.lacking = np.abs(x0), 0.0 * x0, 0.0 * x0
        self.rows: list[Row] = []
        self.steps: list[Step] = []
        self.events: list[tuple[float, Mode]] = []
        self.accepted = self.rejected = self.switchings = self.stuck = 0
        self.defect = self.law_defect = 0.0
        self.piece = pieces[0]
        self.t, self.result = pieces[0].start, "successful"
        self.meter, self.shown = meter.begin() if progress else None, 0.0
        self.span = pieces[-1].start + pieces[-1].length - self.t
        m = len(given.low)
        none = np.stack([np.full(m, np.inf), np.full(m, -np.inf)])
        self.bounds = np.hstack([np.stack([x0, x0]), none]) if track_bounds else None

    def go(self) -> None:
        """Run to the end, or to where `result` says why not."""
        last = None
        for k, piece in enumerate(self.pieces):
            self.piece = piece
            inputs = self._converted(piece)
            if last is None or not continuous(last, piece):
                mode = law_mode(self.of, self.mode, self.x, inputs, self.off)
                if mode is None:
                    self.result = "law_unsolved"
                    return
                self.mode, self.stuck = mode, 0
                self.events.append((piece.start, mode))
            if self.result == "successful":
                self.result = self._through(inputs, k == len(self.pieces) - 1)
            if self.result != "successful":
                return
            last = piece
        if self.shown < 1.0:
            self._show(1.0)

    def _show(self, share: float) -> None:
        """Print the share of the run that is done, where that is asked for."""
        self.shown = share
        if self.meter is not None:
            self.meter = meter.advance(self.meter, jnp.asarray(share))

    def _converted(self, piece: Piece) -> Piece:
        """The piece in the system's own variables."""
        c = piece.coefficients @ self.system.inputs.T
        return piece._replace(coefficients=c, noise=np.abs(self.system.inputs) @ piece.noise)

    def of(self, mode: Mode) -> Equations:
        if mode not in self.equations:
            self.equations[mode] = Equations(self.system, mode, self.weights)
        return self.equations[mode]

    def _through(self, piece: Piece, last: bool) -> str:
        """All steps of a piece."""
        begin, low, proposal = 0.0, 0.0, np.inf
        even, reached, doubts, self.crossing = 0, 0.0, 0, Crossing(-np.inf, 0.0)
        while begin < piece.length:
            # More changes at one time than there are constraints: the law alone does not say which mode
            # goes on.
            if self.stuck > len(self.mode):
                crossed = self._cross(piece, begin, low)
                if isinstance(crossed, str):
                    return crossed
                begin, low = crossed
            own = self.of(self.mode)
            remaining = (piece.length - begin) - low
            h = min(proposal, remaining)
            found, before = None, np.inf
            while found is None:
                if self.accepted + self.rejected >= self.max_steps:
                    return "max_steps"
                attempt = self._attempt(own, piece, begin + low, h)
                if attempt is None:
                    return "nonfinite"
                if attempt.excess > 1.0 and h > own.shortest:
                    self.rejected += 1
                    h, before = shorter(own, h, attempt.excess, before), attempt.excess
                    continue
                attempt, theta, condition, masked = self._locate_event(own, attempt, h)
                nearer = until(own, h, theta) if condition is not None else h
                if doubts < _MOST_DOUBTS and nearer < 0.8 * h and attempt.is_coarse(theta):
                    self.rejected += 1
                    doubts += 1
                    h, before = nearer, np.inf
                else:
                    found = attempt
            self._account(masked, theta * h)
            whole = condition is None and theta == 1.0 and bool(h == remaining)
            end = piece.length if whole else begin + (low + theta * h)
            self._keep(found, h, theta, piece, begin, low, end, bool(last and end >= piece.length))
            if whole:
                return "successful"
            begin, low = two_sum(begin, low + theta * h)
            if condition is None:
                even = even + 1 if h <= reached else 0
                reached = h
                proposal = 4.0 * h if own.rings else longer(own, h, found.excess)
                if even >= _EVEN:
                    # What is left of the excess may be rounding, which no step changes.
                    proposal, even = max(4.0 * h, proposal), 0
                continue
            proposal, even, reached, doubts = np.inf, 0, 0.0, 0
            self._switch(changed(self.mode, condition))
            self.stuck = self.stuck + 1 if theta * h <= 1e-9 * own.shortest else 0
        return "successful"

    def _cross(self, piece: Piece, begin: float, low: float) -> tuple[float, float] | str:
        """A short step in the mode that the implicit Euler method ends in, whatever signs are before
        its end, as long as the state does not show it; (begin, low) after it.

        Rounding hides which mode goes on where x lies on the bounds of several modes, or where the
        multipliers have boundary layers that steps do not resolve. Crossings that follow one another
        become longer.
        """
        now, after = begin + low, self.crossing
        near = now - after.end <= _NEAR * after.length
        h = 4.0 * (after.length if near else self.of(self.mode).shortest)
        h = min(h, 0.5 * ((piece.length - begin) - low))
        for _ in range(_MOST_SHORTER):
            if self.accepted + self.rejected >= self.max_steps:
                return "max_steps"
            mode = implicit_mode(
                self.system, self.weights, self.mode, self.x, piece, now, h, self.off
            )
            if mode is None:
                return "law_unsolved"
            own = self.of(mode)
            attempt = self._attempt(own, piece, now, h)
            if attempt is None:
                return "nonfinite"
            any_of = np.full(len(mode), np.inf)
            found = attempt._replace(slack=(any_of, any_of))
            masked = masked_violation(self.of, self.given, own, found, 1.0, h)
            if attempt.excess <= 1.0 and self._is_negligible(masked, found):
                self._switch(mode)
                self._account(masked, h)
                self._keep(found, h, 1.0, piece, begin, low, begin + (low + h), False)
                begin, low = two_sum(begin, low + h)
                self.crossing, self.stuck = Crossing(begin + low, h), 0
                return begin, low
            self.rejected += 1
            h *= 0.25
        return "switching_unresolved"

    def _switch(self, mode: Mode) -> None:
        if mode != self.mode:
            self.mode = mode
            self.switchings += 1
            self.events.append((self.t, mode))

    def _attempt(self, own: Equations, piece: Piece, begin: float, h: float) -> Attempt | None:
        n = len(self.x)
        local = piece.local(begin, h)
        given = values(local, _AT_POINTS)
        rings, x0 = own.ringing(self.x, piece, begin, h)
        # Rounding in the inputs is that of the terms they are summed from.
        terms = np.abs(piece.coefficients).sum(axis=0)
        solved = own.solve(h, x0, given, terms, self.off + self.lacking)
        x, p, noise_x, noise_p, noise_d = solved[:5]
        if not (np.isfinite(x).all() and np.isfinite(p).all()):
            return None
        beside = sum((2.0 * np.abs(ring[1]) for ring in rings), np.zeros(n))
        sizes = np.abs(x).max(axis=0) + beside, np.abs(p).max(axis=0), terms[n:]
        energy = np.sqrt(np.sum((self.weights * sizes[0]) ** 2))
        allowed = np.maximum(self.tol * np.maximum(self.scale, sizes[0]), self.least)
        allowed = np.maximum(allowed, 1e-2 * self.tol * energy / self.weights)
        allowed_p = np.maximum(self.tol * sizes[1], self.least_p)
        # What rounding leaves undetermined no shorter step resolves.
        rounding = (np.abs(radau.TAIL_OF_STATE) @ noise_x).max(axis=0)
        allowed = np.maximum(allowed, np.minimum(_MOST_ROUNDING * allowed, rounding))
        allowed_p = np.maximum(allowed_p, (np.abs(radau.TAIL_OF_MULTIPLIER) @ noise_p).max(axis=0))
        tail_x = np.abs(radau.TAIL_OF_STATE @ x).max(axis=0)
        tail_p = np.abs(radau.TAIL_OF_MULTIPLIER @ p).max(axis=0)
        tiny = np.finfo(float).tiny
        # A boundary layer shows in p at the start, which is no collocation point.
        at_start, _ = own.noise(np.abs(x0), np.abs(p[0]), terms[n:], self.off, _ONE_VALUE)
        layer = np.abs(radau.START @ p - own.multiplier(x0, values(local, _START)[0, n:]))
        layer = np.maximum(layer - at_start, 0.0)
        excess = max(
            float(np.max(tail_x / (allowed + tiny))),
            float(np.max((tail_p + layer / _EXTRAPOLATED) / (allowed_p + tiny))),
        )
        X, P, G = radau.FROM_NODES @ x, radau.FROM_POINTS @ p, values(local, _ON_GRID)
        d = own.dependent(X, P, G[:, n:])
        y, w = own.members(P, d)
        d_at = own.dependent(x[1:], p, given[:, n:])
        tail_d = np.abs(radau.TAIL_OF_MULTIPLIER @ d_at).max(axis=0)
        # What the step before was lacking decides on signs, and not on what this one may lack.
        from_points = np.abs(radau.FROM_POINTS)
        slack_p = (from_points @ (noise_p + solved.carried_p)).max(axis=0)
        slack_d = (from_points @ (noise_d + solved.carried_d)).max(axis=0)
        slack_d += own.noise(*sizes, 0.0 * self.off)[1]
        slack = own.members(
            slack_p + layer + _EXTRAPOLATED * tail_p, slack_d + _EXTRAPOLATED * tail_d
        )
        lacking = _EXTRAPOLATED * tail_x
        ys, _ = own.members(p, d_at)
        none = np.zeros(len(p[0]))
        swings = [sum((2.0 * np.abs(ring[k]) for ring in rings), none) for k in (2, 3)]
        swing = swings[0], swings[1]
        # Bounds on rounding may be far above it; a violation of so much is a switching.
        of_w = np.diag(self.given.M)
        largest = np.maximum(self.largest, [np.abs(y).max(axis=0), np.abs(w).max(axis=0)])
        slack = (
            np.minimum(slack[0], _MOST_SLACK * (self.rtol * largest[0] + self.atol)),
            np.minimum(slack[1], _MOST_SLACK * (self.rtol * largest[1] + self.atol * of_w)),
        )
        residuals = own.residuals(x, p, G[0], h, self.given.B)
        # What a layer leaves in the defect, of which bounds are made.
        most = _OF_DEFECT * (self.rtol * energy + self._norm(np.full(n, self.atol)))
        # Of that, no shorter step lowers what the rounding of x and p at the start makes of it.
        rounded = own.start_residual(self.off, np.abs(radau.START) @ (noise_p + solved.carried_p))
        layer = h * radau.mean_residual(1.0) * self._norm(np.maximum(residuals[0] - rounded, 0.0))
        excess = max(excess, layer / (most + tiny))
        return Attempt(
            x, ys, y, w, slack, rings, swing, sizes[0], noise_x.max(axis=0), lacking, excess,
            residuals,
        )  # fmt: skip

    def _locate_event(
        self, own: Equations, attempt: Attempt, h: float
    ) -> tuple[Attempt, float, Condition | None, MaskedViolation]:
        """An attempt, the first change of a constraint, and the violations that slack masks up to it.

        Slack keeps a switching from being undone by rounding. Where it would hide what matters to the
        state, there is less of it, and none at last: the signs are then those of the polynomials.
        """
        for share in _SLACKS:
            tried = attempt._replace(slack=(share * attempt.slack[0], share * attempt.slack[1]))
            theta, condition = locate_event(own, tried, h)
            masked = masked_violation(self.of, self.given, own, tried, theta, h)
            if self._is_negligible(masked, tried):
                break
        return tried, theta, condition, masked

    def _is_negligible(self, masked: MaskedViolation, found: Attempt) -> bool:
        """Whether it is a small part of what the tolerance leaves."""
        allowed = self.rtol * np.maximum(self.scale, found.size) + self.atol
        left = np.maximum(allowed - self.masked_error, 0.0)
        return bool(np.all(masked.state_error <= _MASKED_SHARE * left))

    def _account(self, masked: MaskedViolation, length: float) -> None:
        """Add to the defects what is beyond the bounds, in a step of this length."""
        of_y, of_w = masked.violation
        self.defect += length * self._norm(np.abs(self.given.B) @ of_y)
        self.law_defect += length * float(np.linalg.norm(of_w))
        self.masked_error = self.masked_error + masked.state_error

    def _keep(
        self, found: Attempt, h: float, theta: float, piece: Piece, begin: float, low: float,
        end: float, last: bool,
    ) -> None:  # fmt: skip
        """Account for an accepted step of which the part up to θ is used, save what lies in it, and
        move to its end."""
        rings = tuple(ring[:3] for ring in found.rings)
        step, begin = Step(piece.start + begin, h, theta, found.x, found.ys, rings), begin + low
        completed_defect = self.defect, self.law_defect
        of_state, of_law = found.residuals
        n, part = len(self.x), step.length * step.used
        mean = radau.mean_residual(step.used)
        error = self.piece.error
        self.defect += part * (mean * self._norm(of_state) + self._norm(error[:n]))
        self.law_defect += part * float(mean * np.linalg.norm(of_law) + np.linalg.norm(error[n:]))
        self.accepted += 1
        if step.used > 0.0:
            size, of_y, of_w = found.sizes(step.used)
            self.largest = np.maximum(self.largest, [of_y, of_w])
            # The polynomial is exact at the start of the step: Markov's bound of what it lacks later.
            self.lacking = min(1.0, _MARKOV * step.used) * found.lacking
            self.off, self.scale = found.noise, np.maximum(self.scale, size)
        self.t = piece.start + end
        share = (self.t - self.pieces[0].start) / self.span
        if self.shown + _SHOWN < share < 1.0:
            self._show(share)
        if self.bounds is not None:
            self.bounds = found.widened(self.bounds)
        done, first = (self.defect, self.law_defect), len(self.rows)
        offsets = self.times[first:] - piece.start
        # The last step has what rounding may put behind it.
        offsets = offsets if last else offsets[: np.searchsorted(offsets, end)]
        if len(offsets):
            thetas = np.clip((offsets - begin) / step.length, 0.0, step.used)
            x, y = step.at(thetas)
            q = self.piece.at((begin + thetas * step.length) / piece.length)[:, n:]
            w = y @ self.given.M.T + x @ self.given.C.T + q
            self.rows += [
                Row(
                    float(self.times[first + k]),
                    x[k],
                    y[k],
                    w[k],
                    done,
                    completed_defect,
                    self.bounds,
                )
                for k in range(len(offsets))
            ]
        if self.dense:
            self.steps.append(step)
        self.x = step.at(np.array([theta]))[0][0]

    def _norm(self, v: Array) -> float:
        """An upper bound of the norm of the state space, exact where its unit vectors are
        orthogonal."""
        return float(np.sqrt(np.sum((self.weights * v) ** 2)))


_AT_POINTS, _ON_GRID, _START = (basis(v) for v in (radau.POINTS, radau.GRID, np.zeros(1)))

_EXTRAPOLATED = 16.0
"""What a polynomial may lack at θ = 0, in units of its last coefficients."""

_MARKOV = 2.0 * radau.STAGES**2
"""The largest slope of a polynomial of a step on [0, 1] where its values are at most 1."""

_OF_DEFECT = 1e-2
"""The most that a step may add to the defect, in units of the tolerance."""

_ONE_VALUE = 16.0 * np.finfo(float).eps
"""What rounding may do to the law at one x, relative to the sum of the sizes of its terms."""

_MOST_ROUNDING = 1e3
"""How much more than `tol` a polynomial may lack where rounding is larger: a tenth of the tolerance."""

_EVEN = 3
"""Steps of one length after which a longer one is tried."""

_SLACKS = (1.0, 1e-2, 1e-4, 0.0)
"""The shares of the slack that are tried."""

_MASKED_SHARE = 0.1
"""The most that a step may mask, in units of what is left of the tolerance."""

_MOST_SLACK = 1e3
"""The most that y and w may be beyond a bound, in units of the tolerance."""

_SHOWN = 0.02
"""The share of a run between two lines that `progress` prints."""

_MOST_SHORTER = 40
"""How often a crossing is tried in a shorter step."""

_NEAR = 64.0
"""Crossings follow one another within so many of their lengths."""

_MOST_DOUBTS = 4
"""How often a switching is located again in a shorter step, until there is one."""
