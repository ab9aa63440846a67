"""Everything that a run of the contact model starts from, as arrays and signals."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dvax.app.runs.boundary import Boundary, build_boundary, check_size
from dvax.app.runs.data_file import DataFile, fingerprint, locate
from dvax.app.runs.expressions import compile_expression
from dvax.app.runs.fields import Field, Sources, perturbation, read_field, space_values, to_signal
from dvax.app.runs.measured import check_length
from dvax.app.runs.units import Units
from dvax.errors import InputError, InputProblem

if TYPE_CHECKING:
    from dvax.app.runs.settings import Config

_FINE = 10**6
_KINDS = {"demand": "indentation", "load": "indentation rate", "initial": "indentation"}


@dataclass(frozen=True)
class ContactInputs:
    """The data of a run, in the working units of its configuration.

    - `boundary`: n points with their weights, and the shape of their grid;
    - `demand`, `load`: g(t) and ell(t) as factors, see `demand_signal` and `load_signal`;
    - `x0`, `companion_x0`: the two initial states, (n,);
    - `frame_times`: the times to save, from 0 to the end;
    - `point_indices`: the points whose histories are shown;
    - `data_files`: what was read, with fingerprints;
    - `notices`: sentences for the log, about what is allowed but worth knowing.
    """

    boundary: Boundary
    demand: Field
    load: Field
    x0: np.ndarray
    companion_x0: np.ndarray
    frame_times: np.ndarray
    point_indices: tuple[int, ...]
    data_files: tuple[DataFile, ...]
    notices: tuple[str, ...]

    @property
    def demand_signal(self) -> Any:
        """g as a `dvax.signals` signal, values (n,) or (); built anew in JAX's current
        precision."""
        return to_signal(self.demand, self.boundary)

    @property
    def load_signal(self) -> Any:
        """ell as a `dvax.signals` signal, values (n,) or (); built anew in JAX's current
        precision."""
        return to_signal(self.load, self.boundary)


def read_inputs(
    config: "Config",
    sources: Sources,
    units: Units,
    value_has_unit: frozenset[str] = frozenset(),
    coordinate_names: tuple[str, ...] = ("s",),
) -> tuple[ContactInputs | None, list[InputProblem]]:
    """Read and check all data that a configuration names: (inputs, problems), with all problems.

    The configuration may lack sections that were refused before; the rest is checked all the same,
    and the inputs are None. `value_has_unit` names the fields whose value was written with a unit,
    `coordinate_names` are those of a boundary that was refused.
    """
    problems: list[InputProblem] = []
    sections = dict(config.__dict__)
    time = sections.get("time")
    end = time.end if time is not None else None
    mismatched = _mismatched_profiles(sections, sources)
    problems += mismatched
    described = None if mismatched else sections.get("boundary")
    boundary, boundary_files = _boundary(described, sources, units, problems)
    fields: dict[str, Field] = {}
    for key, kind in _KINDS.items():
        section = sections.get(key)
        if section is None:
            continue
        try:
            fields[key] = read_field(
                section,
                key,
                kind,
                sources,
                units,
                boundary or coordinate_names,
                end,
                value_has_unit=key in value_has_unit,
            )
        except InputError as error:
            problems += error.problems
    problems += _between_times(sections, sources.name)
    shift = None
    initial = sections.get("initial")
    if initial is not None and initial.companion is not None:
        place = f"{sources.name}: initial.companion"
        try:
            if boundary is not None:
                shift = perturbation(initial.companion, boundary, place)
            elif isinstance(initial.companion, str):
                compile_expression(initial.companion, coordinate_names, place=place)
        except InputError as error:
            problems += error.problems
    if boundary is None:
        return None, problems
    indices, notices = _points(sections.get("output"), boundary, sources.name, units, problems)
    if problems or shift is None or time is None or len(fields) < len(_KINDS):
        return None, problems
    series = fields["demand"].series
    if series is not None and series.kind == "constant":
        notices.append(
            "The demand jumps (series of kind 'constant'): the theory asks for g continuous in "
            "time, and u jumps with it."
        )
    x0, companion_x0 = _initial_states(fields["initial"], boundary, shift, sources.name, problems)
    if problems:
        return None, problems
    files = (*boundary_files, *(f for field in fields.values() for f in field.files))
    inputs = ContactInputs(
        boundary=boundary,
        demand=fields["demand"],
        load=fields["load"],
        x0=x0,
        companion_x0=companion_x0,
        frame_times=np.linspace(0.0, time.end, time.frames + 1),
        point_indices=indices,
        data_files=tuple(dict.fromkeys(files)),
        notices=tuple(notices),
    )
    return inputs, problems


def _mismatched_profiles(sections: dict[str, Any], sources: Sources) -> list[InputProblem]:
    """Profiles of another length than a boundary so fine that building it would take seconds."""
    points = getattr(sections.get("boundary"), "points", None)
    problems: list[InputProblem] = []
    if points is None or math.prod(points) < _FINE:
        return problems
    for key in _KINDS:
        profile = getattr(sections.get(key), "profile", None)
        if profile is None:
            continue
        place = f"{sources.name}: {key}.profile"
        try:
            path = locate(profile.file, sources.folder, sources.allow_outside, f"{place}.file")
        except InputError:
            continue  # read_field reports it
        try:
            check_length(profile, path, points, place)
        except InputError as error:
            problems += error.problems
    return problems


def _initial_states(
    field: Field, boundary: Boundary, shift: np.ndarray, file: str, problems: list[InputProblem]
) -> tuple[np.ndarray, np.ndarray]:
    """x(0) and where the companion starts; a problem where one of them overflows."""
    with np.errstate(over="ignore", invalid="ignore"):
        x0 = space_values(field, boundary)
        companion = x0 + shift
    for key, state in (("initial", x0), ("initial.companion", companion)):
        bad = np.flatnonzero(~np.isfinite(state))
        if not bad.size:
            continue
        what = "x(0, s)"
        if key == "initial.companion":
            what = (
                "where the companion starts, which is x(0, s) plus companion, by default "
                "(1 + b_u) kappa0 / (beta b_x),"
            )
        problems.append(
            InputProblem(
                f"{file}: {key}",
                f"{state[bad[0]]} at point {bad[0] + 1}",
                f"{what} is finite at every point",
                "Check the sizes of the factors, and the units that they are in.",
            )
        )
        break
    return x0, companion


def _boundary(
    section: Any, sources: Sources, units: Units, problems: list[InputProblem]
) -> tuple[Boundary | None, tuple[DataFile, ...]]:
    """The boundary, None where it was refused."""
    if section is None:
        return None, ()
    try:
        nodes, files = None, ()
        place = f"{sources.name}: boundary"
        if section.file is not None:
            place += ".file"
            nodes = locate(section.file, sources.folder, sources.allow_outside, place)
            files = (fingerprint(section.file, nodes),)
        boundary = build_boundary(section, nodes, units)
        check_size(boundary, place)
        return boundary, files
    except InputError as error:
        problems += error.problems
        return None, ()


def _between_times(sections: dict[str, Any], file: str) -> list[InputProblem]:
    time, solver = sections.get("time"), sections.get("solver")
    if time is None or solver is None or solver.dt is None or solver.dt <= time.end:
        return []
    return [
        InputProblem(
            f"{file}: solver.dt",
            f"{solver.dt:.12g}",
            f"a step is not longer than the run, which ends at {time.end:.12g}",
            "Give a smaller step.",
        )
    ]


def _points(
    section: Any, boundary: Boundary, file: str, units: Units, problems: list[InputProblem]
) -> tuple[tuple[int, ...], list[str]]:
    """Indices of the points of interest, each snapped to the nearest point, and what to say of
    it."""
    if section is None:
        return (), []
    places = section.points_of_interest
    if places is None:
        return _quarters(boundary), []
    indices: list[int] = []
    notices: list[str] = []
    for number, place in enumerate(places, start=1):
        key = f"{file}: output.points_of_interest[{number}]"
        if len(place) != len(boundary.coordinates):
            problems.append(
                InputProblem(
                    key,
                    str(list(place)),
                    f"a point has {len(boundary.coordinates)} coordinate(s), {boundary.names}",
                    "Write [2.5] on a line and [[2.5, 1.0]] on a rectangle.",
                )
            )
            continue
        outside = [
            name
            for name, p, c in zip(boundary.names, place, boundary.coordinates, strict=True)
            if not c.min() - _margin(c) <= p <= c.max() + _margin(c)
        ]
        if outside:
            problems.append(
                InputProblem(
                    key,
                    str(list(place)),
                    f"{' and '.join(outside)} lies off the boundary",
                    f"Choose a place on the boundary, in {units.length}.",
                )
            )
            continue
        index = boundary.nearest(place)
        at = tuple(float(c[index]) for c in boundary.coordinates)
        extent = max(float(np.ptp(c)) for c in boundary.coordinates)
        # Half a cell away is where the point is; a visible distance is worth a word.
        if max(abs(a - p) for a, p in zip(at, place, strict=True)) > 0.01 * extent:
            notices.append(
                f"Point of interest {list(place)} {units.length}: the nearest point is "
                f"{[float(f'{a:.9g}') for a in at]} {units.length}."
            )
        indices.append(index)
    return tuple(dict.fromkeys(indices)), notices


def _margin(coordinate: np.ndarray) -> float:
    """How far a boundary reaches beyond its outermost points: the widest gap between neighbours."""
    distinct = np.unique(coordinate)
    return float(np.max(np.diff(distinct))) if distinct.size > 1 else float("inf")


def _quarters(boundary: Boundary) -> tuple[int, ...]:
    """The points at a quarter, half and three quarters of the boundary, in every direction."""
    parts = [sorted({min(n * k // 4, n - 1) for k in (1, 2, 3)}) for n in boundary.shape]
    if len(parts) == 1:
        return tuple(parts[0])
    middle = [axis[len(axis) // 2] for axis in parts]
    along = [(i, middle[1]) for i in parts[0]] + [(middle[0], j) for j in parts[1]]
    return tuple(dict.fromkeys(i * boundary.shape[1] + j for i, j in along))
