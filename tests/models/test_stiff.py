"""Circuits with diodes of almost no resistance."""

import itertools

import numpy as np
import pytest
import scipy.integrate
from tests.models.exact_circuit import TooManySamples, solve_exactly
from tests.models.tableau import random_netlist, tableau
from tests.oracles import affine_box_vi
from tests.selection import mostly_thorough, spread

import dvax
from dvax.formats.netlist_sources import read_waveform
from dvax.models.circuit import Circuit

RESISTANCES = (1.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
SOURCES = {
    "SIN": ("SIN(0 10 1k)", 3e-3, 3),
    "PULSE": ("PULSE(-5 10 10u 1n 1n 200u 500u)", 2e-3, 17),
    "PWL": ("PWL(0 0 1n 10 50u 10 50.001u -5 900u -5 900.001u 8 2m 0)", 2e-3, 7),
}


def rectifier(r, source, capacity="", stray="", inductance="10u"):
    """Half a wave through a diode and an inductor, with strays beside and in front of them; 1 kΩ
    across the node between, as a snubber has it, so that strays do not ring for ever."""
    diode = f"D1 a d R={r:g} G=1u\nL9 d b 1n\nR8 b 0 1k" if stray else f"D1 a b R={r:g} G=1u"
    beside = f"C9 b 0 {capacity}\nR9 b 0 1k" if capacity else ""
    return f"V1 a 0 {source}\n{diode}\n{beside}\nL1 b c {inductance}\nR1 c 0 10\nC1 c 0 1u\n"


def work(sol):
    return int(sol.stats["steps"]) + int(sol.stats["rejected"])


CASES = list(
    itertools.product(RESISTANCES, ("", "1n", "1p"), ("", "1n"), ("10u", "1m"), sorted(SOURCES))
)
FEW = [
    (1e-1, "", "", "10u", "SIN"), (1e-6, "", "", "10u", "SIN"), (1e-6, "1n", "", "10u", "PULSE"),
    (1e-3, "1p", "", "1m", "PWL"),
]  # fmt: skip


def agrees_at_any_resistance(case):
    """Check that the run ends, the law holds, and the cost does not grow with 1/r."""
    r, capacity, stray, inductance, kind = case
    source, end, events = SOURCES[kind]
    circuit = Circuit(rectifier(r, source, capacity, stray, inductance))
    ts = np.linspace(0.0, end, 41)
    sol = circuit.solve(end, ts)
    assert work(sol) <= 60 * (int(sol.stats["switchings"]) + events + len(ts)), sol.stats
    current = np.asarray(
        [circuit.currents(*row) for row in zip(sol.ts, sol.xs, sol.us, strict=True)]
    )
    assert current.min() > -1e-6
    # Of one diode a projection step solves the law: its length holds all that is known.
    assert (
        np.abs(np.asarray(sol.law_residual)).max() + np.abs(np.asarray(sol.law_step)).max() < 1e-7
    )
    return sol


@pytest.mark.slow
@pytest.mark.parametrize("case", FEW)
def test_stiff_diodes_of_small_resistance_succeed_at_the_defaults(case):
    agrees_at_any_resistance(case)


@pytest.mark.thorough
@pytest.mark.parametrize("case", spread(CASES, 41))
def test_stiff_circuits_with_any_resistance_parasitics_and_source_succeed_at_the_defaults(case):
    agrees_at_any_resistance(case)


def test_stiff_diode_converges_to_the_ideal_one_linearly_in_r():
    ends = [
        np.asarray(Circuit(rectifier(r, "SIN(0 10 1k)")).solve(0.4e-3).xs[-1])
        for r in (1e-2, 1e-3, 1e-4, 1e-5)
    ]
    steps = np.abs(np.diff(ends, axis=0))
    np.testing.assert_allclose(np.log10(steps[:-1] / steps[1:]), 1.0, atol=0.02)


@pytest.mark.parametrize(
    "case",
    [
        (1e-1, "SIN(0 10 1k)", ""),
        pytest.param((1e-3, "SIN(0 10 1k)", ""), marks=pytest.mark.thorough),
        pytest.param((1e-6, "SIN(0 10 1k)", "1n"), marks=pytest.mark.thorough),
    ],
)
def test_stiff_rectifier_agrees_with_radau(case):
    r, source, capacity = case
    text = rectifier(r, source, capacity)
    circuit, ts = Circuit(text), np.linspace(0.0, 1.2e-3, 25)
    mine = np.asarray(circuit.solve(ts[-1], ts).xs)
    L, C, g = 1e-5, 1e-6, 1e-6
    other = float(capacity.replace("n", "e-9").replace("p", "e-12")) if capacity else None

    def through(v):
        """The current of the diode at a voltage across it and its resistance."""
        return v / r if v > 0 else v / (r + 1 / g)

    def rate(t, x):
        source_v = 10 * np.sin(2e3 * np.pi * t)
        if other is None:
            c, i = x
            # The node before the inductor: its current is that of the diode.
            b = source_v - (i * r if i > 0 else i * (r + 1 / g))
            return [(i - c / 10) / C, (b - c) / L]
        b, c, i = x
        return [(through(source_v - b) - i - b / 1e3) / other, (i - c / 10) / C, (b - c) / L]

    found = scipy.integrate.solve_ivp(
        rate,
        (0.0, ts[-1]),
        np.zeros(mine.shape[1]),
        "Radau",
        ts,
        rtol=1e-9,
        atol=1e-11,
        max_step=2e-5,
    )
    order = ["C9", "C1", "L1"] if other else ["C1", "L1"]
    columns = [order.index(name) for name in circuit.states]
    np.testing.assert_allclose(mine, found.y.T[:, columns], atol=2e-6)


@pytest.mark.slow
def test_stiff_bridge_and_clipper_of_almost_ideal_diodes():
    bridge = """
    V1 a 0 SIN(0 10 1k)
    D1 a p
    D2 0 p
    D3 n a
    D4 n 0
    C1 p n 1u
    R1 p n 100
    """
    ends = {}
    for r in (1e-2, 1e-6):
        circuit = Circuit(bridge, r_on=r, g_leak=1e-9)
        ts = np.linspace(0.0, 2e-3, 81)
        sol = circuit.solve(ts[-1], ts)
        ends[r] = np.asarray(sol.xs)[:, 0]
        assert work(sol) <= 60 * (int(sol.stats["switchings"]) + 2 + len(ts))
    # The load follows |v| up, and falls with RC until the next half wave meets it.
    v, w = np.abs(10 * np.sin(2e3 * np.pi * ts)), 2e3 * np.pi
    top = (np.pi - np.arctan(w * 1e-4)) / w  # there the current ends
    falls = 10 * np.sin(w * top) * np.exp(-(ts - top) / 1e-4)
    ideal = np.where(ts <= top, v, np.maximum(v, falls))
    first = ts < 0.75e-3
    np.testing.assert_allclose(ends[1e-6][first], ideal[first], atol=1e-4)
    assert np.abs(ends[1e-2] - ends[1e-6]).max() < 0.05

    clipper = "V1 a 0 SIN(0 10 1k)\nR1 a b 1k\nC1 b 0 1p\nD1 b 0 R=1u G=1n\nD2 0 b R=1u G=1n\n"
    sol = Circuit(clipper).solve(2e-3, ts)
    drive = 1e-2 * np.sin(2e3 * np.pi * ts)
    np.testing.assert_allclose(np.asarray(sol.xs)[1:, 0], 1e-6 * drive[1:], atol=1e-9)
    assert work(sol) <= 60 * (int(sol.stats["switchings"]) + 2)


def stiffened(seed):
    """A random circuit, with diodes of 10 mΩ to 1 Ω."""
    rng = np.random.default_rng(seed)
    words = [
        word if not word.startswith("R=") else f"R={10 ** rng.uniform(-2, 0):.6f}"
        for word in random_netlist(rng, island=False).split(" ")
    ]
    return " ".join(words)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", spread(range(60), 15))
def test_stiff_random_circuits_agree_with_an_independent_analysis(seed):
    text = stiffened(seed)
    sources = [line for line in text.splitlines() if line[0] in "VI"]
    plain = tableau(text)
    circuit = Circuit(text)
    ts = np.linspace(0.0, 2.0, 9)
    sol = circuit.solve(ts[-1], ts)
    s = np.array([float(line.split()[3]) for line in sorted(sources, key=lambda v: v[0] != "V")])
    m = len(plain.D)

    def rate(t, x):
        q = plain.C @ x + plain.e @ s
        y = affine_box_vi(plain.D, q, np.zeros(m), np.full(m, np.inf))
        return plain.A @ x + plain.B @ y + plain.b @ s

    found = scipy.integrate.solve_ivp(
        rate, (0.0, 2.0), np.zeros(len(plain.A)), "LSODA", ts, rtol=1e-9, atol=1e-11, max_step=0.02
    )
    np.testing.assert_allclose(
        np.asarray(sol.xs), found.y.T, atol=2e-6 * (1 + np.abs(found.y).max())
    )


@pytest.mark.parametrize("seed", [27, pytest.param(40, marks=pytest.mark.thorough)])
def test_stiff_run_saves_a_last_time_within_rounding_of_the_last_step(seed):
    ts = np.linspace(0.0, 2.0, 9)
    sol = Circuit(stiffened(seed)).solve(ts[-1], ts)
    np.testing.assert_array_equal(sol.ts, ts)


def drawn(rng, mild=False):
    """A circuit of one of five kinds, with strays and snubbers or without: its netlist, source and end,
    and the knots of the source. `mild` ones are within reach of a general method."""
    ten = lambda low, high: 10 ** rng.uniform(np.log10(low), np.log10(high))  # noqa: E731
    kind = rng.choice(["half wave", "bridge", "clamp", "doubler", "clipper"])
    frequency, volts = ten(100, 1e5) if mild else ten(10, 1e6), ten(0.1, 1e3)
    T = 1 / frequency
    if rng.random() < 0.5:
        offset = rng.choice([0.0, 0.3 * volts])
        source, events = f"SIN({offset:g} {volts:g} {frequency:g})", 3
    else:
        low = -volts * rng.random()
        edge = 0.02 * T if mild else 1e-9
        source = f"PULSE({low:g} {volts:g} {0.1 * T:g} {edge:g} {edge:g} {0.4 * T:g} {T:g})"
        events = 12
    r, leak = (ten(1e-3, 1), ten(1e-5, 1e-3)) if mild else (ten(1e-6, 1), ten(1e-9, 1e-3))
    L, R = ten(1e-6, 1e-2), ten(1, 1e3 if mild else 1e5)
    C = ten(1e-8 if mild else 1e-11, 1e-5)
    stray, snubbed = (0, True) if mild else (int(rng.integers(4)), rng.random() < 0.5)

    def diode(k, a, b):
        line = f"D{k} {a} {{}} R={r:g} G={leak:g}\n"
        if stray & 2 and k == 1:
            return line.format("d") + f"L{k}9 d {b} {ten(1e-9, 1e-7):g}\n"
        return line.format(b)

    beside = f"C9 {{0}} 0 {ten(1e-12, 1e-9):g}\n" if stray & 1 else ""
    beside += "R9 {0} 0 1000\n" if snubbed else "R9 {0} 0 100000\n"
    text = f"V1 a 0 {source}\n"
    if kind == "half wave":
        text += (
            diode(1, "a", "b") + beside.format("b") + f"L1 b c {L:g}\nR1 c 0 {R:g}\nC1 c 0 {C:g}\n"
        )
    elif kind == "bridge":
        text = (
            f"V1 s 0 {source}\nR0 s a {ten(1e-3, 10):g}\n" + diode(1, "a", "p") + diode(2, "0", "p")
        )
        text += diode(3, "n", "a") + diode(4, "n", "0") + beside.format("a")
        text += f"C1 p n {C:g}\nR1 p n {R:g}\n"
    elif kind == "clamp":
        text += f"C1 a b {C:g}\n" + diode(1, "0", "b") + f"R1 b 0 {R:g}\n"
    elif kind == "doubler":
        text += f"R0 a e {ten(1e-2, 10):g}\nC1 e b {C:g}\n" + diode(1, "0", "b")
        text += diode(2, "b", "c") + f"C2 c 0 {C:g}\nR1 c 0 {R:g}\n"
    else:
        text += f"R1 a b {R:g}\n" + diode(1, "b", "0") + diode(2, "0", "b") + beside.format("b")
        text += f"L1 b c {L:g}\nR2 c 0 {R:g}\n"
    return text, source, 3 * T, events


@pytest.mark.slow
@pytest.mark.parametrize("seed", mostly_thorough([0, 3, *spread(range(5, 300), 40)], [0, 3]))
def test_circuits_of_any_kind_and_scale_succeed_at_the_defaults(seed):
    text, _, end, events = drawn(np.random.default_rng(seed))
    circuit, ts = Circuit(text), np.linspace(0.0, end, 21)
    sol = circuit.solve(end, ts)
    assert work(sol) <= 60 * (int(sol.stats["switchings"]) + events + len(ts)), sol.stats
    # The law holds within what voltages of this size leave of a current through so little.
    size = 1e-8 * (1 + np.abs(np.asarray(sol.xs)).max() + np.abs(np.asarray(sol.us)).max())
    assert np.abs(np.asarray(sol.law_step)).max() <= size


# Not number 153: its reference, the exact solution, had not ended after eight minutes.
@pytest.mark.slow
@pytest.mark.parametrize(
    "seed", mostly_thorough([25, *spread([s for s in (2, *range(26, 200)) if s != 153], 30)], [25])
)
def test_circuits_of_any_kind_and_scale_agree_with_hundred_digit_arithmetic(seed):
    text, source, end, _ = drawn(np.random.default_rng(seed))
    ts = np.linspace(0.0, end, 21)
    try:
        exact = solve_exactly(text, source, ts)
    except TooManySamples as found:
        pytest.skip(str(found))
    circuit = Circuit(text)
    sol = circuit.solve(end, ts)
    xs, us = np.asarray(sol.xs), np.asarray(sol.us)
    # The default tolerances, of each state.
    assert np.all(np.abs(xs - exact.xs) <= 1e-8 * np.abs(exact.xs).max(axis=0) + 1e-9)
    ys = np.where(circuit.blocking, exact.blocked, exact.currents)
    size = 1.0 + np.abs(exact.xs).max() + np.abs(ys).max()
    np.testing.assert_allclose(us, ys, rtol=0, atol=1e-8 * size)


_MOST_EVALUATIONS = 300_000
"""Of the law, for the reference: some take hours."""


@pytest.mark.thorough
@pytest.mark.parametrize("seed", spread(range(1, 60), 15))
def test_circuits_of_any_kind_agree_with_radau_on_an_independent_analysis(seed):
    text, source, end, _ = drawn(np.random.default_rng(1000 + seed), mild=True)
    circuit, ts = Circuit(text), np.linspace(0.0, end, 13)
    mine = np.asarray(circuit.solve(end, ts).xs)
    plain = tableau(text.replace(source, "1"))
    name, *numbers = source.replace("(", " ").replace(")", " ").split()
    numbers = [float(v) for v in numbers]
    if name == "SIN":
        drive = lambda t: numbers[0] + numbers[1] * np.sin(2 * np.pi * numbers[2] * t)  # noqa: E731
        knots = [0.0, end]
    else:
        low, high, delay, rise, fall, width, period = numbers
        corners = np.array([0.0, rise, rise + width, rise + width + fall])
        times = np.concatenate([delay + k * period + corners for k in range(4)])
        levels = np.tile([low, high, high, low], 4)
        drive = lambda t: np.interp(t, times, levels)  # noqa: E731
        knots = [0.0, *times[times < end], end]
    D, m = plain.D, len(plain.D)

    def law(t, x):
        q = plain.C @ x + plain.e[:, 0] * drive(t)
        return affine_box_vi(D, q, np.zeros(m), np.full(m, np.inf))

    evaluations = itertools.count()

    def rate(t, x):
        if next(evaluations) > _MOST_EVALUATIONS:
            pytest.skip(f"the reference needs more than {_MOST_EVALUATIONS} evaluations")
        return plain.A @ x + plain.B @ law(t, x) + plain.b[:, 0] * drive(t)

    def jacobian(t, x):
        on = law(t, x) > 0
        return plain.A - plain.B[:, on] @ np.linalg.solve(D[np.ix_(on, on)], plain.C[on])

    # Pieces end at every saved time, too: where a transient lies within a step, the dense output of
    # Radau is off by a percent.
    x, rows = np.zeros(len(plain.A)), {0.0: np.zeros(len(plain.A))}
    apart = [t for t in knots if np.min(np.abs(ts - t)) > 1e-12 * end]
    for a, b in itertools.pairwise(np.union1d(apart, ts)):
        with np.errstate(divide="ignore"):  # SciPy divides by a last step of length 0
            part = scipy.integrate.solve_ivp(
                rate, (a, b), x, "Radau", [b], rtol=1e-7, atol=1e-9, jac=jacobian,
                max_step=(b - a) / 8,
            )  # fmt: skip
        assert part.success
        rows[b] = x = part.y[:, -1]
    found = np.array([rows[t] for t in ts])
    np.testing.assert_allclose(mine, found, atol=3e-5 * np.abs(found).max(axis=0).max())


def test_pulse_source_agrees_with_spice():
    pulse = read_waveform(["PULSE(1 5 10u 2u 4u 20u 100u)"], "voltage", "here")
    times = 1e-6 * np.array([0, 10, 11, 12, 20, 32, 34, 36, 60, 110, 111, 1e3 + 11, 1e3 + 33])
    values = [1, 1, 3, 5, 5, 5, 3, 1, 1, 1, 3, 3, 4]
    np.testing.assert_allclose([float(pulse(t)) for t in times], values, rtol=1e-9)
    np.testing.assert_allclose(
        pulse.knots()[:5], 1e-6 * np.array([10, 12, 32, 36, 110]), rtol=1e-12
    )
    step = read_waveform(["PULSE(0 2 1m)"], "current", "here")
    assert [float(step(t)) for t in (0.9e-3, 1e-3, 5.0)] == [0.0, 2.0, 2.0]
    assert step.knots().tolist() == [1e-3] and step.span()[1] == np.inf
    assert np.isnan(float(pulse(pulse.span()[1] * 1.01)))
    for text, said in (
        ("PULSE(0)", "a low and a high value"), ("PULSE(0 1 -1)", "the delay is not negative"),
        ("PULSE(0 1 0 1u 1u 5u 6u)", "over when the next one begins"),
        ("PULSE(0 1 0 0 0 0 0)", "the period is positive"), ("PULSE(0 1 5V)", "unit of voltage"),
    ):  # fmt: skip
        with pytest.raises(dvax.InputError, match=said):
            read_waveform([text], "voltage", "here")
