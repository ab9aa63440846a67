"""Fields on the boundary as products of factors.

    field(t, s) = value * expression(t, s) * series(t) * profile(s)

Every factor is optional. At most one of them is a physical quantity, the others are pure numbers;
where none says a unit, the product is a number in working units.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dvax.app.runs.boundary import Boundary
from dvax.app.runs.data_file import DataFile, fingerprint, locate
from dvax.app.runs.expressions import Expression, compile_expression
from dvax.app.runs.measured import Profile, Series, read_profile, read_series
from dvax.app.runs.schema import (
    DemandSection,
    InitialSection,
    LoadSection,
    ProfileSection,
    SeriesSection,
)
from dvax.app.runs.units import Units
from dvax.errors import Problems, input_error

_SAMPLE_TIMES = 33
_SAMPLE_POINTS = 1000


@dataclass(frozen=True)
class Field:
    """The factors of a field, in working units and in double precision."""

    constant: float = 1.0
    expression: Expression | None = None
    knots: tuple[float, ...] = ()
    series: Series | None = None
    profile: Profile | None = None
    files: tuple[DataFile, ...] = ()


@dataclass(frozen=True)
class Sources:
    """The name of a configuration file, its folder, and whether data may lie outside that folder."""

    name: str
    folder: Path
    allow_outside: bool


def read_field(
    section: DemandSection | LoadSection | InitialSection,
    key: str,
    kind: str,
    sources: Sources,
    units: Units,
    boundary: Boundary,
    end: float,
    *,
    value_has_unit: bool = False,
) -> Field:
    """Read, compile and check all factors of ``[key]``, a quantity of the given `kind`.

    `end` is the end of the run. Raises `InputError` with the problems of every factor.
    """
    problems = Problems()
    files: list[DataFile] = []
    prefix = f"{sources.name}: {key}"
    names = boundary.names
    names = names if isinstance(section, InitialSection) else ("t", *names)
    expression, series, profile = None, None, None

    def open_file(part: SeriesSection | ProfileSection, place: str) -> Path:
        path = locate(part.file, sources.folder, sources.allow_outside, f"{place}.file")
        files.append(fingerprint(part.file, path))
        return path

    with problems.collect():
        if section.expression is not None:
            expression = compile_expression(section.expression, names, place=f"{prefix}.expression")
    with problems.collect():
        part, place = getattr(section, "series", None), f"{prefix}.series"
        if part is not None:
            series = read_series(part, open_file(part, place), units, kind, end, place)
    with problems.collect():
        part, place = section.profile, f"{prefix}.profile"
        if part is not None:
            profile = read_profile(part, open_file(part, place), units, kind, boundary, place)
    problems.raise_any()
    carriers = ["value"] if value_has_unit else []
    carriers += ["series"] if series is not None and series.carries_unit else []
    carriers += ["profile"] if profile is not None and profile.carries_unit else []
    if len(carriers) > 1:
        raise input_error(
            prefix,
            f"units in {' and in '.join(carriers)}",
            f"the factors multiply to {units.of(kind)}, so only one of them carries a unit",
            "Keep the unit of one factor; the others are pure numbers (columns [1]).",
        )
    knots = () if isinstance(section, InitialSection) else tuple(section.knots or ())
    constant = 1.0 if section.value is None else section.value
    field = Field(constant, expression, knots, series, profile, tuple(files))
    _check_finite(field, boundary, end, prefix)
    return field


def space_values(field: Field, boundary: Boundary) -> np.ndarray:
    """The field (n,) where nothing in it depends on time."""
    values = np.full(boundary.size, field.constant)
    if field.expression is not None:
        values = values * field.expression.numpy(**_variables(field.expression, boundary, 0.0))
    if field.profile is not None:
        values = values * field.profile.values
    return values


def perturbation(value: float | str, boundary: Boundary, place: str) -> np.ndarray:
    """What is added to x0 for the companion: a number, or a formula in the coordinates. (n,)

    Raises `InputError`, also for a perturbation that is zero everywhere.
    """
    field = Field()
    if isinstance(value, str):
        field = Field(expression=compile_expression(value, boundary.names, place=place))
        _check_finite(field, boundary, None, place)
    values = space_values(field, boundary) * (1.0 if isinstance(value, str) else value)
    if not np.any(values):
        raise input_error(
            place,
            repr(value),
            "the companion starts elsewhere, or both trajectories are the same",
            "Give a perturbation that is not zero, or leave it out for the default.",
        )
    return values


def to_signal(field: Field, boundary: Boundary) -> Any:
    """The field as a `dvax.signals` signal with values (n,), or () where it is the same
    everywhere."""
    from dvax import signals
    from dvax.app.runs.formula_signal import Formula

    factors: list[Any] = []
    expression = field.expression
    varies = expression is not None and "t" in expression.uses
    everywhere = np.asarray(field.constant)
    if expression is not None and not varies:
        everywhere = everywhere * expression.numpy(**_variables(expression, boundary, 0.0))
    if field.profile is not None:
        everywhere = everywhere * field.profile.values
    if everywhere.ndim or everywhere != 1.0 or not (varies or field.series):
        factors.append(signals.Constant(everywhere))
    if field.series is not None:
        series = field.series
        kind: Any = series.kind
        factors.append(signals.Table(series.times, series.values, kind=kind))
    if expression is not None and varies:
        formula = Formula(expression, boundary.names, boundary.coordinates)
        factors.append(signals.Function(formula, knots=field.knots))
    product = factors[0]
    for factor in factors[1:]:
        product = signals.Product(product, factor)
    return product


def _variables(expression: Expression, boundary: Boundary, t: float) -> dict[str, Any]:
    variables: dict[str, Any] = dict(zip(boundary.names, boundary.coordinates, strict=True))
    return {**variables, "t": t} if "t" in expression.names else variables


def _check_finite(field: Field, boundary: Boundary, end: float | None, place: str) -> None:
    """Raise an `InputError` where samples of the field are NaN or infinite. The run itself checks the
    values between the samples."""
    expression = field.expression
    if expression is None:
        return
    stride = max(1, boundary.size // _SAMPLE_POINTS)
    coarse = {k: c[::stride] for k, c in zip(boundary.names, boundary.coordinates, strict=True)}
    fine = dict(zip(boundary.names, boundary.coordinates, strict=True))
    samples: list[tuple[float, dict[str, Any]]] = [(0.0, fine)]
    if "t" in expression.uses and end is not None:
        samples += [(float(t), coarse) for t in np.linspace(0.0, end, _SAMPLE_TIMES)[1:]]
    for t, coordinates in samples:
        variables = {**coordinates, "t": t} if "t" in expression.names else coordinates
        values = np.broadcast_to(
            expression.numpy(**variables), next(iter(coordinates.values())).shape
        )
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            at = ", ".join(f"{name} = {c[bad[0]]:.6g}" for name, c in coordinates.items())
            if "t" in expression.uses:
                at = f"t = {t:.6g}, {at}"
            raise input_error(
                place,
                f"{expression.text!r:.70} with the value {values[bad[0]]} at {at}",
                "a field is finite everywhere and at all times",
                "Fix the division, root or logarithm there.",
            )
