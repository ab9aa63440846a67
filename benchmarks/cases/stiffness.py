"""The cost of very small resistance and viscosity, and of a market week for any start hour."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

import dvax
from dvax.formats import read_rts
from dvax.models import Circuit
from dvax.models.frame import Accelerogram, Frame
from dvax.models.market import Market

from ..clock import in_turn, timed
from ..netlists import multiplier, three_phases
from ..section import Section, Table, compare


def run(full: bool) -> Section:
    section = Section(
        title="Stiffness: diodes of 1 µΩ, strays, frames of almost no viscosity, weeks of a market",
        fair=(
            "The same circuit, frame or week at the defaults, with the small number and with a mild "
            "one: a cost that grows with the number of events, and not with the stiffness, has a ratio "
            "near 1. No peer: what other tools need for the mild case is in the case `applications`."
        ),
    )
    events = Table("events", ("case", "switchings", "steps", "refused"), [])
    rounds = 7 if full else 3
    for name, small, mild in [*_circuits(), *_frames(), *(_weeks(section) if full else [])]:
        found = {"small": small(), "mild": mild()}
        taken = in_turn(
            {key: timed(call) for key, call in (("small", small), ("mild", mild))}, rounds
        )
        section.comparisons.append(
            compare(name, "the mild one", taken["small"], taken["mild"], target=("≤", 3.0))
        )
        for key, sol in found.items():
            stats = [str(int(sol.stats.get(k, 0))) for k in ("switchings", "steps", "rejected")]
            events.rows.append((f"{name}: {key}", *stats))
    section.tables.append(events)
    return section


Pair = tuple[str, Callable[[], dvax.Solution], Callable[[], dvax.Solution]]


def _circuits() -> list[Pair]:
    def half_wave(r: float, strays: bool) -> str:
        near = "D1 a d R={r} G=1u\nL9 d b 1n\nR8 b 0 1k\nC9 b 0 1p\nR9 b 0 1k" if strays else (
            "D1 a b R={r} G=1u"
        )  # fmt: skip
        return f"V1 a 0 SIN(0 10 1k)\n{near.format(r=r)}\nL1 b c 10u\nR1 c 0 10\nC1 c 0 1u\n"

    ladder = lambda r: multiplier(4, r, 1e-7, 1e4, 325.0, 1e6, 1e-6, 10.0)  # noqa: E731
    bridge = lambda r: three_phases(r, 50.0, 1e-6, 1e-9, 1e-3, 10.0)  # noqa: E731

    def call(text: str, end: float) -> Callable[[], dvax.Solution]:
        circuit = Circuit(text)
        return lambda: circuit.solve(end, np.linspace(0.0, end, 41))

    kinds: list[tuple[str, Callable[[float], str], float]] = [
        ("half wave", lambda r: half_wave(r, False), 2e-3),
        ("half wave, strays of 1 pF and 1 nH", lambda r: half_wave(r, True), 2e-3),
        ("multiplier of four stages", ladder, 5e-4),
        ("three phases, strays of 1 nF and 1 µH", bridge, 0.06),
    ]
    return [
        (f"{name}: 1 µΩ beside 0.1 Ω", call(text(1e-6), end), call(text(0.1), end))
        for name, text, end in kinds
    ]


def _frames() -> list[Pair]:
    t = 0.02 * np.arange(500)
    record = Accelerogram(0.02, 0.4 * np.sin(9.0 * t) * np.sin(0.31 * t) + 0.1 * np.sin(23.0 * t))

    def call(ratio: float) -> Callable[[], dvax.Solution]:
        frame = Frame(record=record, period=0.6, damping=0.03, yield_displacement=0.4,
                      viscosity_ratio=ratio)  # fmt: skip
        return lambda: frame.solve(ts=record.knots())

    return [
        (f"frame, η/k = {ratio:g} beside 1e-2", call(ratio), call(1e-2)) for ratio in (1e-5, 1e-8)
    ]


def _weeks(section: Section) -> list[Pair]:
    folder = os.environ.get("DVAX_RTS", "")
    if not folder:
        section.notes.append(
            "DVAX_RTS names no folder with RTS-GMLC: weeks of a market are left out."
        )
        return []
    data = read_rts(Path(folder))

    def windy(market: Market, start: int) -> Market:
        rng, times = np.random.default_rng(start), start + np.arange(167 * 12 + 1) / 12.0
        capacity: Any = market.capacity  # read_rts makes a table
        hourly = np.asarray(capacity.values)
        finer = np.stack([np.interp(times, capacity.times, row) for row in hourly.T], axis=1)
        moves = np.ptp(finer, axis=0) > 0
        noise = 1.0 + 0.05 * rng.standard_normal((len(times), int(moves.sum())))
        finer[:, moves] = np.maximum(0.0, finer[:, moves] * noise)
        return eqx.tree_at(lambda m: m.capacity, market, dvax.signals.Table(times, finer))

    first = Market.from_rts(data, 0, 168)
    pairs = [
        (
            f"week from hour {start} beside that from 0",
            Market.from_rts(data, start, 168).run,
            first.run,
        )
        for start in (4000, 8568)
    ]
    return [
        *pairs,
        ("wind of every 5 minutes beside that of every hour", windy(first, 0).run, first.run),
    ]
