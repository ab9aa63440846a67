"""The inputs of a run of the contact model, as arrays and signals."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dvax.app.runs.boundary import Boundary, build_boundary, check_size
from dvax.app.runs.data_file import DataFile, fingerprint, locate
from dvax.app.runs.fields import Field, perturbation, read_field, space_values, to_signal
from dvax.app.runs.measured import read_npy
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


def read_inputs(config: "Config", value_has_unit: frozenset[str] = frozenset()) -> ContactInputs:
    """Read and check all data that a configuration names. Raises `InputError` with all problems.

    `value_has_unit` names the fields whose value was written with a unit.
    """
    sources, units, end = config.sources, config.units, config.time.end
    _check_profiles(config)  # a boundary of very many points takes time and memory
    boundary, boundary_files = _boundary(config)
    problems = Problems()
    fields: dict[str, Field] = {}
    for key, kind in _KINDS.items():
        with problems.collect():
            fields[key] = read_field(
                getattr(config, key), key, kind, sources, units, boundary, end,
                value_has_unit=key in value_has_unit,
            )  # fmt: skip
    shift, notices = np.zeros(()), []
    with problems.collect():
        companion = config.initial.companion
        assert companion is not None  # the configuration is complete
        shift = perturbation(companion, boundary, f"{sources.name}: initial.companion")
    with problems.collect():
        notices = _check_points(config, boundary)
    problems.raise_any()
    series = fields["demand"].series
    if series is not None and series.kind == "constant":
        notices.append(
            "The demand jumps (series of kind 'constant'): the theory requires g continuous in "
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
        frame_times=np.linspace(0.0, end, config.time.frames + 1),
        data_files=tuple(dict.fromkeys(files)),
        notices=tuple(notices),
    )


def _check_profiles(config: "Config") -> None:
    """Raise an `InputError` where an NPY profile does not fit the number of points."""
    sources, problems = config.sources, Problems()
    for key in _KINDS:
        profile = getattr(config, key).profile
        if config.boundary.points is None or profile is None:
            continue
        if profile.file.lower().endswith(".npy"):
            place = f"{sources.name}: {key}.profile"
            with problems.collect():
                path = locate(profile.file, sources.folder, sources.allow_outside, f"{place}.file")
                read_npy(profile, path, tuple(config.boundary.points), place)
    problems.raise_any()


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


def _boundary(config: "Config") -> tuple[Boundary, tuple[DataFile, ...]]:
    """The boundary and its file."""
    sources, section = config.sources, config.boundary
    nodes, files = None, ()
    place = f"{sources.name}: boundary"
    if section.file is not None:
        place += ".file"
        nodes = locate(section.file, sources.folder, sources.allow_outside, place)
        files = (fingerprint(section.file, nodes),)
    boundary = build_boundary(section, nodes, config.units)
    check_size(boundary, place)
    return boundary, files


def _check_points(config: "Config", boundary: Boundary) -> list[str]:
    """Return notices for points of interest whose nearest point of the boundary is far away.

    **Raises:** `InputError` for places off the boundary.
    """
    places, unit = config.output.points_of_interest or [], config.units.length
    problems = Problems()
    notices: list[str] = []
    for number, place in enumerate(places, start=1):
        key = f"{config.source.name}: output.points_of_interest[{number}]"
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
                f"Choose a place on the boundary, in {unit}.",
            )
            continue
        index = boundary.nearest(place)
        at = tuple(float(c[index]) for c in boundary.coordinates)
        extent = max(float(np.ptp(c)) for c in boundary.coordinates)
        # Half a cell is expected; a visible distance is reported.
        if max(abs(a - p) for a, p in zip(at, place, strict=True)) > 0.01 * extent:
            notices.append(
                f"Point of interest {place} {unit}: the nearest point is "
                f"{[float(f'{a:.9g}') for a in at]} {unit}."
            )
    problems.raise_any()
    return notices


def _margin(coordinate: np.ndarray) -> float:
    """How far a boundary reaches beyond its outermost points: the widest gap between neighbours."""
    distinct = np.unique(coordinate)
    return float(np.max(np.diff(distinct))) if distinct.size > 1 else float("inf")
