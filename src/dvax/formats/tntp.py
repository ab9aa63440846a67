"""Readers of the four TNTP files: network, trips, flows, nodes.

The format is that of the TransportationNetworks collection (Bar-Gera, Stabler and others): metadata in
angle brackets, then rows.

<NUMBER OF ZONES> 24
<END OF METADATA>
~  init_node  term_node  capacity ... ;        a line that begins with ~ names the columns
   1          2          25900.2  ... ;        all lines behind it are rows
"""

import os
import re
from collections.abc import Callable
from decimal import Decimal
from difflib import get_close_matches
from typing import Any, NamedTuple, TypeVar

import numpy as np

from .road_network import Network, Trips
from .table import FileProblems, Table, read_text, to_count, to_number

_LINK_NODES = ("init_node", "term_node")
_LINK_NUMBERS = ("capacity", "length", "free_flow_time", "b", "power")
_METADATA = re.compile(r"\s*<([^<>]*)>(.*)")
_END = "END OF METADATA"
T = TypeVar("T")


class Line(NamedTuple):
    """A line of a file with its number from 1."""

    number: int
    text: str


class Flows(NamedTuple):
    """Known flows: `volume` and `cost`, one of each a link, in the order of the network.

    ```python
    >>> import numpy as np
    >>> from dvax.formats import Flows
    >>> flows = Flows(volume=np.array([6.0, 3.0]), cost=np.array([5.2, 5.0]))
    >>> float(flows.volume @ flows.cost)                            # the total travel time
    46.2

    ```
    """

    volume: np.ndarray
    cost: np.ndarray


def read_network(path: str | os.PathLike[str]) -> Network:
    """Read a `_net.tntp` file.

    Its metadata state NUMBER OF ZONES, NUMBER OF NODES, FIRST THRU NODE and NUMBER OF LINKS; its
    columns are found by name: init_node, term_node, capacity, length, free_flow_time, b, power and,
    where there is one, toll. Others are left alone.

    **Raises:** `dvax.InputError` with everything that is wrong, each with file and line: missing
    metadata or columns, counts that disagree, cells that are no numbers, and all that `Network`
    does not allow.

    ```python
    >>> import pathlib, tempfile
    >>> from dvax.formats import read_network
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "road_net.tntp"
    >>> _ = file.write_text('''<NUMBER OF ZONES> 2
    ... <NUMBER OF NODES> 2
    ... <FIRST THRU NODE> 1
    ... <NUMBER OF LINKS> 1
    ... <END OF METADATA>
    ... ~ init_node term_node capacity length free_flow_time b power ;
    ...   1         2         2000     3.5    4.2            0.15 4  ;
    ... ''')
    >>> read_network(file).capacity.tolist()
    [2000.0]

    ```
    """
    lines, problems = read_text(path, "a TNTP file").splitlines(), FileProblems(path)
    metadata = _Metadata(lines, problems)
    zones, nodes = metadata.count("NUMBER OF ZONES"), metadata.count("NUMBER OF NODES")
    first, count = metadata.count("FIRST THRU NODE"), metadata.count("NUMBER OF LINKS")
    header = _header_of(lines, metadata.end)
    if header is None:
        problems(
            None, "no line that names the columns",
            "which number is the capacity is not guessed",
            "Write ~ init_node term_node capacity length free_flow_time b power speed toll "
            "link_type ; above the first row",
        )  # fmt: skip
        raise problems.error()
    rows = _rows_after(lines, metadata.end)
    columns = _read_columns(header, rows, _LINK_NODES, _LINK_NUMBERS, problems, optional="toll")
    if count is not None and count != len(rows):
        problems(
            metadata.line("NUMBER OF LINKS"), f"<NUMBER OF LINKS> {count} and {len(rows)} rows",
            "the file holds as many links as it states", "Complete the rows or fix the number",
        )  # fmt: skip
    if zones is None or nodes is None or first is None or columns is None:
        raise problems.error()
    network = None
    with problems.collect():
        network = Network(zones, nodes, first, name=problems.file, **columns)
    problems.check()
    assert network is not None
    return network


def read_trips(path: str | os.PathLike[str]) -> Trips:
    """Read a `_trips.tntp` file: blocks `Origin k` of entries `destination : trips;`.

    **Raises:** `dvax.InputError` with everything that is wrong, each with file and line: missing
    metadata, a total that is not the sum of the entries (to the digits that it is written with),
    entries that are none, and all that `Trips` does not allow.

    ```python
    >>> import pathlib, tempfile
    >>> from dvax.formats import read_trips
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "road_trips.tntp"
    >>> _ = file.write_text('''<NUMBER OF ZONES> 2
    ... <TOTAL OD FLOW> 900.0
    ... <END OF METADATA>
    ... Origin 1
    ...   1 : 0.0;  2 : 900.0;
    ... ''')
    >>> read_trips(file).flow.tolist()
    [900.0]

    ```
    """
    lines, problems = read_text(path, "a TNTP file").splitlines(), FileProblems(path)
    metadata = _Metadata(lines, problems)
    zones = metadata.count("NUMBER OF ZONES")
    total = metadata.read("TOTAL OD FLOW", to_number, "it is a decimal number")
    entries: list[tuple[int, int, float, int]] = []
    origin: int | None = None
    begun: dict[int, int] = {}
    headless = False
    for number, text in _rows_after(lines, metadata.end):
        if text.lower().startswith("origin"):
            origin = to_count(text[len("origin") :].strip())
            if origin is None:
                problems(number, repr(text[:40]), "a block begins with Origin and a zone", "Fix it")
            elif origin in begun:
                problems(
                    number, f"Origin {origin} once more",
                    f"it stands once: line {begun[origin]} has it", "Join the two blocks",
                )  # fmt: skip
            else:
                begun[origin] = number
            headless = origin is None
            continue
        for entry in filter(None, map(str.strip, text.split(";"))):
            found = _entry(entry)
            if found is None:
                problems(
                    number, repr(entry[:40]), "an entry is destination : trips, in numbers",
                    "Fix it, or put a semicolon between entries",
                )  # fmt: skip
            elif origin is not None:
                entries.append((origin, *found, number))
            elif not headless:
                problems(
                    number, repr(entry[:40]), "an entry stands below the Origin it is for",
                    "Write Origin and a zone above it",
                )  # fmt: skip
                headless = True
    flow = np.array([e[2] for e in entries], np.float64)
    if total is not None:
        written = metadata.values["TOTAL OD FLOW"].text
        exponent = Decimal(written).as_tuple().exponent
        assert isinstance(exponent, int)
        with np.errstate(over="ignore"):
            summed = float(flow.sum())
        # A zero may have any exponent: 0e999.
        if not abs(summed - total) <= 0.5 * 10.0 ** min(exponent, 300) + 1e-9 * abs(total):
            problems(
                metadata.line("TOTAL OD FLOW"), f"{written}, and entries that sum up to {summed:.10g}",
                "the total is the sum, so that a lost block is seen",
                "Complete the entries or fix the total",
            )  # fmt: skip
    if zones is None:
        raise problems.error()
    origins, destinations, lines_of = (
        np.array([e[k] for e in entries], np.int64) for k in (0, 1, 3)
    )
    trips = None
    with problems.collect():
        trips = Trips(zones, origins, destinations, flow, problems.file, lines_of)
    problems.check()
    assert trips is not None
    return trips


def read_flows(path: str | os.PathLike[str], network: Network) -> Flows:
    """Read a `_flow.tntp` file: From, To, Volume and Cost of every link of the network.

    **Raises:** `dvax.InputError` for missing columns, cells that are no numbers, links that the
    network does not have, has twice in the file, or that are missing from it.

    ```python
    >>> import pathlib, tempfile
    >>> from dvax.formats import Network, read_flows
    >>> roads = Network(
    ...     zones=2, nodes=2, first_thru_node=1, init_node=[1, 2], term_node=[2, 1],
    ...     capacity=[9.0, 9.0], length=[1.0, 1.0], free_flow_time=[5.0, 5.0], b=[0.15, 0.15],
    ...     power=[4.0, 4.0],
    ... )
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "roads.tntp"
    >>> _ = file.write_text('''From To Volume Capacity Cost
    ... 1 2 6.0 9.0 5.2
    ... 2 1 3.0 9.0 5.0
    ... ''')
    >>> flows = read_flows(file, roads)
    >>> flows.volume.tolist(), flows.cost.tolist()
    ([6.0, 3.0], [5.2, 5.0])

    ```
    """
    lines, problems = read_text(path, "a TNTP file").splitlines(), FileProblems(path)
    header, rows = _first_row(lines, problems, "From To Volume Cost")
    columns = _read_columns(header, rows, ("from", "to"), ("volume", "cost"), problems)
    if columns is None:
        raise problems.error()
    index = {pair: i for i, pair in enumerate(zip(network.init_node, network.term_node))}
    rows_of = _one_each(
        list(zip(columns["from"], columns["to"])), columns["lines"], index, "link from {} to {}",
        network.name, problems,
    )  # fmt: skip
    problems.check()
    return Flows(columns["volume"][rows_of], columns["cost"][rows_of])


def read_nodes(path: str | os.PathLike[str], network: Network) -> np.ndarray:
    """Read a `_node.tntp` file: the coordinates X and Y of every node, in rows.

    **Raises:** `dvax.InputError` for missing columns, cells that are no numbers, nodes that the
    network does not have, that stand twice, or that are missing.

    ```python
    >>> import pathlib, tempfile
    >>> from dvax.formats import Network, read_nodes
    >>> roads = Network(
    ...     zones=2, nodes=2, first_thru_node=1, init_node=[1, 2], term_node=[2, 1],
    ...     capacity=[9.0, 9.0], length=[1.0, 1.0], free_flow_time=[5.0, 5.0], b=[0.15, 0.15],
    ...     power=[4.0, 4.0],
    ... )
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "roads.tntp"
    >>> _ = file.write_text('''Node X Y ;
    ... 1 0.0 0.0 ;
    ... 2 3.0 4.0 ;
    ... ''')
    >>> read_nodes(file, roads).tolist()
    [[0.0, 0.0], [3.0, 4.0]]

    ```
    """
    lines, problems = read_text(path, "a TNTP file").splitlines(), FileProblems(path)
    header, rows = _first_row(lines, problems, "Node X Y ;")
    columns = _read_columns(header, rows, ("node",), ("x", "y"), problems)
    if columns is None:
        raise problems.error()
    index = {(node,): node - 1 for node in range(1, network.nodes + 1)}
    rows_of = _one_each(
        [(node,) for node in columns["node"]], columns["lines"], index, "node {}", network.name,
        problems,
    )  # fmt: skip
    problems.check()
    return np.stack([columns["x"], columns["y"]], axis=1)[rows_of]


def _header_of(lines: list[str], start: int) -> Line | None:
    """The first comment behind the metadata that names a column."""
    for number, text in enumerate(lines[start:], start=start + 1):
        names = _column_names(text) if text.lstrip().startswith("~") else []
        if {"init_node", "term_node", "capacity"} & set(names):
            return Line(number, text)
    return None


def _first_row(lines: list[str], problems: FileProblems, example: str) -> tuple[Line, list[Line]]:
    """The header of a file without metadata, which is its first row, with or without a ~."""
    for number, text in enumerate(lines, start=1):
        if text.strip():
            return Line(number, text), _rows_after(lines, number)
    problems(None, "no rows", "the first one names the columns", f"Write {example} there")
    raise problems.error()


def _read_columns(
    header: Line, rows: list[Line], whole: tuple[str, ...], real: tuple[str, ...],
    problems: FileProblems, optional: str = "",
) -> dict[str, Any] | None:  # fmt: skip
    """The columns by name with the `lines` of their rows; None where a column is missing."""
    names = _column_names(header.text)
    cells = [(number, text.rstrip(";").split()) for number, text in rows]
    table = Table(header.number, names, cells, problems)
    if not table.has(*whole, *real):
        return None
    there = (optional,) if optional in names else ()
    columns: dict[str, Any] = dict(table.columns((*real, *there), whole))
    return columns if there or not optional else {**columns, optional: None}


def _entry(text: str) -> tuple[int, float] | None:
    parts = [part.strip() for part in text.split(":")]
    if len(parts) != 2:
        return None
    zone, flow = to_count(parts[0]), to_number(parts[1])
    return None if zone is None or flow is None else (zone, flow)


def _one_each(
    keys: list[tuple], lines: np.ndarray, index: dict[tuple, int], title: str, name: str,
    problems: FileProblems,
) -> np.ndarray:  # fmt: skip
    """The row of each entry of `index`; what is unknown, missing or there twice is reported."""
    rows_of = np.full(len(index), -1)
    for row, (key, line) in enumerate(zip(keys, lines.tolist(), strict=True)):
        what = title.format(*key)
        if key not in index:
            problems(line, f"the {what}", f"{name} has no such one", "Remove the row, or fix it")
        elif rows_of[index[key]] >= 0:
            first = lines[rows_of[index[key]]]
            problems(line, f"the {what} once more", f"line {first} has it", "Remove one of the two")
        else:
            rows_of[index[key]] = row
    for key, i in index.items():
        if rows_of[i] < 0:
            problems(
                None, f"no {title.format(*key)}", f"every one of {name} has a row", "Add the row"
            )
    return rows_of


class _Metadata:
    """The lines `<KEY> value` of a file, and where each stands."""

    def __init__(self, lines: list[str], problems: FileProblems):
        self.problems = problems
        self.values: dict[str, Line] = {}
        self.end = 0
        for number, text in enumerate(lines, start=1):
            match = _METADATA.match(text)
            if match is None:
                if text.strip() and not text.lstrip().startswith("~"):
                    break
                continue
            key = " ".join(match[1].upper().split())
            if key == _END:
                self.end = number
                return
            if key in self.values:
                problems(
                    number, f"<{key}> once more",
                    f"it stands once: line {self.values[key].number} has it already",
                    "Remove one of the two",
                )  # fmt: skip
            self.values[key] = Line(number, match[2].strip())
        problems(
            None, f"no line <{_END}>", "it parts the metadata from the rows",
            f"Write <{_END}> on a line of its own behind the metadata",
        )  # fmt: skip

    def count(self, key: str) -> int | None:
        """A whole number ≥ 0, or None where it is missing or wrong, which is reported."""
        return self.read(key, to_count, "it is a whole number")

    def read(self, key: str, convert: Callable[[str], T | None], rule: str) -> T | None:
        """A value as `convert` reads it, or None where it is missing or wrong, which is reported."""
        found = self._find(key)
        if found is None:
            return None
        value = convert(found.text)
        if value is None:
            self.problems(found.number, f"<{key}> {found.text!r}", rule, "Fix the number")
        return value

    def line(self, key: str) -> int | None:
        return self.values[key].number if key in self.values else None

    def _find(self, key: str) -> Line | None:
        if key not in self.values:
            close = get_close_matches(key, self.values, n=1)
            fix = f"Write <{key}> in the place of <{close[0]}>" if close else f"Add <{key}>"
            self.problems(None, f"no line <{key}>", "the metadata states it", fix)
            return None
        return self.values[key]


def _rows_after(lines: list[str], start: int) -> list[Line]:
    """The lines from `start` on that are neither blank nor comments."""
    kept = []
    for number, text in enumerate(lines[start:], start=start + 1):
        text = text.strip()
        if text and not text.startswith("~"):
            kept.append(Line(number, text))
    return kept


def _column_names(text: str) -> list[str]:
    """The columns that a header line names, in lower case and with _ for blanks, without units."""
    text = re.sub(r"\([^()]*\)", "", text.strip().lstrip("~").replace(";", " "))
    cells = text.split("\t") if "\t" in text.strip() else text.split()
    names = ["_".join(cell.split()).lower() for cell in cells]
    return [name for name in names if name]
