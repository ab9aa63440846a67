"""Published circuits, solved from switching to switching by matrix exponentials.

In each mode (which diodes conduct, which transistors are saturated) a circuit is linear, and so are its
sources: z = (x, sources) obeys z' = Zz until one of the `conditions`, linear functions of z that are
not negative in the mode, becomes negative. The matrices are written down here by hand, from Kirchhoff's
laws; nothing is shared with dvax. Samples after a switching begin at a hundredth of the fastest time
scale and become longer, up to a sixtieth of a period of the fastest oscillation. A change
of sign between two samples is bisected to rounding.
All is computed in long double, whose roundoff is 2000 times smaller than that of a double on x86.
The roundoff of a matrix exponential is proportional to the norm of the matrix, so states that decay
fast are separated from the others first.
"""

import itertools
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

Array = np.ndarray

BRIDGE = """C1 a 0 1u IC=10
L1 a 0 10m
D1 a p
D2 0 p
D3 n a
D4 n 0
R1 p n 1k
"""
FILTERED = BRIDGE + "C2 p n 300n\n"
TANK = "C1 1 0 1u IC=10\nL1 1 0 10m\nD1 1 0 R=1k\n"
CONVERTER = """V1 in 0 PULSE(-12 12 0 0 0 4u 10u)
D1 in sw R=0.1 G=1u
D2 0 sw R=0.1 G=1u
L1 sw out 100u
C1 out 0 10u
R1 out 0 100
"""

_C, _L, _R, _C2 = (np.longdouble(value) for value in (1e-6, 1e-2, 1e3, 3e-7))


class Mode(NamedTuple):
    """z' = Zz as long as all `conditions` z ≥ 0; a mode starts only where all `ties` z = 0.

    `fast`: the entries of z whose rates, on the diagonal of Z, exceed all others by far.
    """

    Z: Array
    conditions: Array
    ties: Array | None = None
    fast: tuple[int, ...] = ()


Modes = Mapping[Any, Mode]
Choice = Callable[[Array], Any]


def follow(
    modes: Modes,
    x0: Array,
    pieces: Iterable[tuple[float, Array]],
    ts: Array,
    choice: Choice | None = None,
    fewest: int = 500,
    first: float = np.inf,
) -> tuple[Array, int]:
    """Return x at `ts`, the last of which is the end, and the number of switchings.

    `pieces` are the times at which sources have a new form, with the values that z has there after x.
    `choice` returns the key of the mode at z; without it the modes are tried. No sample is longer than
    1/`fewest` of the time until the sources change, and none after a switching longer than `first`.
    """
    starts = [*pieces]
    n, end = len(x0), float(ts[-1])
    solvers = {name: _Linear(mode, first) for name, mode in modes.items()}

    def at(z: Array, near: Any) -> Any:
        if choice is None:
            return _valid(solvers, z, near)
        name = choice(z)
        if name not in solvers:
            solvers[name] = _Linear(modes[name], first)
        return name

    x, key, switchings = np.asarray(x0, np.longdouble), None, 0
    rows: list[Array] = []
    for k, (start, sources) in enumerate(starts):
        if start >= end:
            break
        stop = min(end, starts[k + 1][0]) if k + 1 < len(starts) else end
        z, t = np.concatenate([x, sources]), np.longdouble(start)
        key = at(z, key)
        while t < stop:
            solver = solvers[key]
            length, reached, changed = solver.until_change(z, stop - t, fewest)
            last = stop == end and not changed
            while len(rows) < len(ts) and (ts[len(rows)] < t + length or last):
                rows.append(solver.after(z, ts[len(rows)] - t)[:n])
            z, t = reached, (t + length if changed else np.longdouble(stop))
            if changed:
                old, key = key, at(z, key)
                switchings += key != old
        x = z[:n]
    return np.array(rows, float), switchings


class _Linear:
    """The solution of one mode."""

    def __init__(self, mode: Mode, first: float):
        self.Z = np.asarray(mode.Z, np.longdouble)
        self.conditions, self.ties = mode.conditions, mode.ties
        self.exponential = _Separated(self.Z, mode.fast)
        rates = self.exponential.rates()
        fastest = max(float(np.abs(rates).max()), 1.0)
        turning = float(np.abs(np.imag(rates)).max())
        self.shortest = min(1e-2 / fastest, first)
        self.longest = 0.1 / turning if turning else np.inf
        self._powers: dict[float, Array] = {}

    def power(self, h: float) -> Array:
        if h not in self._powers:
            self._powers[h] = self.exponential(h)
        return self._powers[h]

    def after(self, z: Array, h: float) -> Array:
        return self.exponential(h) @ z

    def margins(self, z: Array) -> Array:
        """The conditions, relative to the sizes of their terms."""
        size = np.abs(self.conditions) @ np.abs(z)
        return self.conditions @ z / np.where(size > 0.0, size, 1.0)

    def until_change(self, z: Array, length: Any, fewest: int) -> tuple[float, Array, bool]:
        """Return how long the mode lasts, at most `length`, z then, and whether it has changed."""
        t, h, count = 0.0, self.shortest, 0
        while True:
            if count >= 8 and 2.0 * h <= min(self.longest, length / fewest):
                h, count = 2.0 * h, 0
            if t + h >= length:
                after = self.after(z, length - t)
                if np.all(self.margins(after) >= -_NOISE):
                    return length, after, False
            else:
                after = self.power(h) @ z
            if np.any(self.margins(after) < -_NOISE):
                break
            z, t, count = after, t + h, count + 1
        # Halve the interval (t, t + step) in which a condition fails.
        step = h
        for _ in range(60):
            step *= 0.5
            middle = self.power(step) @ z
            if t + step < length and np.all(self.margins(middle) >= -_NOISE):
                z, t = middle, t + step
        return t, z, True


class _Separated:
    """h ↦ exp(Zh), where the states b of `fast` decay and the others a are slow.

    With a' = Z₁₁a + Z₁₂b, b' = Z₂₁a + Z₂₂b and L, R such that

        Z₂₂L = L(Z₁₁ + Z₁₂L) − Z₂₁,    RF = SR + Z₁₂,    S = Z₁₁ + Z₁₂L,    F = Z₂₂ − LZ₁₂,

    ξ = b − La and η = a − Rξ obey ξ' = Fξ and η' = Sη. Both equations are solved by iteration with the
    diagonal of the fast matrix, to roundoff.
    """

    def __init__(self, Z: Array, fast: tuple[int, ...]):
        self.fast = np.array(fast, int)
        self.slow = np.setdiff1d(np.arange(len(Z)), self.fast)
        a, b = self.slow, self.fast
        Z11, Z12, Z21, Z22 = (Z[np.ix_(i, j)] for i in (a, b) for j in (a, b))
        rates = np.diag(Z22)
        L = _limit(lambda L: (L @ (Z11 + Z12 @ L) - Z21 - Z22 @ L) / rates[:, None] + L, 0.0 * Z21)
        self.S, self.F = Z11 + Z12 @ L, Z22 - L @ Z12
        rates = np.diag(self.F)
        R = _limit(lambda R: (self.S @ R + Z12 - R @ self.F) / rates + R, 0.0 * Z12)
        eye = np.eye(len(a), dtype=Z.dtype), np.eye(len(b), dtype=Z.dtype)
        self.to = np.block([[eye[0] + R @ L, -R], [-L, eye[1]]])
        self.back = np.block([[eye[0], R], [L, eye[1] + L @ R]])

    def rates(self) -> Array:
        return np.concatenate([np.linalg.eigvals(v.astype(float)) for v in (self.S, self.F)])

    def __call__(self, h: float) -> Array:
        n, order = len(self.slow), np.argsort(np.concatenate([self.slow, self.fast]))
        middle = 0.0 * self.to
        middle[:n, :n], middle[n:, n:] = _exponential(self.S * h), _exponential(self.F * h)
        return (self.back @ middle @ self.to)[np.ix_(order, order)]


def _limit(step: Callable[[Array], Array], start: Array) -> Array:
    """Return the fixed point of `step`. **Raises:** `ValueError` if the iteration finds none."""
    first = np.inf
    for _ in range(100):
        new = step(start)
        change, start = np.abs(new - start).max(initial=0.0), new
        if change > first:
            break
        first = change if np.isinf(first) else first
        if change <= 4.0 * np.finfo(new.dtype).eps * np.abs(new).max(initial=0.0):
            return new
    raise ValueError("the rates of the fast states do not exceed those of the others by far enough")


_NOISE = 16.0 * float(np.finfo(np.longdouble).eps)


def _exponential(matrix: Array) -> Array:
    """Return exp of a matrix by Taylor's series of its 2⁻ᵏ and k squarings, whose roundoff is
    proportional to the norm: in long double, so that a diode of 1 mΩ leaves more than 12 digits."""
    size = float(np.abs(matrix).sum(axis=1).max(initial=0.0))
    k = max(0, int(np.ceil(np.log2(size))) + 3) if size > 0.0 else 0
    scaled = matrix / np.longdouble(2) ** k
    total = term = np.eye(len(matrix), dtype=np.longdouble)
    for order in range(1, 15):
        term = term @ scaled / order
        total = total + term
    for _ in range(k):
        total = total @ total
    return total


def _valid(solvers: Mapping[Any, _Linear], z: Array, near: Any) -> Any:
    """Return the mode whose conditions hold a moment later."""

    def distance(key: Any) -> int:
        return 0 if near is None else sum(a != b for a, b in zip(key, near, strict=True))

    best, key = -np.inf, None
    for candidate in sorted(solvers, key=distance):
        solver = solvers[candidate]
        if solver.ties is not None:
            size = np.abs(solver.ties) @ np.abs(z)
            if np.any(np.abs(solver.ties @ z) > 1e-9 * size):
                continue
        # A tenth of the first sample: a switching to another mode is behind it. The mode that has just
        # ended, with a margin of −_NOISE, must not go on.
        margin = float(np.min(solver.margins(solver.power(0.1 * solver.shortest) @ z)))
        if margin >= -0.25 * _NOISE:
            return candidate
        if margin > best:
            best, key = margin, candidate
    return key


def _rates(on: Iterable[bool], r: float, g: float) -> list[Any]:
    """Return the conductances of regularised diodes: r alone, or r and 1/g in series."""
    on_state, leak = np.longdouble(r), np.longdouble(g)
    off_state = leak / (1.0 + on_state * leak)
    return [1.0 / on_state if conducts else off_state for conducts in on]


def _signs(on: Iterable[bool]) -> Array:
    return np.where(list(on), 1.0, -1.0)[:, None]


def bridge(r: float, g: float) -> Modes:
    """Return the modes of `BRIDGE` with r (Ω) and g (S) in its diodes: x = (V of C1, A of L1)."""
    modes = {}
    for on in itertools.product((True, False), repeat=4):
        g1, g2, g3, g4 = _rates(on, r, g)
        load = 1.0 / _R
        total = (g1 + g2) * (g3 + g4) + (g1 + g2 + g3 + g4) * load
        # Currents for 1 V between a and ground, by elimination of p and n, without differences.
        i1 = g1 * (g2 * (g3 + g4) + (g2 + g4) * load) / total
        i2 = -g2 * (g1 * (g3 + g4) + (g1 + g3) * load) / total
        i3 = -g3 * (g4 * (g1 + g2) + (g2 + g4) * load) / total
        i4 = g4 * (g3 * (g1 + g2) + (g1 + g3) * load) / total
        Z = np.array([[-(i1 - i3) / _C, -1.0 / _C], [1.0 / _L, 0.0]])
        currents = np.array([[i, 0.0] for i in (i1, i2, i3, i4)])
        modes[on] = Mode(Z, _signs(on) * currents)
    return modes


def ideal_bridge(ts: Array) -> Array:
    """Return x at `ts` for ideal diodes: the load sees |v|, so that the circuit is linear."""
    matrix = np.array([[-1.0 / (_R * _C), -1.0 / _C], [1.0 / _L, 0.0]], float)
    rates, vectors = np.linalg.eig(matrix)
    start = np.linalg.solve(vectors, np.array([10.0, 0.0]))
    return (np.exp(np.multiply.outer(ts, rates)) * start @ vectors.T).real


def filtered(r: float, g: float) -> Modes:
    """Return the modes of `FILTERED`: x = (V of C1, V of C2, A of L1)."""
    modes = {}
    for on in itertools.product((True, False), repeat=4):
        g1, g2, g3, g4 = _rates(on, r, g)
        total = g1 + g2 + g3 + g4
        # n = ((g1 + g3) v − (g1 + g2) w)/total with v of C1 and w of C2, and p = n + w.
        currents = np.array([
            [g1 * (g2 + g4), -g1 * (g3 + g4), 0.0],
            [-g2 * (g1 + g3), -g2 * (g3 + g4), 0.0],
            [-g3 * (g2 + g4), -g3 * (g1 + g2), 0.0],
            [g4 * (g1 + g3), -g4 * (g1 + g2), 0.0],
        ]) / total  # fmt: skip
        Z = np.array([[0.0, 0.0, -1.0 / _C], [0.0, -1.0 / (_R * _C2), 0.0], [1.0 / _L, 0.0, 0.0]])
        Z[0] -= (currents[0] - currents[2]) / _C
        Z[1] += (currents[0] + currents[1]) / _C2
        modes[on] = Mode(Z, _signs(on) * currents)
    return modes


def ideal_filtered() -> tuple[Modes, Array]:
    """Return the modes of `FILTERED` with ideal diodes, and its state after the jump at t = 0, where
    C1 and C2 are connected and keep their charge."""
    free = np.array([[0.0, 0.0, -1.0 / _C], [0.0, -1.0 / (_R * _C2), 0.0], [1.0 / _L, 0.0, 0.0]])
    modes: dict[Any, Mode] = {
        (0,): Mode(free, np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])),
    }
    for sign in (1.0, -1.0):
        both = np.array([-1.0 / _R, 0.0, -1.0]) / (_C + _C2)
        Z = np.array([both, sign * both, [1.0 / _L, 0.0, 0.0]])
        current = sign * (np.array([0.0, 0.0, -1.0]) - _C * both)
        modes[(int(sign),)] = Mode(Z, current[None], np.array([[1.0, -sign, 0.0]]))
    v = 10.0 * _C / (_C + _C2)
    return modes, np.array([v, v, 0.0])


def tank() -> Modes:
    """Return the modes of `TANK`: x = (V of C1, A of L1)."""
    row = np.array([[1.0, 0.0]])
    loaded = np.array([[-1.0 / (_R * _C), -1.0 / _C], [1.0 / _L, 0.0]])
    free = np.array([[0.0, -1.0 / _C], [1.0 / _L, 0.0]])
    return {(True,): Mode(loaded, row), (False,): Mode(free, -row)}


def converter() -> Modes:
    """Return the modes of `CONVERTER`: x = (V of C1, A of L1), and z = (x, V of the source)."""
    modes = {}
    for on in itertools.product((True, False), repeat=2):
        g1, g2 = _rates(on, 0.1, 1e-6)
        total = g1 + g2
        node = np.array([0.0, -1.0, g1]) / total
        first = np.array([0.0, g1, g1 * g2]) / total
        second = np.array([0.0, g2, -g1 * g2]) / total
        Z = np.array([[-1.0 / (100.0 * 1e-5), 1.0 / 1e-5, 0.0], node / 1e-4, np.zeros(3)])
        Z[1, 0] -= 1.0 / 1e-4
        modes[on] = Mode(Z, _signs(on) * np.stack([first, second]))
    return modes


def pulses(periods: int) -> list[tuple[float, Array]]:
    """Return the pieces of the source of `CONVERTER`."""
    return [
        (1e-5 * k + late, np.array([volts]))
        for k in range(periods) for late, volts in ((0.0, 12.0), (4e-6, -12.0))
    ]  # fmt: skip
