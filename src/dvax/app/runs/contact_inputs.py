"""The inputs of a run of the contact model, as arrays and signals."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dvax.app.runs.boundary import Boundary, build_boundary, check_size
from dvax.app.runs.data_file import DataFile, fingerprint, locate
from dvax.app.runs.expressions import compile_expression
from dvax.app.runs.fields import Field, Sources, perturbation, read_field, space_values, to_signal
from dvax.app.runs.measured import read_npy
from dvax.app.runs.units import Units
from dvax.errors import Problems, input_error

if TYPE_CHECKING:
    from dvax.app.runs.settings import Config

_KINDS = {"demand": "indentation", "load": "indentation rate", "initial": "indentation"}


@dataclass(frozen=True)
class ContactInputs:
    """The data of a run, in the working units of its configuration.

    - `boundary`: n points with their weights, and the shape of their grid;
    - `demand`, `load`: g(t) and ell(t) as factors, see `demand_signal` and `load_signal`;
    - `x0`, `companion_x0`: the two initial states, (n,);
    - `frame_times`: the times to save, from 0 to the end;
    - `data_files`: what was read, with fingerprints;
    - `notices`: sentences for the log, about what is allowed but worth knowing.
    """

    boundary: Boundary
    demand: Field
    load: Field
    x0: np.ndarray
    companion_x0: np.ndarray
    frame_times: np.ndarray
    data_files: tuple[DataFile, ...]
    notices: tuple[str, ...]

    @property
    def demand_signal(self) -> Any:
        """g as a `dvax.signals` signal, values (n,) or (); built again in JAX's current
        precision."""
        return to_signal(self.demand, self.boundary)

    @property
    def load_signal(self) -> Any:
        """ell as a `dvax.signals` signal, values (n,) or (); built again in JAX's current
        precision."""
        return to_signal(self.load, self.boundary)


def read_inputs(
    config: "Config",
    sources: Sources,
    units: Units,
    value_has_unit: frozenset[str] = frozenset(),
    coordinate_names: tuple[str, ...] = ("s",),
) -> ContactInputs | None:
    """Read and check all data that a configuration names. Raises `InputError` with all problems.

    The configuration may lack sections that were refused before; the rest is checked all the same,
    and None is returned. `value_has_unit` names the fields whose value was written with a unit,
    `coordinate_names` are those of a boundary that was refused.
    """
    problems = Problems()
    sections = dict(config.__dict__)
    time, initial = sections.get("time"), sections.get("initial")
    end = time.end if time is not None else None
    boundary, boundary_files = None, ()
    with problems.collect():
        _check_profiles(sections, sources)  # a boundary of very many points takes time and memory
        boundary, boundary_files = _boundary(sections.get("boundary"), sources, units)
    place = boundary or coordinate_names
    fields: dict[str, Field] = {}
    for key, kind in _KINDS.items():
        if key in sections:
            with problems.collect():
                fields[key] = read_field(
                    sections[key], key, kind, sources, units, place, end,
                    value_has_unit=key in value_has_unit,
                )  # fmt: skip
    shift = None
    if initial is not None and initial.companion is not None:
        key = f"{sources.name}: initial.companion"
        with problems.collect():
            if boundary is not None:
                shift = perturbation(initial.companion, boundary, key)
            elif isinstance(initial.companion, str):
                compile_expression(initial.companion, coordinate_names, place=key)
    notices: list[str] = []
    if boundary is not None and "output" in sections:
        places = sections["output"].points_of_interest or []
        with problems.collect():
            notices = _check_points(places, boundary, sources.name, units)
    problems.raise_any()
    if boundary is None or shift is None or time is None or len(fields) < len(_KINDS):
        return None
    series = fields["demand"].series
    if series is not None and series.kind == "constant":
        notices.append(
            "The demand jumps (series of kind 'constant'): the theory asks for g continuous in "
            "time, and u jumps with it."
        )
    x0, companion_x0 = _initial_states(fields["initial"], boundary, shift, sources.name)
    files = (*boundary_files, *(f for field in fields.values() for f in field.files))
    return ContactInputs(
        boundary=boundary,
        demand=fields["demand"],
        load=fields["load"],
        x0=x0,
        companion_x0=companion_x0,
        frame_times=np.linspace(0.0, time.end, time.frames + 1),
        data_files=tuple(dict.fromkeys(files)),
        notices=tuple(notices),
    )


def _check_profiles(sections: dict[str, Any], sources: Sources) -> None:
    """Raise an `InputError` where an NPY profile does not fit the number of points."""
    shape = getattr(sections.get("boundary"), "points", None)
    for key in _KINDS:
        profile = getattr(sections.get(key), "profile", None)
        if shape is None or profile is None or not profile.file.lower().endswith(".npy"):
            continue
        place = f"{sources.name}: {key}.profile"
        path = locate(profile.file, sources.folder, sources.allow_outside, f"{place}.file")
        read_npy(profile, path, tuple(shape), place)


def _initial_states(
    field: Field, boundary: Boundary, shift: np.ndarray, file: str
) -> tuple[np.ndarray, np.ndarray]:
    """x(0) and the initial state of the companion. Raises `InputError` where one of them overflows."""
    with np.errstate(over="ignore", invalid="ignore"):
        x0 = space_values(field, boundary)
        companion = x0 + shift
    for key, state in (("initial", x0), ("initial.companion", companion)):
        bad = np.flatnonzero(~np.isfinite(state))
        if bad.size:
            raise input_error(
                f"{file}: {key}",
                f"{state[bad[0]]} at point {bad[0] + 1}",
                "x(0, s), and x(0, s) plus companion, by default (1 + b_u) kappa0 / (beta b_x), are "
                "finite at every point",
                "Check the sizes of the factors, and the units that they are in.",
            )
    return x0, companion


def _boundary(
    section: Any, sources: Sources, units: Units
) -> tuple[Boundary | None, tuple[DataFile, ...]]:
    """The boundary and its file; None where the section was refused."""
    if section is None:
        return None, ()
    nodes, files = None, ()
    place = f"{sources.name}: boundary"
    if section.file is not None:
        place += ".file"
        nodes = locate(section.file, sources.folder, sources.allow_outside, place)
        files = (fingerprint(section.file, nodes),)
    boundary = build_boundary(section, nodes, units)
    check_size(boundary, place)
    return boundary, files


def _check_points(
    places: list[list[float]], boundary: Boundary, file: str, units: Units
) -> list[str]:
    """Return notices for points of interest whose nearest point of the boundary is far away.

    **Raises:** `InputError` for places off the boundary.
    """
    problems = Problems()
    notices: list[str] = []
    for number, place in enumerate(places, start=1):
        key = f"{file}: output.points_of_interest[{number}]"
        if len(place) != len(boundary.coordinates):
            problems.add(
                key,
                str(place),
                f"a point has {len(boundary.coordinates)} coordinate(s), {boundary.names}",
                "Write [2.5] on a line and [[2.5, 1.0]] on a rectangle.",
            )
            continue
        outside = [
            name
            for name, p, c in zip(boundary.names, place, boundary.coordinates, strict=True)
            if not c.min() - _margin(c) <= p <= c.max() + _margin(c)
        ]
        if outside:
            problems.add(
                key,
                str(place),
                f"{' and '.join(outside)} lies off the boundary",
                f"Choose a place on the boundary, in {units.length}.",
            )
            continue
        index = boundary.nearest(place)
        at = tuple(float(c[index]) for c in boundary.coordinates)
        extent = max(float(np.ptp(c)) for c in boundary.coordinates)
        # Half a cell is expected; a visible distance is reported.
        if max(abs(a - p) for a, p in zip(at, place, strict=True)) > 0.01 * extent:
            notices.append(
                f"Point of interest {place} {units.length}: the nearest point is "
                f"{[float(f'{a:.9g}') for a in at]} {units.length}."
            )
    problems.raise_any()
    return notices


def _margin(coordinate: np.ndarray) -> float:
    """How far a boundary reaches beyond its outermost points: the widest gap between neighbours."""
    distinct = np.unique(coordinate)
    return float(np.max(np.diff(distinct))) if distinct.size > 1 else float("inf")
