"""Voltage multipliers and three-phase bridges: many diodes switch at the same time, and capacitors are
connected by diodes of almost no resistance only."""

import numpy as np
import pytest
from benchmarks.netlists import multiplier, three_phases
from tests.models.exact_circuit import TooManySamples, solve_exactly
from tests.selection import mostly_thorough, spread

from dvax.models.circuit import Circuit


def drawn(seed, most_stages=4):
    """A random circuit of one of the two kinds, of any scale: its netlist, and its end time."""
    rng = np.random.default_rng([7, seed])
    ten = lambda low, high: 10 ** rng.uniform(np.log10(low), np.log10(high))  # noqa: E731
    if seed % 2:
        frequency = rng.choice([50.0, 60.0, 400.0, 1e4])
        text = three_phases(
            ten(1e-6, 1), frequency, ten(1e-7, 1e-3), rng.choice([0.0, ten(1e-12, 1e-8)]),
            ten(1e-5, 1e-1), ten(0.1, 1e3),
        )  # fmt: skip
        return text, "", rng.uniform(0.5, 3.0) / frequency
    frequency, volts = ten(50, 1e5), rng.choice([1.0, 10.0, 325.0, 1e4])
    leaks = [None if most_stages > 2 else 1e-9, ten(1e-9, 1e-5)]
    text = multiplier(
        int(rng.integers(1, most_stages + 1)), ten(1e-6, 1), ten(1e-9, 1e-6), frequency, volts,
        ten(1e4, 1e8), rng.choice(leaks), rng.choice([None, ten(1e-3, 1e2)]),
    )  # fmt: skip
    source = text[: text.index("\n")].split(" ", 3)[3]
    return text, source, rng.uniform(1.0, 12.0) / frequency


@pytest.mark.parametrize(
    "seed",
    # 45: three equal lines and strays, whose ringing is that of a triple eigenvalue but for rounding.
    mostly_thorough([45, *spread(range(240), 41)], [45]),
)
def test_rectifiers_of_any_scale_succeed_at_the_defaults(seed):
    text, _, end = drawn(seed)
    circuit, ts = Circuit(text), np.linspace(0.0, end, 31)
    sol = circuit.solve(end, ts)
    work = int(sol.stats["steps"]) + int(sol.stats["rejected"])
    assert work <= 60 * (int(sol.stats["switchings"]) + len(ts)), sol.stats
    xs = np.asarray(sol.xs)
    fine = np.asarray(circuit.solve(end, ts, rtol=1e-8, atol=1e-11).xs)
    assert np.all(np.abs(xs - fine) <= 1e-7 * np.abs(fine).max(axis=0) + 1e-9)
    size = 1e-8 * (1.0 + np.abs(xs).max() + np.abs(np.asarray(sol.us)).max())
    assert np.abs(np.asarray(sol.law_step)).max() <= size


@pytest.mark.thorough
def test_rectifiers_do_not_depend_on_the_order_of_lines():
    # Ringing rates of a symmetric bridge are near each other; their vectors depended on the order, and
    # the bridge with its filter first took a step for every few periods.
    lines = three_phases(0.1, 50.0, 1e-6, 1e-9, 1e-3, 10.0).splitlines()
    works, ends = [], []
    for turn in (0, 3, 7):
        circuit = Circuit("\n".join(lines[-turn:] + lines[:-turn]) + "\n")
        sol = circuit.solve(0.02)
        works.append(int(sol.stats["steps"]) + int(sol.stats["rejected"]))
        ends.append(dict(zip(circuit.states, np.asarray(sol.xs[-1]).tolist(), strict=True)))
    assert max(works) <= 1.5 * min(works)
    for other in ends[1:]:
        largest = max(map(abs, other.values()))
        assert all(abs(other[name] - v) <= 1e-8 * largest + 1e-9 for name, v in ends[0].items())


@pytest.mark.parametrize("seed", mostly_thorough(spread([0, 4, *range(6, 60, 2)], 10), []))
def test_multipliers_agree_with_hundred_digit_arithmetic(seed):
    text, source, end = drawn(seed, most_stages=2)
    ts = np.linspace(0.0, 0.25 * end, 13)
    try:
        exact = solve_exactly(text, source, ts)
    except TooManySamples as found:
        pytest.skip(str(found))
    xs = np.asarray(Circuit(text).solve(ts[-1], ts).xs)
    assert np.all(np.abs(xs - exact.xs) <= 1e-7 * np.abs(exact.xs).max(axis=0) + 1e-9)
