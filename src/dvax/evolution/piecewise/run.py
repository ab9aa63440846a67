"""The time loop of `PiecewiseLinear`: steps in one mode, and switchings to the next mode.

A step solves the equations of its mode by collocation and samples the quantities whose signs define
the mode. Where bounds on their polynomials cannot exclude a change of sign, the loop locates the
change and ends the step there. Steps also end at the ends of the pieces of the input. After a
switching the loop first tries the longest step, then the time scales of the mode. The number of steps
therefore depends on the number of excited scales, and not on their ratios. Times within a piece are
relative to its start and stored as a sum of two numbers: a transient of 10⁻¹⁸ s is resolved at any t.
"""

import math

import numpy as np

from .. import meter
from ..setup import Options
from . import radau
from .defect import Norms, Polynomials, law_rounding, norm, step_defect
from .inputs import Piece, basis, is_continuous, values
from .lengths import length_past, lengthen, shorten, two_sum
from .modes import Condition, Equations, Mode, initial_mode, mode_after
from .murty import implicit_mode, law_mode
from .records import Attempt, Crossing, Row, Step
from .signs import locate_event, masked_error
from .system import Affine

Array = np.ndarray


class Run:
    """The state of a run from x0 over the pieces of the inputs.

    The pieces belong to the `original` system; steps use the variables of the `pivoted` system.
    With `tol` = (rtol, atol), the error of the polynomials is at most 10⁻⁴ of this tolerance. `eps` is
    the rounding error of a saved row.
    """

    def __init__(
        self, original: Affine, pivoted: Affine, pieces: list[Piece], x0: Array, norms: Norms,
        tol: tuple[float, float], times: Array, options: Options, eps: float,
    ):  # fmt: skip
        self.original, self.system, self.pieces, self.x = original, pivoted, pieces, x0
        self.norms, self.weights, self.max_steps = norms, norms.x, options.max_steps
        self.eps, self.measure = eps, options.measure
        rtol, atol = tol
        self.tol, self.min_allowed = float(np.clip(1e-4 * rtol, 1e-12, 1e-6)), 1e-4 * atol
        self.rtol, self.atol, self.masked_error = rtol, atol, 0.0 * x0
        self.largest = np.zeros((2, len(original.low)))
        # Where p is w, its absolute tolerance scales with the law.
        self.min_allowed_p = self.min_allowed * np.where(pivoted.swapped, np.diag(original.M), 1.0)
        self.times, self.dense = times, options.dense
        self._equations: dict[Mode, Equations] = {}
        self.mode = initial_mode(original)
        self.scale, self.x_error, self.truncation = np.abs(x0), 0.0 * x0, 0.0 * x0
        self.rows: list[Row] = []
        self.steps: list[Step] = []
        self.events: list[tuple[float, Mode]] = []
        self.accepted = self.rejected = self.switchings = self.switches_here = 0
        self.defect = self.law_defect = 0.0
        self.piece = pieces[0]
        self.t, self.result = pieces[0].start, "successful"
        self.began, self.printed_share = meter.now() if options.progress else None, 0.0
        self.span = pieces[-1].start + pieces[-1].length - self.t
        self.track_bounds = options.track_bounds
        # Bounds on (x, y) since the last saved time.
        self.bounds = self._no_bounds()

    def _no_bounds(self) -> Array:
        """Return the bounds (low, high) of nothing."""
        size = len(self.x) + len(self.original.low)
        return np.stack([np.full(size, np.inf), np.full(size, -np.inf)])

    def advance(self) -> None:
        """Advance to the end of the run, or to a failure, which `result` then names."""
        last = None
        for k, piece in enumerate(self.pieces):
            self.piece = piece
            inputs = self._converted(piece)
            if last is None or not is_continuous(last, piece):
                mode = law_mode(self.equations_of, self.mode, self.x, inputs, self.x_error)
                if mode is None:
                    self.result = "law_unsolved"
                    return
                self.mode, self.switches_here = mode, 0
                self.events.append((piece.start, mode))
            if self.result == "successful":
                self.result = self._through(inputs, k == len(self.pieces) - 1)
            if self.result != "successful":
                return
            last = piece
        if self.printed_share < 1.0:
            self._print_progress(1.0)

    def _print_progress(self, share: float) -> None:
        """Print the completed share of the run, if `progress` is set."""
        self.printed_share = share
        if self.began is not None:
            meter.show("PiecewiseLinear", math.floor(1000 * share), self.accepted, self.began)

    def _converted(self, piece: Piece) -> Piece:
        """Return the piece in the variables of the pivoted system."""
        c = piece.coefficients @ self.system.inputs.T
        return piece._replace(coefficients=c, noise=np.abs(self.system.inputs) @ piece.noise)

    def equations_of(self, mode: Mode) -> Equations:
        """Return the equations of a mode, built once per run."""
        if mode not in self._equations:
            self._equations[mode] = Equations(self.system, mode, self.weights)
        return self._equations[mode]

    def _through(self, piece: Piece, last: bool) -> str:
        """Take all steps of a piece, and return the name of the result."""
        begin, low, proposal = 0.0, 0.0, np.inf
        equal_steps, last_length, relocations, self.crossing = 0, 0.0, 0, Crossing(-np.inf, 0.0)
        while begin < piece.length:
            # With more switchings at one time than constraints, the law at this time does not determine
            # the next mode.
            if self.switches_here > len(self.mode):
                crossing = self._cross(piece, begin, low)
                if isinstance(crossing, str):
                    return crossing
                begin, low = crossing
            equations = self.equations_of(self.mode)
            remaining = (piece.length - begin) - low
            h = min(proposal, remaining)
            accepted, last_ratio = None, np.inf
            while accepted is None:
                if self.accepted + self.rejected >= self.max_steps:
                    return "max_steps"
                attempt = self._attempt(equations, piece, begin + low, h)
                if attempt is None:
                    return "nonfinite"
                if attempt.error_ratio > 1.0 and h > equations.shortest:
                    self.rejected += 1
                    h, last_ratio = (
                        shorten(equations, h, attempt.error_ratio, last_ratio),
                        attempt.error_ratio,
                    )
                    continue
                attempt, theta, condition, masked = self._locate_event(equations, attempt, h)
                shorter_length = length_past(equations, h, theta) if condition is not None else h
                if (
                    relocations < _MAX_RELOCATIONS
                    and shorter_length < 0.8 * h
                    and attempt.is_coarse(theta)
                ):
                    self.rejected += 1
                    relocations += 1
                    h, last_ratio = shorter_length, np.inf
                else:
                    accepted = attempt
            self.masked_error = self.masked_error + masked
            is_full = condition is None and theta == 1.0 and bool(h == remaining)
            end = piece.length if is_full else begin + (low + theta * h)
            self._accept(
                accepted, h, theta, piece, begin, low, end, bool(last and end >= piece.length)
            )
            if is_full:
                return "successful"
            begin, low = two_sum(begin, low + theta * h)
            if condition is None:
                equal_steps = equal_steps + 1 if h <= last_length else 0
                last_length = h
                proposal = (
                    4.0 * h
                    if equations.oscillations
                    else lengthen(equations, h, accepted.error_ratio)
                )
                if equal_steps >= _EQUAL_STEPS:
                    # The remaining error ratio may be roundoff, which does not depend on the step.
                    proposal, equal_steps = max(4.0 * h, proposal), 0
                continue
            proposal, equal_steps, last_length, relocations = np.inf, 0, 0.0, 0
            self._switch(mode_after(self.mode, condition))
            self.switches_here = (
                self.switches_here + 1 if theta * h <= 1e-9 * equations.shortest else 0
            )
        return "successful"

    def _cross(self, piece: Piece, begin: float, low: float) -> tuple[float, float] | str:
        """Take a short step in the mode of an implicit Euler step, and return (begin, low) after it.

        Signs within the step may violate the mode, as long as the effect on the state is negligible.
        Roundoff hides the next mode where x lies on the bounds of several modes, or where multipliers
        have boundary layers that steps do not resolve. Consecutive crossings become longer. On failure
        return the name of the result.
        """
        now, after = begin + low, self.crossing
        near = now - after.end <= _CROSSING_DISTANCE * after.length
        h = 4.0 * (after.length if near else self.equations_of(self.mode).shortest)
        h = min(h, 0.5 * ((piece.length - begin) - low))
        for _ in range(_MAX_CROSSING_TRIALS):
            if self.accepted + self.rejected >= self.max_steps:
                return "max_steps"
            mode = implicit_mode(
                self.system, self.weights, self.mode, self.x, piece, now, h, self.x_error
            )
            if mode is None:
                return "law_unsolved"
            equations = self.equations_of(mode)
            attempt = self._attempt(equations, piece, now, h)
            if attempt is None:
                return "nonfinite"
            unlimited = np.full(len(mode), np.inf)
            attempt = attempt._replace(slack=(unlimited, unlimited))
            masked = masked_error(self.equations_of, self.original, equations, attempt, 1.0, h)
            if attempt.error_ratio <= 1.0 and self._is_negligible(masked, attempt):
                self._switch(mode)
                self.masked_error = self.masked_error + masked
                self._accept(attempt, h, 1.0, piece, begin, low, begin + (low + h), False)
                begin, low = two_sum(begin, low + h)
                self.crossing, self.switches_here = Crossing(begin + low, h), 0
                return begin, low
            self.rejected += 1
            h *= 0.25
        return "switching_unresolved"

    def _switch(self, mode: Mode) -> None:
        """Change to `mode` and record the time."""
        if mode != self.mode:
            self.mode = mode
            self.switchings += 1
            self.events.append((self.t, mode))

    def _attempt(
        self, equations: Equations, piece: Piece, begin: float, h: float
    ) -> Attempt | None:
        """Compute a step and its error ratio; return None if it is not finite."""
        n = len(self.x)
        local = piece.local(begin, h)
        inputs = values(local, _AT_POINTS)
        oscillations, x0 = equations.split_oscillations(self.x, piece, begin, h)
        # The rounding error of the inputs is relative to the sum of the absolute values of their terms.
        terms = np.abs(piece.coefficients).sum(axis=0)
        solved = equations.solve(h, x0, inputs, terms, self.x_error + self.truncation)
        x, p, noise_x, noise_p, noise_d = solved[:5]
        if not (np.isfinite(x).all() and np.isfinite(p).all()):
            return None
        oscillation_size = sum(
            (2.0 * np.abs(oscillation[1]) for oscillation in oscillations), np.zeros(n)
        )
        sizes = np.abs(x).max(axis=0) + oscillation_size, np.abs(p).max(axis=0), terms[n:]
        energy = np.sqrt(np.sum((self.weights * sizes[0]) ** 2))
        allowed = np.maximum(self.tol * np.maximum(self.scale, sizes[0]), self.min_allowed)
        allowed = np.maximum(allowed, 1e-2 * self.tol * energy / self.weights)
        allowed_p = np.maximum(self.tol * sizes[1], self.min_allowed_p)
        # A shorter step does not reduce roundoff, so accept errors of that size.
        rounding = (np.abs(radau.TAIL_OF_STATE) @ noise_x).max(axis=0)
        allowed = np.maximum(allowed, np.minimum(_MAX_ROUNDOFF_RATIO * allowed, rounding))
        allowed_p = np.maximum(allowed_p, (np.abs(radau.TAIL_OF_MULTIPLIER) @ noise_p).max(axis=0))
        tail_x = np.abs(radau.TAIL_OF_STATE @ x).max(axis=0)
        tail_p = np.abs(radau.TAIL_OF_MULTIPLIER @ p).max(axis=0)
        tiny = np.finfo(float).tiny
        # A boundary layer appears as an error of p at the start, which is not a collocation point.
        at_start, _ = equations.law_errors(
            np.abs(x0), np.abs(p[0]), terms[n:], self.x_error, _LAW_ROUNDOFF
        )
        layer = np.abs(
            radau.POINTS_TO_START @ p - equations.multiplier(x0, values(local, _START)[0, n:])
        )
        layer = np.maximum(layer - at_start, 0.0)
        error_ratio = max(
            float(np.max(tail_x / (allowed + tiny))),
            float(np.max((tail_p + layer / _TAIL_FACTOR) / (allowed_p + tiny))),
        )
        X, P, G = radau.NODES_TO_GRID @ x, radau.POINTS_TO_GRID @ p, values(local, _ON_GRID)
        d = equations.dependent(X, P, G[:, n:])
        y, w = equations.members(P, d)
        d_at = equations.dependent(x[1:], p, inputs[:, n:])
        tail_d = np.abs(radau.TAIL_OF_MULTIPLIER @ d_at).max(axis=0)
        # The truncation error of the last step enters the slack of the sign test only, not the error
        # allowed in this step.
        from_points = np.abs(radau.POINTS_TO_GRID)
        slack_p = (from_points @ (noise_p + solved.carried_p)).max(axis=0)
        slack_d = (from_points @ (noise_d + solved.carried_d)).max(axis=0)
        slack_d += equations.law_errors(*sizes, 0.0 * self.x_error)[1]
        slack = equations.members(
            slack_p + layer + _TAIL_FACTOR * tail_p, slack_d + _TAIL_FACTOR * tail_d
        )
        truncation = _TAIL_FACTOR * tail_x
        ys, _ = equations.members(p, d_at)
        none = np.zeros(len(p[0]))
        amplitudes = [sum((2.0 * np.abs(part[k]) for part in oscillations), none) for k in (2, 3)]
        amplitude = amplitudes[0], amplitudes[1]
        # Bounds on roundoff may be pessimistic: a violation above this cap is a switching.
        of_w = np.diag(self.original.M)
        largest = np.maximum(self.largest, [np.abs(y).max(axis=0), np.abs(w).max(axis=0)])
        slack = (
            np.minimum(slack[0], _MAX_SLACK * (self.rtol * largest[0] + self.atol)),
            np.minimum(slack[1], _MAX_SLACK * (self.rtol * largest[1] + self.atol * of_w)),
        )
        residual = equations.start_residual(x, p, G[0], h, self.original.B)
        # Limit the contribution of a boundary layer to the defect, which error bounds are made of.
        max_defect = _MAX_STEP_DEFECT * (self.rtol * energy + self._norm(np.full(n, self.atol)))
        # Subtract the part due to roundoff at the start, which a shorter step does not reduce.
        p_error = np.abs(radau.POINTS_TO_START) @ (noise_p + solved.carried_p)
        rounded = equations.start_error(self.x_error, p_error)
        layer = h * radau.MEAN_RESIDUAL * self._norm(np.maximum(residual - rounded, 0.0))
        error_ratio = max(error_ratio, layer / (max_defect + tiny))
        return Attempt(
            x, ys, y, w, slack, oscillations, amplitude, sizes[0], noise_x.max(axis=0), truncation,
            error_ratio,
        )  # fmt: skip

    def _locate_event(
        self, equations: Equations, attempt: Attempt, h: float
    ) -> tuple[Attempt, float, Condition | None, Array]:
        """Return the attempt with its slack, θ and the condition of the first switching, and the
        effect on x of the violations that the slack masks up to θ.

        The slack prevents roundoff from reversing a switching. If the masked violations could matter to
        the state, try less slack, and finally none: the signs are then those of the polynomials.
        """
        for share in _SLACK_FACTORS:
            trial = attempt._replace(slack=(share * attempt.slack[0], share * attempt.slack[1]))
            theta, condition = locate_event(equations, trial, h)
            masked = masked_error(self.equations_of, self.original, equations, trial, theta, h)
            if self._is_negligible(masked, trial):
                break
        return trial, theta, condition, masked

    def _is_negligible(self, masked: Array, attempt: Attempt) -> bool:
        """Return whether masked violations use a small part of the remaining tolerance."""
        allowed = self.rtol * np.maximum(self.scale, attempt.size) + self.atol
        remaining = np.maximum(allowed - self.masked_error, 0.0)
        return bool(np.all(masked <= _MASKED_SHARE * remaining))

    def _accept(
        self, attempt: Attempt, h: float, theta: float, piece: Piece, begin: float, low: float,
        end: float, last: bool,
    ) -> None:  # fmt: skip
        """Accept a step up to θ: add its defect, save the rows in it, and advance to its end."""
        oscillations = tuple(oscillation[:3] for oscillation in attempt.oscillations)
        step, begin = (
            Step(piece.start + begin, h, theta, attempt.x, attempt.ys, oscillations),
            begin + low,
        )
        completed_defect = self.defect, self.law_defect
        n, of_row, part = len(self.x), 0.0, None
        after = step.evaluate(np.array([theta]))[0][0]
        self.accepted += 1
        if step.used > 0.0 and (self.measure or self.track_bounds):
            inputs = self.piece
            equations = self.equations_of(self.mode)
            part = Polynomials.of(
                attempt.x, attempt.ys, oscillations, theta, h, inputs, begin, equations.prescribed_y,
            )  # fmt: skip
            found = step_defect(
                self.original, equations, self.norms, part, self.x, after,
                inputs.uncertainty(),
            )  # fmt: skip
            self.defect, self.law_defect = self.defect + found.state, self.law_defect + found.law
            of_row = found.of_row + self.eps * self._norm(part.size())
        if step.used > 0.0:
            size, of_y, of_w = attempt.sizes(step.used)
            self.largest = np.maximum(self.largest, [of_y, of_w])
            # The error is zero at the start of the step; Markov's inequality bounds its growth.
            self.truncation = min(1.0, _MARKOV * step.used) * attempt.truncation
            self.x_error, self.scale = attempt.noise, np.maximum(self.scale, size)
        self.t = piece.start + end
        share = (self.t - self.pieces[0].start) / self.span
        if self.printed_share + _PROGRESS_INTERVAL < share < 1.0:
            self._print_progress(share)
        first = len(self.rows)
        offsets = self.times[first:] - piece.start
        # The last step includes saved times that rounding puts after its end.
        offsets = offsets if last else offsets[: np.searchsorted(offsets, end)]
        thetas = np.clip((offsets - begin) / step.length, 0.0, step.used)
        bounds = self._bounds_at(part, step, thetas)
        if len(offsets):
            x, y = step.evaluate(thetas)
            q = self.piece.evaluate((begin + thetas * step.length) / piece.length)[:, n:]
            w = y @ self.original.M.T + x @ self.original.C.T + q
            defect, of_w = (self.defect + of_row, self.law_defect), np.zeros_like(w)
            if self.measure:
                of_w = law_rounding(self.original, x, y, q) + self.piece.uncertainty()[n:]
            # The start of the run is exact.
            starts = (self.accepted == 1) & (thetas == 0.0)
            self.rows += [
                Row(
                    float(self.times[first + k]), self.x if starts[k] else x[k], y[k], w[k],
                    (0.0, 0.0) if starts[k] else defect, completed_defect,
                    None if bounds is None else bounds[k], of_w[k],
                )
                for k in range(len(offsets))
            ]  # fmt: skip
        if self.dense:
            self.steps.append(step)
        self.x = after

    def _bounds_at(self, part: Polynomials | None, step: Step, thetas: Array) -> list[Array] | None:
        """Return bounds on (x, y) from each of these θ of a step back to the last saved time, if bounds
        are tracked. The step has a `part` unless its length is zero."""
        if not self.track_bounds:
            return None
        if part is None:
            at = np.concatenate(step.evaluate(np.zeros(1)), axis=1)[0]
            boxes = np.broadcast_to(at, (len(thetas) + 1, 2, len(at)))
        else:
            boxes = part.boxes(np.concatenate([[0.0], thetas / step.used, [1.0]]))
        found = []
        for box in boxes:
            low, high = np.minimum(self.bounds[0], box[0]), np.maximum(self.bounds[1], box[1])
            found.append(np.stack([low, high]))
            self.bounds = self._no_bounds()
        self.bounds = found.pop()
        return found

    def _norm(self, v: Array) -> float:
        """Return the norm of an element of the state space."""
        return norm(self.weights, v)


_AT_POINTS, _ON_GRID, _START = (basis(v) for v in (radau.POINTS, radau.GRID, np.zeros(1)))

_TAIL_FACTOR = 16.0
"""Bound on the error of a polynomial at θ = 0, in units of its last two coefficients."""

_MARKOV = 2.0 * radau.STAGES**2
"""Markov's inequality: the largest slope on [0, 1] of a polynomial bounded by 1 (degree `STAGES`)."""

_MAX_STEP_DEFECT = 1e-2
"""Largest contribution of one step to the defect, in units of the tolerance."""

_LAW_ROUNDOFF = 16.0 * np.finfo(float).eps
"""Rounding error of the law at one x, relative to the sum of the absolute values of its terms."""

_MAX_ROUNDOFF_RATIO = 1e3
"""Largest ratio of accepted roundoff to `tol`: a tenth of the user's tolerance."""

_EQUAL_STEPS = 3
"""Number of steps of one length after which a longer one is tried."""

_SLACK_FACTORS = (1.0, 1e-2, 1e-4, 0.0)
"""The factors by which `_locate_event` reduces the slack, in this order."""

_MASKED_SHARE = 0.1
"""Largest effect on the state that a step may mask, in units of the remaining tolerance."""

_MAX_SLACK = 1e3
"""Largest slack of y and w, in units of the tolerance."""

_PROGRESS_INTERVAL = 0.02
"""Share of a run between two lines that `progress` prints."""

_MAX_CROSSING_TRIALS = 40
"""Largest number of lengths that a crossing tries."""

_CROSSING_DISTANCE = 64.0
"""Crossings are consecutive if the next one begins within this multiple of the last one's length."""

_MAX_RELOCATIONS = 4
"""How often a switching is located again in a shorter step, between two switchings."""
