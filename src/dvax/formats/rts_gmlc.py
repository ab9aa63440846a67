"""The RTS-GMLC test system: who can make how much electricity at what cost, and who wants it."""

import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import InputError, InputProblem
from .hourly import MAX_PROBLEMS, Hourly, Rows, no_files, number, read_hourly, read_rows, same_hours

LEAST_SLOPE = 1e-3
"""$/MWh per MW: the slope of a cost curve that is flat, as those of wind, sun and nuclear power are. It
is the modulus γ of the law, whose solution would not be unique without it."""

_FILES = {
    "units": ("gen.csv", "RTS_Data/SourceData/gen.csv"),
    "load": (
        "DAY_AHEAD_regional_Load.csv",
        "RTS_Data/timeseries_data_files/Load/DAY_AHEAD_regional_Load.csv",
    ),
    "wind": ("DAY_AHEAD_wind.csv", "RTS_Data/timeseries_data_files/WIND/DAY_AHEAD_wind.csv"),
    "sun": ("DAY_AHEAD_pv.csv", "RTS_Data/timeseries_data_files/PV/DAY_AHEAD_pv.csv"),
}
_COLUMNS = (
    "GEN UID", "Bus ID", "Unit Type", "PMax MW", "Fuel Price $/MMBTU", "HR_incr_1", "HR_incr_3",
)  # fmt: skip
_THERMAL = ("CT", "CC", "STEAM", "NUCLEAR")
# Synchronous condensers make no power; water, heat stores and batteries have a budget of energy, which
# no law of one hour knows; panels on roofs are behind the meter, inside the load.
_OTHERS = ("SYNC_COND", "HYDRO", "ROR", "CSP", "STORAGE", "RTPV")
_TOO_MUCH = 1.1
"""Times its rating, beyond which what a unit has available is taken for another unit of measure."""


class RTS(NamedTuple):
    """The day-ahead data of RTS-GMLC, units in MW, $ and hours.

    - `names` of the n units; `area`, the number of each one's area, the first digit of its bus;
    - `cost` c and `slope` a of the marginal costs cᵢ + aᵢuᵢ, in $/MWh and $/MWh per MW;
    - `capacity`: what each can make, a row an hour; `load`, MW by hour; `start`, the first hour.
    """

    names: tuple[str, ...]
    area: np.ndarray
    cost: np.ndarray
    slope: np.ndarray
    capacity: np.ndarray
    load: np.ndarray
    start: datetime.datetime


def read_rts(folder: str | Path) -> RTS:
    """The market of the RTS-GMLC data in a folder: the four files gen.csv, DAY_AHEAD_regional_Load.csv,
    DAY_AHEAD_wind.csv and DAY_AHEAD_pv.csv, or a checkout of the whole repository.

    The thermal units (CT, CC, STEAM, NUCLEAR) have their PMax at all hours and the marginal cost of
    their heat-rate curve, HR_incr in BTU/kWh and fuel in $/MMBTU:

        c = HR_incr_1 · fuel / 1000,    a = max(10⁻³, (HR_incr_3 − HR_incr_1) · fuel / 1000 / PMax).

    Wind and photovoltaic units cost nothing (c = 0, a = 10⁻³) and have what the hour brings. Hydro,
    CSP, storage and rooftop units are left out: their hours hang together, or are in the load.

    **Raises:** `dvax.InputError` with file, line, what is wrong and its mend, everything at once (up to
    20 flaws a file): files or columns that are missing, cells that are no numbers or negative, unknown
    types of units, series of unknown units, units without a series, areas without a load, gaps in
    time, files for different hours, falling heat rates, and values that only another unit of measure
    explains.

    Source: Barrows et al. 2020, IEEE Trans. Power Syst. 35, 119–127; github.com/GridMod/RTS-GMLC.
    """
    folder = Path(folder)
    paths = {name: _place(folder, places) for name, places in _FILES.items()}
    missing = no_files(list(paths.values()))
    if missing is not None:
        raise missing
    problems: list[InputProblem] = []
    rows = read_rows(paths["units"], _COLUMNS, problems)
    thermal, rated = _units(rows, problems) if rows is not None else ({}, {})
    hourly = {name: read_hourly(paths[name], problems) for name in ("load", "wind", "sun")}
    tables = [table for table in hourly.values() if table is not None]
    if len(tables) == 3:
        same_hours(tables, problems)
    for name, kind in (("wind", "WIND"), ("sun", "PV")):
        table = hourly[name]
        if table is not None and rows is not None:
            _series(table, rows.file, kind, rated, problems)
    load, wind, sun = hourly["load"], hourly["wind"], hourly["sun"]
    if load is not None and rows is not None:
        _loads(load, rows.file, thermal, rated, problems)
    if problems or load is None or wind is None or sun is None:
        raise InputError(*problems)
    return _together(thermal, rated, load, wind, sun)


class _Unit(NamedTuple):
    line: int
    area: str
    kind: str
    capacity: float
    cost: float
    slope: float


def _place(folder: Path, places: tuple[str, ...]) -> Path:
    """Where a file lies: in the folder itself, or where the repository has it."""
    return next((folder / name for name in places if (folder / name).is_file()), folder / places[0])


def _units(table: Rows, problems: list[InputProblem]) -> tuple[dict[str, _Unit], dict[str, _Unit]]:
    """The thermal units, and those whose capacity is measured, by name."""
    found: list[InputProblem] = []
    thermal: dict[str, _Unit] = {}
    rated: dict[str, _Unit] = {}
    uid, bus, kind = (table.column(name) for name in _COLUMNS[:3])
    for line, cells in table.rows:
        name, place = cells[uid].strip(), f"{table.file}, line {line}"
        if name in thermal or name in rated:
            found.append(InputProblem(place, name, "a unit is listed once", "Rename or remove it"))
        what = cells[kind].strip()
        if what in _OTHERS:
            continue
        if what not in (*_THERMAL, "WIND", "PV"):
            kinds = ", ".join((*_THERMAL, "WIND", "PV", *_OTHERS))
            found.append(
                InputProblem(f"{place}, column 'Unit Type'", repr(what), f"it must be one of {kinds}",
                             "Mend the type")
            )  # fmt: skip
            continue
        columns = _COLUMNS[3:] if what in _THERMAL else _COLUMNS[3:4]
        values = [number(table.file, line, c, cells[table.column(c)], found) for c in columns]
        area = cells[bus].strip()
        if not (len(area) == 3 and area.isdigit()):
            found.append(
                InputProblem(f"{place}, column 'Bus ID'", repr(area),
                             "it must be a bus of three digits, the first of which is its area",
                             "Mend the number")
            )  # fmt: skip
        unit = _Unit(line, area[:1], what, *_curve(place, values, found))
        (thermal if what in _THERMAL else rated)[name] = unit
    problems += found[:MAX_PROBLEMS]
    return thermal, rated


def _curve(
    place: str, values: list[float], problems: list[InputProblem]
) -> tuple[float, float, float]:
    """Capacity, c and a of a unit."""
    capacity = values[0]
    if len(values) == 1:
        return capacity, 0.0, LEAST_SLOPE
    _, fuel, first, last = values
    if capacity == 0:
        problems.append(
            InputProblem(f"{place}, column 'PMax MW'", "0", "a unit that burns fuel has a capacity",
                         "Mend it, or remove the unit")
        )  # fmt: skip
        return np.nan, np.nan, np.nan
    if last < first:
        problems.append(
            InputProblem(f"{place}, columns 'HR_incr_1' and 'HR_incr_3'", f"{first:g} and {last:g}",
                         "incremental heat rates must not fall, or costs are not convex and the "
                         "hour has no equilibrium of this kind", "Mend the heat rates")
        )  # fmt: skip
    slope = (last - first) * fuel / 1000 / capacity
    return capacity, first * fuel / 1000, max(LEAST_SLOPE, slope)


def _series(
    table: Hourly, units: str, kind: str, rated: dict[str, _Unit], problems: list[InputProblem]
) -> None:
    """A column for each unit of a kind and no other, and none above its rating."""
    of_kind = {name: unit for name, unit in rated.items() if unit.kind == kind}
    for name in table.names:
        if name not in of_kind:
            problems.append(
                InputProblem(f"{table.file}, line 1", f"a column {name!r}",
                             f"it must name a unit of the type {kind} in {units}",
                             "Mend the name, or add the unit")
            )  # fmt: skip
    for name, unit in of_kind.items():
        if name not in table.names:
            problems.append(
                InputProblem(f"{units}, line {unit.line}", name,
                             f"what it has available by hour must be a column of {table.file}",
                             "Add the column, or remove the unit")
            )  # fmt: skip
            continue
        values = table.values[:, table.names.index(name)]
        k = int(np.argmax(values))
        if values[k] > _TOO_MUCH * unit.capacity:
            problems.append(
                InputProblem(f"{table.file}, line {table.lines[k]}, column {name!r}",
                             f"{values[k]:g} MW of a unit of {unit.capacity:g} MW",
                             f"nothing makes more than its PMax ({units}, line {unit.line}): mixed "
                             "units of measure", "Convert kW to MW")
            )  # fmt: skip


def _loads(
    table: Hourly, units: str, thermal: dict[str, _Unit], rated: dict[str, _Unit],
    problems: list[InputProblem],
) -> None:  # fmt: skip
    """A column for each area with units, and a load of the size of the units."""
    everybody = {**thermal, **rated}
    for area in sorted({unit.area for unit in everybody.values()} - set(table.names)):
        unit = next(unit for unit in everybody.values() if unit.area == area)
        problems.append(
            InputProblem(f"{units}, line {unit.line}, column 'Bus ID'", f"area {area}",
                         f"areas are those of {table.file}: {', '.join(table.names)}",
                         "Mend the bus, or add the area's load")
        )  # fmt: skip
    installed = sum(unit.capacity for unit in everybody.values())
    most = table.values.sum(axis=1).max()
    if np.isfinite(installed) and not installed / 100 < most < 100 * installed:
        problems.append(
            InputProblem(table.file, f"a greatest load of {most:g} MW",
                         f"{units} has {installed:g} MW: mixed units of measure",
                         "Convert both to MW")
        )  # fmt: skip


def _together(
    thermal: dict[str, _Unit], rated: dict[str, _Unit], load: Hourly, wind: Hourly, sun: Hourly
) -> RTS:
    names = (*thermal, *wind.names, *sun.names)
    units = [(thermal | rated)[name] for name in names]
    fixed = np.array([unit.capacity for unit in thermal.values()])
    shape = (len(load.values), len(fixed))
    capacity = np.concatenate([np.broadcast_to(fixed, shape), wind.values, sun.values], axis=1)
    return RTS(
        names,
        np.array([int(unit.area) for unit in units]),
        np.array([unit.cost for unit in units]),
        np.array([unit.slope for unit in units]),
        capacity,
        load.values.sum(axis=1),
        load.start,
    )
