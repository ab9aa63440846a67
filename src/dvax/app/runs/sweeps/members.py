"""The members of a sweep: the rows of its parameters.

members = grid × zip × sample × table      (those that the file has; the last one varies fastest)
"""

import csv
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dvax.app.runs.data_file import locate
from dvax.app.runs.keys import flat_keys
from dvax.app.runs.sweeps.parameters import Parameter, drawn, is_range, listed, parameter
from dvax.app.runs.sweeps.schema import SampleSection, SweepFile
from dvax.errors import Problems, input_error

MOST = 10**6
"""The most members of a sweep."""


def parameters(table: SweepFile, source: Path, allow_outside: bool) -> list[Parameter]:
    """Return the parameters of a sweep, each with one value a member.

    **Raises:** `dvax.InputError` with all problems found.
    """
    file, problems = source.name, Problems()
    blocks: list[list[Parameter]] = []
    for name, make in (
        ("grid", lambda: _grid(file, table.grid)),
        ("zip", lambda: _zip(file, table.zip)),
        ("sample", lambda: _sample(file, table.sample)),
        ("table", lambda: _table(file, table, source, allow_outside)),
    ):
        if getattr(table, name):
            with problems.collect():
                blocks.append(make())
    problems.raise_any()
    if not blocks:
        raise input_error(
            file, "no parameters", "a sweep has [grid], [zip], [sample] or [table]",
            'Write [grid] and below it "model.name_of_a_key" = [1.0, 2.0]',
        )  # fmt: skip
    keys = [p.key for block in blocks for p in block]
    for key in dict.fromkeys(keys):
        if keys.count(key) > 1:
            problems.add(
                f"{file}: {key}", "twice", "a key is swept once", "Remove one of its entries"
            )
        for other in keys:
            if other.startswith(f"{key}."):
                problems.add(
                    f"{file}: {key}", f"beside {other}", "one contains the other", "Remove one"
                )
        if key.split(".")[0] == "output":
            problems.add(
                f"{file}: {key}", "a key of [output]", "it does not change the results",
                "Write it into the configuration, or into [output] of the sweep",
            )  # fmt: skip
    problems.raise_any()
    counts = [len(block[0].values) for block in blocks]
    total = int(np.prod(counts, dtype=float))
    if total > MOST:
        raise input_error(
            file, f"{total} members", f"a sweep has at most {MOST}", "Leave out values"
        )
    rows = list(itertools.product(*map(range, counts)))
    return [p.take([row[b] for row in rows]) for b, block in enumerate(blocks) for p in block]


def _grid(file: str, given: Mapping[str, Any]) -> list[Parameter]:
    """Return the parameters of all combinations; the last key varies fastest."""
    axes = _axes(f"{file}: grid", given)
    rows = list(itertools.product(*(range(len(axis.values)) for axis in axes)))
    return [axis.take([row[k] for row in rows]) for k, axis in enumerate(axes)]


def _zip(file: str, given: Mapping[str, Any]) -> list[Parameter]:
    axes = _axes(f"{file}: zip", given)
    counts = {axis.key: len(axis.values) for axis in axes}
    if len(set(counts.values())) > 1:
        raise input_error(
            f"{file}: zip", ", ".join(f"{n} values of {key}" for key, n in counts.items()),
            "these keys advance together, so that they have equally many values",
            "Add or remove values, or write the key into [grid]",
        )  # fmt: skip
    return axes


def _axes(place: str, given: Mapping[str, Any]) -> list[Parameter]:
    problems, axes = Problems(), []
    count = 1
    for key, values in flat_keys(given, is_range).items():
        with problems.collect():
            axes.append(listed(f"{place}.{key}", key, values))
            count *= len(axes[-1].values)
    if count > MOST and place.endswith("grid"):
        problems.add(place, f"{count} members", f"a sweep has at most {MOST}", "Leave out values")
    problems.raise_any()
    return axes


def _sample(file: str, given: SampleSection | None) -> list[Parameter]:
    assert given is not None
    keys = flat_keys(given.between, is_range)
    if not keys:
        raise input_error(
            f"{file}: sample.between", "nothing", "it says what is sampled",
            'Write [sample.between] and below it "model.key" = { low = 1.0, high = 2.0 }',
        )  # fmt: skip
    points = _points(given, len(keys))
    problems, axes = Problems(), []
    for k, (key, where) in enumerate(keys.items()):
        with problems.collect():
            axes.append(drawn(f"{file}: sample.between.{key}", key, where, points[:, k]))
    problems.raise_any()
    return axes


def _points(given: SampleSection, dimensions: int) -> np.ndarray:
    """Return points in the open unit cube, (count, dimensions)."""
    if given.method == "random":
        points = np.random.default_rng(given.seed).random((given.count, dimensions))
    else:
        from scipy.stats import qmc

        if given.method == "sobol":
            # A whole power of two, of which the first points are taken: SciPy warns of other counts.
            power = max(0, int(np.ceil(np.log2(given.count))))
            sequence = qmc.Sobol(dimensions, rng=given.seed)
            points = sequence.random_base2(power)[: given.count]
        else:
            points = qmc.LatinHypercube(dimensions, rng=given.seed).random(given.count)
    # A normal distribution has no value at 0 and 1.
    least = np.finfo(float).tiny
    return np.clip(points, least, 1 - np.finfo(float).epsneg)


def _table(file: str, table: SweepFile, source: Path, allow_outside: bool) -> list[Parameter]:
    assert table.table is not None
    place = f"{file}: table.file"
    path = locate(table.table.file, source.parent, allow_outside, place)
    try:
        with path.open(encoding="utf-8-sig", newline="") as opened:
            rows = [row for row in csv.reader(opened, strict=True) if row]
    except (UnicodeDecodeError, csv.Error) as error:
        raise input_error(
            path.name, str(error)[:120], "it is a CSV file in UTF-8", "Save it as such"
        ) from None
    if len(rows) < 2:
        raise input_error(
            path.name, f"{len(rows)} rows", "it has a header of keys, and a row a member",
            "Write model.key in the first row",
        )  # fmt: skip
    head = [name.strip() for name in rows[0]]
    problems = Problems()
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(head):
            problems.add(
                f"{path.name}, row {number}", f"{len(row)} cells",
                f"every row has the {len(head)} cells of the header", "Fill in the row",
            )  # fmt: skip
    for k, name in enumerate(head):
        if not name or head.index(name) != k:
            problems.add(
                f"{path.name}, column {k + 1}", repr(name), "each column names another key",
                "Correct the header",
            )  # fmt: skip
    problems.raise_any()
    return [
        parameter(f"{path.name}: {key}", key, [_cell(row[k]) for row in rows[1:]])
        for k, key in enumerate(head)
    ]


def _cell(text: str) -> Any:
    """Return a cell as TOML would have it: a whole number, a number, true or false, or a text."""
    text = text.strip()
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text
