"""Circuits with one source, solved from switching to switching in 100 decimal digits.

With ζ = (x, s, …) the source is a linear system as well, so in each mode ζ' = Zζ with a constant Z,
and ζ(τ) = exp(Zτ)ζ(0) by Taylor's series and squaring. A switching is where one of the currents and
blocked voltages, linear functions of ζ, changes its sign; it is bisected to the last digit. Nothing in
here is stiff, small or large in a way that 100 digits would notice. What is sampled is only whether
there is a change of sign: sixteen times an octave after every switching, and a dozen times a
period, with the slopes at both ends of each interval.
"""

import decimal
import itertools
from decimal import Decimal
from typing import NamedTuple

import numpy as np

Array = np.ndarray

DIGITS = 100
PI = Decimal(
    "3.14159265358979323846264338327950288419716939937510582097494459230781640628620899862803482534211"
    "70679821480865132823066470938446095505822317253594081284811174502841027"
)
_A_OCTAVE, _MOST_SAMPLES = 16, 40_000


class TooManySamples(Exception):
    """An oscillation lasts too long for every period of it to be sampled."""


class Exact(NamedTuple):
    """States, currents and blocked voltages of the diodes at the saved times, and the switchings."""

    xs: Array
    currents: Array
    blocked: Array
    switchings: int


def _solve(a: Array, b: Array) -> Array:
    """a⁻¹b by elimination; pivots are the largest entries of a column."""
    a, b = a.copy(), b.copy()
    for k in range(len(a)):
        p = k + int(np.argmax(np.abs(a[k:, k])))
        a[[k, p]], b[[k, p]] = a[[p, k]], b[[p, k]]
        for i in range(len(a)):
            if i != k and a[i, k]:
                factor = a[i, k] / a[k, k]
                a[i, k:] -= factor * a[k, k:]
                b[i] -= factor * b[k]
    return b / np.diag(a)[:, None]


def _zeros(*shape: int) -> Array:
    return np.full(shape, Decimal(0), object)


def _eye(n: int) -> Array:
    return np.where(np.eye(n) > 0, Decimal(1), Decimal(0))


def _exp(Z: Array) -> Array:
    """exp(Z) for ‖Z‖ ≤ 10⁻³."""
    total = term = _eye(len(Z))
    for k in range(1, 40):
        term = term.dot(Z) / Decimal(k)
        total = total + term
    return total


class _Circuit:
    """x' = Ax + By + b s, w = Dy + Cx + e s with the currents y of the diodes; an equation for every
    node and branch is solved for them."""

    def __init__(self, text: str):
        branches: list[tuple[str, str, str, Decimal]] = []
        for line in filter(None, map(str.strip, text.splitlines())):
            name, a, b, *rest = line.split()
            if name[0] == "D":
                r, g = (Decimal(float(word.split("=")[1])) for word in rest)
                inside = name + ":inside"
                branches += [("R", a, inside, r), ("D", inside, b, Decimal(0))]
                branches.append(("R", inside, b, 1 / g))
            else:
                value = Decimal(0) if name[0] == "V" else Decimal(float(rest[0]))
                branches.append((name[0], a, b, value))
        nodes = sorted({n for _, a, b, _ in branches for n in (a, b)} - {"0"})
        n, m = len(nodes), len(branches)
        of = {kind: [k for k, row in enumerate(branches) if row[0] == kind] for kind in "RLCVD"}
        given = [*of["C"], *of["L"], *of["V"], *of["D"]]
        system, right = _zeros(n + m, n + m), _zeros(n + m, len(given))
        voltage = _zeros(m, n + m)
        for k, (kind, a, b, value) in enumerate(branches):
            for node, sign in ((a, 1), (b, -1)):
                if node != "0":
                    system[nodes.index(node), n + k] += sign  # Kirchhoff's law of the node
                    voltage[k, nodes.index(node)] += sign
            if kind in "RCV":
                system[n + k] += voltage[k]
            if kind == "R":
                system[n + k, n + k] -= value
            if kind in "LD":
                system[n + k, n + k] += 1
            if kind != "R":
                right[n + k, given.index(k)] = Decimal(1)
        solved = _solve(system, right)
        rates = [solved[n + k] / branches[k][3] for k in of["C"]]
        rates += [voltage[k].dot(solved) / branches[k][3] for k in of["L"]]
        blocked = np.array([-voltage[k].dot(solved) for k in of["D"]])
        x, d = len(rates), len(of["D"])
        self.A, self.b, self.B = np.split(np.array(rates), [x, len(given) - d], axis=1)
        self.C, self.e, self.D = np.split(blocked, [x, len(given) - d], axis=1)


class _Mode:
    """ζ' = Zζ while these diodes conduct, `currents` and `blocked` voltages as rows times ζ, and
    exp(Zh) for h = `first` · 2ᵏ. `drive` has the source in its first row: σ' = `drive` σ, s = σ₀."""

    def __init__(self, own: _Circuit, on: Array, drive: Array):
        n, m, k = len(own.A), len(own.D), len(drive)
        C, D = np.hstack([own.C, own.e, _zeros(m, k - 1)]), own.D
        self.currents = _zeros(m, n + k)
        if on.any():
            self.currents[on] = -_solve(D[np.ix_(on, on)], C[on])
        self.blocked = C + D.dot(self.currents)
        self.blocked[on] = Decimal(0)
        top = np.hstack([own.A, own.b, _zeros(n, k - 1)]) + own.B.dot(self.currents)
        self.Z = np.vstack([top, np.hstack([_zeros(k, n), drive])])
        # Each has a sign to keep.
        self.conditions = np.where(on[:, None], self.currents, self.blocked)
        self.on = on
        spectrum = np.linalg.eigvals(self.Z[:n, :n].astype(float))
        ringing = spectrum[np.abs(spectrum.imag) > np.abs(spectrum.real) / 8]
        # (longest step, how long) of each oscillation
        self.rings = [
            (0.5 / abs(v.imag), 100.0 / max(-v.real, 1e-300)) for v in ringing if v.imag > 0
        ]
        norm = max(np.abs(self.Z).sum(axis=1))
        self.first = Decimal(1) / 1000 / norm
        self._powers = [_exp(self.Z * self.first)]

    def power(self, k: int) -> tuple[Decimal, Array]:
        while len(self._powers) <= k:
            self._powers.append(self._powers[-1].dot(self._powers[-1]))
        return self.first * 2**k, self._powers[k]

    def dip(self, before: Array, after: Array, h: Decimal, noise: Array) -> Decimal | None:
        """A time within h at which a condition that holds at both ends does not; by its slopes."""
        slopes = self.conditions.dot(self.Z)
        for k in range(len(slopes)):
            falls, rises = slopes[k].dot(before), slopes[k].dot(after)
            if not falls < 0 < rises:
                continue
            start, end = self.conditions[k].dot(before), self.conditions[k].dot(after)
            # Where both tangents meet.
            meet = (end - start - rises * h) / (falls - rises)
            if start + falls * meet >= 0:
                continue
            low, high = Decimal(0), h
            for _ in range(60):
                middle = (low + high) / 2
                at = self.after(before, middle)
                if self.conditions[k].dot(at) < -noise[k]:
                    return middle
                low, high = (middle, high) if slopes[k].dot(at) < 0 else (low, middle)
        return None

    def after(self, zeta: Array, time: Decimal) -> Array:
        """ζ after any time: the binary digits of it, and what is left by Taylor's series."""
        count, left = divmod(time, self.first)
        bits = int(count)
        zeta = _exp(self.Z * left).dot(zeta)
        for k in range(bits.bit_length()):
            if bits >> k & 1:
                zeta = self.power(k)[1].dot(zeta)
        return zeta


def solve_exactly(text: str, source: str, ts: Array) -> Exact:
    """The circuit `text` from rest, whose only source is `source`, SIN of three numbers or PULSE of
    seven; saved at `ts`, the last of which is the end.

    **Raises:** `TooManySamples` where there are oscillations of too many periods.
    """
    with decimal.localcontext() as context:
        context.prec = DIGITS
        return _solve_exactly(text, source, [Decimal(float(t)) for t in ts])


def _solve_exactly(text: str, source: str, ts: list[Decimal]) -> Exact:
    own = _Circuit(text.replace(source, "0"))
    name, *words = source.replace("(", " ").replace(")", " ").split()
    numbers = [Decimal(float(word)) for word in words]
    n, m = len(own.A), len(own.D)
    if name == "SIN":
        offset, size, frequency = numbers
        w = 2 * PI * frequency
        # σ = (s, cosine part, offset)
        drive, wave = (
            np.array([[0, w, 0], [-w, 0, w], [0, 0, 0]], object) * Decimal(1),
            0.5 / float(w),
        )
        starts = [(Decimal(0), np.array([offset, size, offset], object))]
    else:
        low, high, delay, rise, fall, width, period = numbers
        drive, wave = np.array([[0, 1], [0, 0]], object) * Decimal(1), float(period)
        starts = [(Decimal(0), np.array([low, Decimal(0)], object))]
        for k in itertools.count():
            at = delay + k * period
            if at >= ts[-1]:
                break
            slope, back = (high - low) / rise, (low - high) / fall
            for when, value, rate in (
                (at, low, slope), (at + rise, high, Decimal(0)), (at + rise + width, high, back),
                (at + rise + width + fall, low, Decimal(0)),
            ):  # fmt: skip
                starts.append((when, np.array([value, rate], object)))
        starts = [row for row in starts if row[0] < ts[-1]]
    modes: dict[tuple[bool, ...], _Mode] = {}

    def of(on: tuple[bool, ...]) -> _Mode:
        if on not in modes:
            modes[on] = _Mode(own, np.array(on), drive)
        return modes[on]

    def fitting(zeta: Array, near: tuple[bool, ...]) -> _Mode:
        """The mode whose signs hold a moment later; the likely ones are tried first."""
        for on in sorted(
            itertools.product((False, True), repeat=m),
            key=lambda on: sum(a != b for a, b in zip(on, near, strict=True)),
        ):
            mode = of(on)
            later = mode.after(zeta, mode.first * Decimal("1e-12"))
            noise = Decimal(10) ** (20 - DIGITS) * np.abs(mode.conditions).dot(np.abs(later))
            if all(mode.conditions.dot(later) >= -noise):
                return mode
        raise AssertionError("no mode goes on from here")

    x, on, switchings, samples = _zeros(n), (False,) * m, 0, 0
    rows: list[tuple[Array, Array, Array]] = []
    t = Decimal(0)
    for k, (start, sigma) in enumerate(starts):
        end = starts[k + 1][0] if k + 1 < len(starts) else ts[-1]
        zeta, t = np.concatenate([x, sigma]), start
        mode = fitting(zeta, on)
        while t < end:
            reached, level, count = Decimal(0), 0, 0
            before, changed = zeta, None
            while changed is None and t + reached < end:
                h, E = mode.power(level)
                if reached and count >= _A_OCTAVE:
                    longest = [top for top, lasts in mode.rings if float(reached) < lasts]
                    if 2 * h <= min([*longest, wave]):
                        level, count = level + 1, count // 2
                        continue
                samples += 1
                if samples > _MOST_SAMPLES:
                    raise TooManySamples(f"{_MOST_SAMPLES} samples do not show every period")
                count += 1
                if t + reached + h >= end:
                    h = end - t - reached
                    after = mode.after(before, h)
                else:
                    after = E.dot(before)
                # Against the rounding of 100 digits alone.
                noise = Decimal(10) ** (30 - DIGITS) * np.abs(mode.conditions).dot(np.abs(after))
                if all(mode.conditions.dot(after) >= -noise):
                    dip = mode.dip(before, after, h, noise)
                    if dip is not None:
                        h, after = dip, mode.after(before, dip)
                if any(mode.conditions.dot(after) < -noise):
                    low, high = Decimal(0), h
                    for _ in range(160):
                        middle = (low + high) / 2
                        bad = any(mode.conditions.dot(mode.after(before, middle)) < -noise)
                        low, high = (low, middle) if bad else (middle, high)
                    changed = reached + high
                else:
                    reached, before = reached + h, after
            stop = min(end, t + changed) if changed is not None else end
            while len(rows) < len(ts) and (
                ts[len(rows)] < stop or (stop == end == ts[-1] and ts[len(rows)] <= stop)
            ):
                at = mode.after(zeta, ts[len(rows)] - t)
                rows.append((at[:n], mode.currents.dot(at), mode.blocked.dot(at)))
            zeta, t = mode.after(zeta, stop - t), stop
            on = tuple(map(bool, mode.on))
            if changed is not None:
                mode = fitting(zeta, on)
                switchings += 1
        x, on = zeta[:n], tuple(map(bool, mode.on))
    xs, currents, blocked = (np.array(v, float) for v in zip(*rows, strict=True))
    return Exact(xs, currents, blocked, switchings)
