"""Published trajectories of circuits, and switched converters, against ngspice and Siconos."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dvax.models import Circuit

from .. import buck_converter, switching
from ..clock import Sample, in_turn
from ..peers import ngspice
from ..peers.siconos_client import DvaxCircuits, SiconosCircuit, python
from ..section import Section, Table, compare

_FOLDER = "DVAX_SICONOS"
_NO_SOURCE = [(0.0, np.zeros(0))]
_FIRST = 1e-5
"""Errors count from this time (s) on. Capacitors that ideal diodes connect jump at t = 0, and with a
resistance they have a layer there."""
_PERIODS = 10_000


class Published(NamedTuple):
    """A file of the tutorials, and the same circuit for dvax, Siconos and the exact solution.

    `last` is the last row: t (s), the voltage of C1 (V) and the current of L1 (A). The file is the
    result of the θ-method with steps of `step`. `exact` has ideal diodes, `regularised` those of dvax.
    """

    file: str
    last: tuple[float, float, float]
    step: float
    theta: float
    netlist: str
    node: str
    options: dict[str, float]
    exact: Callable[[np.ndarray], np.ndarray]
    regularised: switching.Modes
    matrices: dict[str, Any]

    @property
    def x0(self) -> list[float]:
        return [10.0] + [0.0] * (len(self.matrices["A"]) - 1)

    @property
    def times(self) -> np.ndarray:
        """The times of the file."""
        return self.step * np.arange(round(self.last[0] / self.step) + 1)

    def own(self, ts: np.ndarray) -> np.ndarray:
        """Return the exact x at `ts` with the diodes of dvax."""
        return switching.follow(self.regularised, np.array(self.x0), _NO_SOURCE, ts)[0]


def _filtered(ts: np.ndarray) -> np.ndarray:
    modes, x0 = switching.ideal_filtered()
    return switching.follow(modes, x0, _NO_SOURCE, ts)[0]


def _tank(ts: np.ndarray) -> np.ndarray:
    return switching.follow(switching.tank(), np.array([10.0, 0.0]), _NO_SOURCE, ts)[0]


_OSCILLATOR = [[0.0, -1e6], [1e2, 0.0]]
PUBLISHED = {
    "CircuitRLCD": Published(
        "CircuitRLCD.ref", (4.99e-3, 2.641438992018123, -1.406577463045633e-2), 1e-5, 0.5,
        switching.TANK, "1", {}, _tank, switching.tank(),
        {"A": _OSCILLATOR, "B": [[-1e6], [0.0]], "C": [[-1.0, 0.0]], "D": [[1e3]]},
    ),
    "DiodeBridge": Published(
        "DiodeBridge.ref", (4.999e-3, 0.7863839107277327, -2.830718054146945e-3), 1e-6, 0.5,
        switching.BRIDGE, "a", {"r_on": 0.1, "g_leak": 1e-7}, switching.ideal_bridge,
        switching.bridge(0.1, 1e-7),
        {
            "A": _OSCILLATOR, "B": [[0.0, 0.0, -1e6, 1e6], [0.0] * 4],
            "C": [[0.0, 0.0], [0.0, 0.0], [-1.0, 0.0], [1.0, 0.0]],
            "D": [[1e-3, 1e-3, -1, 0], [1e-3, 1e-3, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]],
        },
    ),
    "DiodeBridgeCapFilter": Published(
        "DiodeBridgeCapFilter.ref", (4.999e-3, -0.1546391462618688, -4.624407808215309e-3), 1e-6, 1.0,
        switching.FILTERED, "a", {"r_on": 1e-3, "g_leak": 1e-9}, _filtered,
        switching.filtered(1e-3, 1e-9),
        {
            "A": [[0.0, -1e6, 0.0], [1e2, 0.0, 0.0], [0.0, 0.0, -1.0 / 3e-4]],
            "B": [[0.0, 0.0, -1e6, 1e6], [0.0] * 4, [1 / 3e-7, 0.0, 1 / 3e-7, 0.0]],
            "C": [[0.0, 0.0, 1.0], [0.0] * 3, [-1.0, 0.0, 1.0], [1.0, 0.0, 0.0]],
            "D": [[0, -1, 0, 0], [1, 0, 1, -1], [0, -1, 0, 0], [0, 1, 0, 0]],
        },
    ),
}  # fmt: skip
"""The files are those of the folders of the same names in examples/electronics of the repository
siconos/siconos-tutorials at the commit b6c9bfd."""


def run(full: bool) -> Section:
    section = Section(
        title="published_circuits: circuits of the Siconos tutorials, and switched converters",
        fair=(
            "Errors of the first three circuits: the largest in the voltage of C1 from 10 µs on, at "
            "the times of the file or at a thousand accepted times of ngspice, against the circuit "
            "with ideal diodes, solved from switching to switching by matrix exponentials without "
            "code of dvax. Siconos has the matrices, the step and θ of its tutorials, and a tenth "
            "of the step. ngspice has the diodes of dvax (sidiode, two straight lines), its default "
            "step and tolerance, a relative tolerance of 1e-6, and largest steps of 1 µs, 100 ns "
            "and 10 ns. Times: of ngspice what it reports for the transient analysis, to a "
            "millisecond; of Siconos the stepping; of dvax the call, after compilation (the "
            "converter with it), in a process with one BLAS thread, as that of Siconos. dvax solves "
            "to roundoff at any tolerance, so that no row has equal errors unless the resistance of "
            "the diodes is the error; the ratio belongs with both errors. Bounds are those of "
            "dvax.bound_error in √J over the root of the capacity of C1, of the converter by "
            "constants and of the others along the trajectory, for the circuit with r_on and "
            "g_leak. The distance from there to ideal diodes is that of two exact solutions. "
            "BuckConverter: errors of the inductor's current, of dvax against the exact solution "
            "with its leak, of Siconos (equations, step and solver of the tutorial) against that "
            "with half of the leak, since the tutorial has none."
        ),
    )
    rounds = 5 if full else 3
    interpreter = python()
    if interpreter is None:
        section.notes.append("Siconos: no Python here imports siconos.kernel (python3-siconos).")
    if not ngspice.found():
        section.notes.append("ngspice: it is not on the PATH (Debian: ngspice).")
    numbers = Table(
        "Published numbers: the voltage of C1 at the last time of each file",
        ("file", "published", "its error", "dvax", "error of dvax", "of it ideal diodes",
         "bound", "error of that circuit", "bound / error", "MB"),
        [],
    )  # fmt: skip
    evidence = Table(
        "The published files and Siconos: the largest errors of the voltage",
        ("file", "error of the file", "of Siconos at its settings", "of Siconos, a tenth of the step",
         "last row, Siconos against the file"),
        [],
    )  # fmt: skip
    section.tables += [numbers, evidence]
    for name, given in PUBLISHED.items():
        _published(section, numbers, evidence, name, given, rounds, interpreter)
    _feedback(section, rounds, interpreter)
    _periods(section, interpreter)
    return section


def _largest(xs: np.ndarray, exact: np.ndarray, ts: np.ndarray) -> float:
    return float(np.abs(xs - exact)[ts >= _FIRST, 0].max())


def _published(
    section: Section, numbers: Table, evidence: Table, name: str, given: Published, rounds: int,
    interpreter: str | None,
) -> None:  # fmt: skip
    ts = given.times
    exact, own = given.exact(ts), given.own(ts)
    row = [given.file, _error_of_file(section, name, given, ts, exact)]
    with DvaxCircuits() as dvax:
        dvax.load(ts, netlist=given.netlist, along=True, **given.options)
        found = dvax.result()
        xs, bound = found["xs"], found["bound"] / 1e-3
        error, own_error = _largest(xs, exact, ts), float(np.abs(xs - own)[:, 0].max())
        numbers.rows.append((
            given.file, f"{given.last[1]:.12f} V", f"{abs(given.last[1] - exact[-1, 0]):.1e} V",
            f"{xs[-1, 0]:.12f} V", f"{error:.1e} V", f"{_largest(own, exact, ts):.1e} V",
            f"{bound:.1e} V ({found['status']})", f"{own_error:.1e} V", f"{bound / own_error:.2g}",
            f"{found['memory']:.0f}",
        ))  # fmt: skip
        peers = [*_ngspice(given)] if ngspice.found() else []
        for label, sample, off in peers:
            series = in_turn({"dvax": dvax.seconds, "other": sample}, rounds)
            _row(section, name, label, series, error, off)
        if interpreter is not None:
            with SiconosCircuit(interpreter) as siconos:
                row += _siconos(section, name, given, siconos, dvax, exact, error, rounds)
    evidence.rows.append((*row, *["–"] * (len(evidence.header) - len(row))))


def _ngspice(given: Published) -> Iterator[tuple[str, Sample, float]]:
    """Yield settings of ngspice, a sample of each, and its error."""
    netlist = ngspice.translate(
        given.netlist, given.options.get("r_on", 1e3), given.options.get("g_leak", 1e-12)
    )
    output, end = f"v({given.node})", float(given.times[-1])
    for label, longest, reltol in (
        ("default", None, 1e-3), ("tolerance 1e-6", None, 1e-6), ("1 µs", 1e-6, 1e-3),
        ("100 ns", 1e-7, 1e-3), ("10 ns", 1e-8, 1e-3),
    ):  # fmt: skip
        once = ngspice.simulate(netlist, end, output, longest=longest, reltol=reltol)
        k = _few(once.ts)
        off = float(np.abs(once.values[k, 0] - given.exact(once.ts[k])[:, 0]).max())

        def sample(longest: float | None = longest, reltol: float = reltol) -> float:
            return ngspice.simulate(netlist, end, output, longest=longest, reltol=reltol).seconds

        yield f"ngspice, {label}", sample, off


def _siconos(
    section: Section, name: str, given: Published, siconos: SiconosCircuit, dvax: DvaxCircuits,
    exact: np.ndarray, error: float, rounds: int,
) -> list[str]:  # fmt: skip
    """Race with Siconos, and return its two errors and its difference to the published number."""
    ts, errors, apart = given.times, [], np.nan
    matrices = given.matrices | {"x0": given.x0}
    for part in (1, 10):
        steps, h = (len(ts) - 1) * part, given.step / part
        siconos.build(matrices, h, steps, theta=given.theta, keep=True)
        theirs = siconos.trajectory()[part - 1 :: part]
        errors.append(_largest(theirs, exact[1:], ts[1:]))
        if part == 1:
            apart = abs(theirs[-1, 0] - given.last[1])
        siconos.build(matrices, h, steps, theta=given.theta)
        series = in_turn({"dvax": dvax.seconds, "other": lambda: siconos.run()[0]}, rounds)
        label = f"Siconos, θ = {given.theta:g}, {steps} steps"
        _row(section, name, label, series, error, errors[-1])
    return [f"{errors[0]:.1e} V", f"{errors[1]:.1e} V", f"{apart:.1e} V"]


def _row(
    section: Section, case: str, versus: str, series: dict[str, list[float]], error: float,
    error_other: float,
) -> None:  # fmt: skip
    # ngspice reports times as 0 that are below its resolution.
    other = [max(seconds, 1e-3) for seconds in series["other"]]
    section.comparisons.append(
        compare(
            case, versus, series["dvax"], other, direction="other/dvax",
            error=error, error_other=error_other,
        )
    )  # fmt: skip


def _few(ts: np.ndarray) -> np.ndarray:
    """Return the indices of about a thousand of the times, the last one included."""
    later = np.flatnonzero(ts >= _FIRST)
    return np.append(later[: -1 : len(later) // 1000 + 1], len(ts) - 1)


def _thinned(ran: ngspice.Run) -> ngspice.Run:
    k = _few(ran.ts)
    return ran._replace(ts=ran.ts[k], values=ran.values[k])


def _error_of_file(
    section: Section, name: str, given: Published, ts: np.ndarray, exact: np.ndarray
) -> str:
    folder = os.environ.get(_FOLDER)
    if folder is None or not (Path(folder) / given.file).is_file():
        section.notes.append(
            f"{name}: no file, since {_FOLDER} names no folder that has {given.file}; the number in "
            "the table is its last row."
        )
        return "–"
    rows = np.loadtxt(Path(folder) / given.file, skiprows=1)
    if not np.allclose(rows[-1, :3], given.last, rtol=1e-14, atol=0.0):
        section.notes.append(f"{name}: the last row of the file is not that of the table.")
    return f"{_largest(rows[:, 1:2], exact[:, :1], ts):.1e} V"


def _feedback(section: Section, rounds: int, interpreter: str | None) -> None:
    """The buck converter with its comparator, for the 2 µs of the tutorial's own check."""
    end, leak, step = 2e-6, 1e-6, 0.05e-9
    steps, case = round(end / step), "BuckConverter, 2 µs; error of the inductor's current in A"
    ts = step * np.arange(1, steps + 1)[99::100]
    exact, half = (buck_converter.exact(g, ts)[0] for g in (leak, leak / 2))
    change = np.abs(exact - half).max(axis=0)
    with DvaxCircuits() as dvax:
        dvax.load(ts, buck=leak)
        found = dvax.result()
        error = float(np.abs(found["xs"] - exact)[:, 1].max())
        bound = "none: it overflows" if found["bound"] is None else f"{found['bound']:.1e}"
        section.tables.append(Table(
            f"BuckConverter, {end * 1e6:g} µs, with a leak of {leak:g} S at the transistors",
            ("switchings", "inductor's current at the end", "its error",
             "half of the leak changes it by", "bound", "MB"),
            [(f"{found['switchings']}", f"{found['xs'][-1, 1]:.9f} A", f"{error:.1e} A",
              f"{change[1]:.1e} A", bound, f"{found['memory']:.0f}")],
        ))  # fmt: skip
        if interpreter is None:
            return
        with SiconosCircuit(interpreter) as siconos:
            for part in (1, 10):
                h, count = step * part, steps // part
                options = {"theta": 1.0, "solver": "lemke"}
                matrices = buck_converter.complementarity(h, count)
                siconos.build(matrices, h, count, keep=True, **options)
                theirs = siconos.trajectory()[100 // part - 1 :: 100 // part]
                siconos.build(matrices, h, count, **options)
                series = in_turn({"dvax": dvax.seconds, "other": lambda: siconos.run()[0]}, rounds)
                off = float(np.abs(theirs - half)[:, 1].max())
                _row(section, case, f"Siconos, θ = 1, {count} steps", series, error, off)


def _periods(section: Section, interpreter: str | None) -> None:
    """A converter without feedback over many periods, discontinuous after the first ones."""

    ts = 1e-5 * np.arange(1, _PERIODS + 1)
    netlist = ngspice.translate(switching.CONVERTER, 0.1, 1e-6)
    # Without a largest step ngspice 39 ends at the first jump: its step becomes too small.
    labels = {"10 µs": 1e-5, "100 ns": 1e-7, "10 ns": 1e-8} if ngspice.found() else {}
    runs = {
        label: _thinned(ngspice.simulate(netlist, float(ts[-1]), "v(out)", longest=longest))
        for label, longest in labels.items()
    }
    every = np.unique(np.concatenate([ts, *(ran.ts for ran in runs.values())]))
    solved = switching.follow(
        switching.converter(), np.zeros(2), switching.pulses(_PERIODS), every, fewest=50
    )[0][:, 0]
    exact = solved[np.searchsorted(every, ts)]
    with DvaxCircuits() as dvax:
        dvax.load(ts, netlist=switching.CONVERTER)
        found = dvax.result()
    seconds = found["seconds"]
    error = float(np.abs(found["xs"][:, 0] - exact).max())
    bound = found["bound"] / np.sqrt(1e-5)
    section.tables.append(Table(
        "A switched converter of 100 kHz without feedback",
        ("periods", "switchings of diodes alone", "time", "error of the voltage", "bound",
         "bound / error", "MB"),
        [(f"{_PERIODS}", f"{found['switchings']}", f"{seconds:.1f} s", f"{error:.1e} V",
          f"{bound:.1e} V ({found['status']})", f"{bound / error:.2g}", f"{found['memory']:.0f}")],
    ))  # fmt: skip
    case = f"converter, {_PERIODS} periods"
    for label, ran in runs.items():
        off = float(np.abs(ran.values[:, 0] - solved[np.searchsorted(every, ran.ts)]).max())
        series = {"dvax": [seconds], "other": [ran.seconds]}
        _row(section, case, f"ngspice, {label}", series, error, off)
    if interpreter is None:
        return
    few, steps = 200, 100
    circuit = Circuit(switching.CONVERTER)
    names = {"A": "A", "B": "B", "C": "C", "D": "D", "x0": "x0", "F": "e", "inputs": "b"}
    matrices = {key: np.asarray(getattr(circuit, name)).tolist() for key, name in names.items()}
    # The source in the middle of every step, since it jumps at the ends of some.
    phases = (np.arange(few * steps) + 0.5) % steps
    volts = np.where(phases < 0.4 * steps, 12.0, -12.0)[:, None].tolist()
    matrices |= {"rate_values": volts, "law_values": volts}
    with SiconosCircuit(interpreter) as siconos:
        siconos.build(matrices, 1e-5 / steps, few * steps, theta=1.0, keep=True)
        theirs = siconos.trajectory()[steps - 1 :: steps, 0]
        siconos.build(matrices, 1e-5 / steps, few * steps, theta=1.0)
        series = {"dvax": [seconds], "other": [siconos.run()[0] * _PERIODS / few]}
    label = f"Siconos, θ = 1, {steps} steps a period ({few} run, times {_PERIODS // few})"
    _row(section, case, label, series, error, float(np.abs(theirs - exact[:few]).max()))
