"""The RTS-GMLC test system: capacities and costs of the units, and the load."""

import datetime
import itertools
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import InputProblem, Problems
from .table import FileProblems, Table, csv_rows, to_count

LEAST_SLOPE = 1e-3
"""$/MWh per MW: the slope of a cost curve that is flat, as those of wind, sun and nuclear power are. It
is the modulus γ of the law, whose solution would not be unique without it."""

RTS_FILES = {
    "units": ("gen.csv", "RTS_Data/SourceData/gen.csv"),
    "load": (
        "DAY_AHEAD_regional_Load.csv",
        "RTS_Data/timeseries_data_files/Load/DAY_AHEAD_regional_Load.csv",
    ),
    "wind": ("DAY_AHEAD_wind.csv", "RTS_Data/timeseries_data_files/WIND/DAY_AHEAD_wind.csv"),
    "sun": ("DAY_AHEAD_pv.csv", "RTS_Data/timeseries_data_files/PV/DAY_AHEAD_pv.csv"),
}
"""The four files: beside each other, or where the repository has them."""
_COLUMNS = (
    "GEN UID", "Bus ID", "Unit Type", "PMax MW", "Fuel Price $/MMBTU", "HR_incr_1", "HR_incr_3",
)  # fmt: skip
_THERMAL = ("CT", "CC", "STEAM", "NUCLEAR")
# Synchronous condensers make no power; hydro, heat stores and batteries have an energy budget, which
# couples the hours; rooftop panels are behind the meter and part of the load.
_OTHERS = ("SYNC_COND", "HYDRO", "ROR", "CSP", "STORAGE", "RTPV")
_CLOCK = ("Year", "Month", "Day", "Period")
_RATING_MARGIN = 1.1
"""Factor of its rating above which the output of a unit is taken for another unit of measure."""


class RTS(NamedTuple):
    """The day-ahead data of RTS-GMLC, units in MW, $ and hours.

    - `names` of the n units; `area`, the number of each one's area, the first digit of its bus;
    - `cost` c and `slope` a of the marginal costs cᵢ + aᵢuᵢ, in $/MWh and $/MWh per MW;
    - `capacity`: what each can make, a row an hour; `load`, MW by hour; `start`, the first hour.

    ```python
    >>> import datetime
    >>> import numpy as np
    >>> from dvax.formats import RTS
    >>> rts = RTS(
    ...     names=("101_CC_1",), area=np.array([1]), cost=np.array([28.0]), slope=np.array([0.01]),
    ...     capacity=np.full((2, 1), 300.0), load=np.array([120.0, 150.0]),
    ...     start=datetime.datetime(2021, 3, 14),
    ... )
    >>> float(rts.cost[0] + rts.slope[0] * rts.load[1])        # the marginal cost at 150 MW
    29.5

    ```
    """

    names: tuple[str, ...]
    area: np.ndarray
    cost: np.ndarray
    slope: np.ndarray
    capacity: np.ndarray
    load: np.ndarray
    start: datetime.datetime


def read_rts(folder: str | Path) -> RTS:
    """Read the market of the RTS-GMLC data in a folder: the four files gen.csv,
    DAY_AHEAD_regional_Load.csv, DAY_AHEAD_wind.csv and DAY_AHEAD_pv.csv, or a checkout of the whole
    repository.

    The thermal units (CT, CC, STEAM, NUCLEAR) have their PMax at all hours and the marginal cost of
    their heat-rate curve, HR_incr in BTU/kWh and fuel in $/MMBTU:

        c = HR_incr_1 · fuel / 1000,    a = max(10⁻³, (HR_incr_3 − HR_incr_1) · fuel / 1000 / PMax).

    Wind and photovoltaic units cost nothing (c = 0, a = 10⁻³) and have what the hour brings. Hydro,
    CSP, storage and rooftop units are left out: their hours are coupled, or part of the load.

    **Raises:** `dvax.InputError` with file, line, what is wrong and its fix, everything at once (up to
    20 flaws a file): files or columns that are missing, cells that are no numbers or negative, unknown
    types of units, series of unknown units, units without a series, areas without a load, gaps in
    time, files for different hours, falling heat rates, and values that only another unit of measure
    explains.

    Source: Barrows et al. 2020, IEEE Trans. Power Syst. 35, 119–127; github.com/GridMod/RTS-GMLC.

    ```python
    >>> import pathlib, tempfile
    >>> from dvax.formats import read_rts
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> _ = (folder / "gen.csv").write_text('''
    ... GEN UID,Bus ID,Unit Type,Fuel,PMax MW,Fuel Price $/MMBTU,HR_incr_1,HR_incr_2,HR_incr_3
    ... 101_CC_1,101,CC,NG,300,4.0,7000,7200,7500
    ... 102_WIND_1,102,WIND,Wind,150,0,0,0,0
    ... 102_PV_1,102,PV,Solar,80,0,0,0,0
    ... '''.lstrip())
    >>> series = {"regional_Load": "1", "wind": "102_WIND_1", "pv": "102_PV_1"}
    >>> for name, column in series.items():
    ...     rows = [f"2021,3,14,{k},{3 * k}" for k in range(1, 25)]
    ...     _ = (folder / f"DAY_AHEAD_{name}.csv").write_text(
    ...         chr(10).join([f"Year,Month,Day,Period,{column}", *rows])
    ...     )
    >>> rts = read_rts(folder)
    >>> rts.start.date().isoformat(), rts.capacity[0].tolist()
    ('2021-03-14', [300.0, 3.0, 3.0])

    ```
    """
    folder = Path(folder)
    paths = {name: _place(folder, places) for name, places in RTS_FILES.items()}
    problems = Problems()
    for path in paths.values():
        if not path.is_file():
            fix = "Copy it there from RTS-GMLC's RTS_Data"
            rule = "the market is read from four files"
            problems.add(str(path.parent), f"no {path.name}", rule, fix)
    problems.raise_any()
    units: list[_Unit] = []
    hourly: dict[str, Hourly] = {}
    with problems.collect():
        units = _read_units(paths["units"])
    for name in ("load", "wind", "sun"):
        with problems.collect():
            hourly[name] = _read_hourly(paths[name])
    problems.raise_any()
    file = paths["units"].name
    load, wind, sun = hourly["load"], hourly["wind"], hourly["sun"]
    problems += _other_hours(load, wind)
    problems += _other_hours(load, sun)
    problems += _wrong_series(wind, file, "WIND", units)
    problems += _wrong_series(sun, file, "PV", units)
    problems += _wrong_load(load, file, units)
    problems.raise_any()
    return _join(units, load, wind, sun)


class _Unit(NamedTuple):
    """A unit, the line it stands on, and its marginal cost `cost` + `slope` · output."""

    line: int
    name: str
    area: str
    kind: str
    capacity: float
    cost: float
    slope: float


class Hourly(NamedTuple):
    """Numbers by hour: `start`, the first hour; `names` of the columns; `values`, a row an hour;
    `lines` of the file that the rows stand on."""

    file: str
    start: datetime.datetime
    names: list[str]
    values: np.ndarray
    lines: np.ndarray


def _place(folder: Path, places: tuple[str, ...]) -> Path:
    """Where a file lies: in the folder itself, or where the repository has it."""
    return next((folder / name for name in places if (folder / name).is_file()), folder / places[0])


def _read_table(path: Path, wanted: tuple[str, ...]) -> Table:
    """Read the table of a CSV file that has the `wanted` columns. Raises `InputError`."""
    problems = FileProblems(path)
    rows = csv_rows(path, problems)
    if len(rows) < 2:
        rule = "a row of names is followed by rows of data"
        problems(None, f"{len(rows)} rows", rule, "Copy the file again")
        raise problems.error()
    table = Table(*rows[0], rows[1:], problems)
    table.has(*wanted)
    problems.check()
    return table


def _read_units(path: Path) -> list[_Unit]:
    """Read the thermal units and those whose capacity is measured. Raises `InputError`."""
    table = _read_table(path, _COLUMNS)
    problems, units, seen = table.problems, [], set()
    for line, cells in table.rows:
        name, bus, kind, *numbers = (cells[table.names.index(c)] for c in _COLUMNS)
        if name in seen:
            problems(line, name, "a unit is listed once", "Rename or remove it")
        seen.add(name)
        if kind in _OTHERS:
            continue
        if kind not in (*_THERMAL, "WIND", "PV"):
            kinds = ", ".join((*_THERMAL, "WIND", "PV", *_OTHERS))
            problems(line, repr(kind), f"it must be one of {kinds}", "Fix it", "Unit Type")
            continue
        if not (len(bus) == 3 and bus.isascii() and bus.isdigit()):
            rule = "it must be a bus of three digits, the first of which is its area"
            problems(line, repr(bus), rule, "Fix the number", "Bus ID")
        curve = _curve(table, line, numbers if kind in _THERMAL else numbers[:1])
        units.append(_Unit(line, name, bus[:1], kind, *curve))
    problems.check()
    return units


def _curve(table: Table, line: int, cells: list[str]) -> tuple[float, float, float]:
    """Return capacity, c and a of a unit from PMax and, where it burns fuel, its price and heat
    rates."""
    capacity, *rest = (
        table.number(line, c, cell, least=0.0) for c, cell in zip(_COLUMNS[3:], cells, strict=False)
    )
    if not rest:
        return capacity, 0.0, LEAST_SLOPE
    fuel, first, last = rest
    if capacity == 0:
        rule = "a unit that burns fuel has a capacity"
        table.problems(line, "0", rule, "Fix it, or remove the unit", "PMax MW")
        return np.nan, np.nan, np.nan
    if last < first:
        table.problems(
            line, f"HR_incr_1 = {first:g} and HR_incr_3 = {last:g}",
            "incremental heat rates must not fall, or costs are not convex and the hour has no "
            "equilibrium of this kind", "Fix the heat rates",
        )  # fmt: skip
    slope = (last - first) * fuel / 1000 / capacity
    return capacity, first * fuel / 1000, max(LEAST_SLOPE, slope)


def _read_hourly(path: Path) -> Hourly:
    """Read the hours of a file with the columns Year, Month, Day, Period (1 to 24). Raises
    `InputError`."""
    table = _read_table(path, _CLOCK)
    problems = table.problems
    clock = [table.names.index(name) for name in _CLOCK]
    hours: list[datetime.datetime] = []
    for line, cells in table.rows:
        words = [cells[k] for k in clock]
        try:
            year, month, day, period = map(to_count, words)
            if year is None or month is None or day is None or period is None:
                raise ValueError("all four are integers")
            if not 1 <= period <= 24:
                raise ValueError("a day has the periods 1 to 24")
            hours.append(datetime.datetime(year, month, day, period - 1))
        except ValueError as error:
            fix = "Write Year, Month, Day and Period as integers"
            problems(line, "/".join(words), f"it must be an hour: {error}", fix)
    names = [name for name in table.names if name not in _CLOCK]
    columns = table.columns(names, least=0.0)
    problems.check()
    lines = columns["lines"]
    for k, (before, after) in enumerate(itertools.pairwise(hours), start=1):
        if after - before != datetime.timedelta(hours=1):
            problems(
                int(lines[k]),
                f"{after:%Y-%m-%d} period {after.hour + 1} after {before:%Y-%m-%d} period "
                f"{before.hour + 1}",
                "rows are an hour apart: over a gap nothing is known, and a repeated hour is ambiguous",
                "Fill in the missing hours on purpose, or remove the repeated ones",
            )  # fmt: skip
    problems.check()
    values = np.stack([columns[name] for name in names], axis=1)
    return Hourly(path.name, hours[0], names, values, lines)


def _other_hours(first: Hourly, other: Hourly) -> list[InputProblem]:
    """Return a problem where two files do not cover the same hours."""
    if (other.start, len(other.values)) == (first.start, len(first.values)):
        return []
    told = [f"{len(table.values)} from {table.start:%Y-%m-%d %H:%M}" for table in (first, other)]
    return [
        InputProblem(
            other.file, told[1].replace(" from", " hours from"),
            f"it must cover the hours of {first.file}: {told[0]}",
            "Cut the files to the hours that all of them have",
        )
    ]  # fmt: skip


def _wrong_series(table: Hourly, file: str, kind: str, units: list[_Unit]) -> list[InputProblem]:
    """Return the problems of a series: unknown units, units without a column, values above a rating."""
    rated = {unit.name: unit for unit in units if unit.kind == kind}
    problems = Problems()
    for name in table.names:
        if name not in rated:
            rule = f"it must name a unit of the type {kind} in {file}"
            fix = "Fix the name, or add the unit"
            problems.add(f"{table.file}, line 1", f"a column {name!r}", rule, fix)
    for name, unit in rated.items():
        if name not in table.names:
            problems.add(
                f"{file}, line {unit.line}", name,
                f"what it has available by hour must be a column of {table.file}",
                "Add the column, or remove the unit",
            )  # fmt: skip
            continue
        values = table.values[:, table.names.index(name)]
        k = int(np.argmax(values))
        if values[k] > _RATING_MARGIN * unit.capacity:
            problems.add(
                f"{table.file}, line {table.lines[k]}, column {name!r}",
                f"{values[k]:g} MW of a unit of {unit.capacity:g} MW",
                f"nothing makes more than its PMax ({file}, line {unit.line}): mixed "
                "units of measure", "Convert kW to MW",
            )  # fmt: skip
    return problems


def _wrong_load(table: Hourly, file: str, units: list[_Unit]) -> list[InputProblem]:
    """Return the problems of the load: areas without one, and a size that does not match the units."""
    problems = Problems()
    for area in sorted({unit.area for unit in units} - set(table.names)):
        unit = next(unit for unit in units if unit.area == area)
        problems.add(
            f"{file}, line {unit.line}, column 'Bus ID'", f"area {area}",
            f"areas are those of {table.file}: {', '.join(table.names)}",
            "Fix the bus, or add the area's load",
        )  # fmt: skip
    installed = sum(unit.capacity for unit in units)
    most = table.values.sum(axis=1).max()
    if not installed / 100 < most < 100 * installed:
        problems.add(
            table.file, f"a greatest load of {most:g} MW",
            f"{file} has {installed:g} MW: mixed units of measure",
            "Convert both to MW",
        )  # fmt: skip
    return problems


def _join(units: list[_Unit], load: Hourly, wind: Hourly, sun: Hourly) -> RTS:
    """Join all units: the thermal ones in the order of their file, then those of both series."""
    by_name = {unit.name: unit for unit in units}
    thermal = [unit for unit in units if unit.kind in _THERMAL]
    ordered = [*thermal, *(by_name[name] for name in (*wind.names, *sun.names))]
    fixed = np.tile([unit.capacity for unit in thermal], (len(load.values), 1))
    return RTS(
        tuple(unit.name for unit in ordered),
        np.array([int(unit.area) for unit in ordered]),
        np.array([unit.cost for unit in ordered]),
        np.array([unit.slope for unit in ordered]),
        np.concatenate([fixed, wind.values, sun.values], axis=1),
        load.values.sum(axis=1),
        load.start,
    )
