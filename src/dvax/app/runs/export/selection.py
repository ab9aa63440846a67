"""The variables of a run that are exported: complete frames, with names, units and history."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from difflib import get_close_matches
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from dvax.app.plots.run_reader import UNFINISHED, RunRecord, read_run
from dvax.app.plots.store import Variable
from dvax.app.runs.resolved import NAME as CONFIG
from dvax.app.runs.sweeps.records import is_sweep
from dvax.app.runs.sweeps.store import NAME as SWEEP_STORE
from dvax.errors import Problems, input_error

_BLOCK_BYTES = 2**25
"""The most that the rows of a block take, unless a chunk of the store is larger."""
_OF_THE_STORE = ("coordinates", "variable_order", "time_axis", "_FillValue")
"""Attributes that describe a store and no other file."""


@dataclass(frozen=True)
class Selection:
    """What is exported: variables by name, of which `coordinates` names those that locate the others,
    attributes of the whole, and `notes`, sentences about what is left out."""

    run: RunRecord
    variables: Mapping[str, Variable]
    coordinates: tuple[str, ...]
    attrs: Mapping[str, Any]
    notes: tuple[str, ...]

    @property
    def data(self) -> dict[str, Variable]:
        """The variables that are no coordinates."""
        return {n: v for n, v in self.variables.items() if n not in self.coordinates}

    def attributes(self, name: str) -> dict[str, Any]:
        """Return the attributes of a variable by the CF conventions: `long_name`, `units` ("1" where
        there is none), `flag_values` in the type of the variable."""
        variable = self.variables[name]
        own = {n: v for n, v in variable.attrs.items() if n not in _OF_THE_STORE}
        attrs = {"long_name": name, **own, "units": cf_unit(self.unit(name))}
        if "flag_values" in attrs:
            attrs["flag_values"] = np.asarray(attrs["flag_values"], variable.dtype)
        return attrs

    def unit(self, name: str) -> str:
        """Return the unit of a variable as the run states it."""
        return self.variables[name].unit


def select(directory: Path, names: Sequence[str] | None = None) -> Selection:
    """Read a run directory and select variables, by default all. The coordinates of a variable are
    selected with it.

    **Raises:** `dvax.InputError` if the folder holds no run, the run no results, or none of a name.
    """
    if is_sweep(directory):
        raise input_error(
            str(directory), "the folder of a sweep", "dvax export reads the folder of one run",
            f'Open it in Python: xarray.open_zarr("{directory / SWEEP_STORE}"), and its to_dataframe() '
            'for CSV; or export runs of members, which runs = "all" in [output] keeps',
        )  # fmt: skip
    run = read_run(directory)
    store = run.trajectory
    if store is None:
        raise _without_results(run)
    every = dict(store.variables)
    if "variable_order" not in store.attrs:
        every = dict(sorted(every.items()))
    of_each = (v.attrs.get("coordinates", "") for v in every.values())
    listed = " ".join([str(store.attrs.get("coordinates", "")), *map(str, of_each)]).split()
    coordinates = [n for n, v in every.items() if n in listed or v.dims == (n,)]
    if names is not None:
        _check(directory, names, every)
        dims = {dim for n in names for dim in every[n].dims}
        kept = {*names, *(n for n in coordinates if set(every[n].dims) <= dims)}
        every = {n: v for n, v in every.items() if n in kept}
    notes = list(run.notes)
    if run.status in UNFINISHED:
        last = "" if "time" not in every else f" up to time {every['time'].values[-1]:g}"
        notes.insert(0, f"{UNFINISHED[run.status]} Its complete frames{last} are exported.")
    chosen = tuple(n for n in coordinates if n in every)
    return Selection(run, every, chosen, _attributes(run), tuple(notes))


def blocks(variables: Sequence[Variable], rows: int) -> Iterator[slice]:
    """Return slices of the first axis whose values fit into `_BLOCK_BYTES`, in whole chunks of the
    widest variable: a part of a chunk costs as much to read as the whole."""
    of_row = [v.dtype.itemsize * int(np.prod(v.shape[1:])) for v in variables]
    # A series may lie in one chunk, which says nothing about the fields.
    widest = variables[int(np.argmax(of_row))]
    chunk = widest.frames_per_chunk
    step = -(-max(1, _BLOCK_BYTES // max(sum(of_row), 1)) // chunk) * chunk
    for start in range(0, rows, step):
        yield slice(start, min(start + step, rows))


def cf_unit(unit: str) -> str:
    """Return a unit as UDUNITS spells it, where dvax spells it otherwise."""
    return {"": "1", "sec": "s", "second": "s", "seconds": "s"}.get(unit, unit)


def _attributes(run: RunRecord) -> dict[str, Any]:
    """Return the attributes of the whole: the conventions, and where the results come from."""
    config = run.directory / CONFIG
    facts = {
        "Conventions": "CF-1.11",
        "title": run.title,
        "source": f"dvax {run.manifest.get('dvax') or 'of unknown version'}, model {run.model}",
        "history": f"{datetime.now(UTC).isoformat(timespec='seconds')} dvax {version('dvax')}: "
        f"exported from the run {run.directory.resolve().name}",
        "status": run.status,
        "config_sha256": sha256(config.read_bytes()).hexdigest() if config.is_file() else "",
    }
    of_store = {n: v for n, v in run.attrs.items() if n not in {*facts, *_OF_THE_STORE}}
    return {n: v for n, v in {**facts, **of_store}.items() if v not in ("", None)}


def _without_results(run: RunRecord) -> Exception:
    why = UNFINISHED.get(run.status, f"Its status is {run.status}.")
    reason = str(run.manifest.get("stop_reason") or "")
    return input_error(
        str(run.directory), "a run without results",
        f"{why} {reason}".strip().rstrip(".") + ". There are no complete frames to export",
        f"Go on with it: dvax resume {run.directory}",
    )  # fmt: skip


def _check(directory: Path, names: Sequence[str], every: Mapping[str, Variable]) -> None:
    problems = Problems()
    for name in names:
        if name not in every:
            close = get_close_matches(name, every, n=1)
            fix = f"Did you mean {close[0]!r}?" if close else "Name some of these"
            rule = f"the run {directory} has {', '.join(every)}"
            problems.add("--variables", repr(name), rule, fix)
    problems.raise_any()
