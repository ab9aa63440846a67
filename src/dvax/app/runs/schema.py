"""The configuration as pydantic models: one class a section of the TOML file.

Every physical quantity is a number in the working units of ``[units]`` or a text "number unit",
which is converted as it is read, so a validated configuration holds numbers alone. Rules that
concern the values of one section stand here, as do the reasons for them, which error messages repeat.
"""

import math
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainValidator,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from dvax.app.runs.units import (
    UnitError,
    Units,
    check_working_unit,
    converted,
    is_linear,
    is_quantity,
)

ViSolver = Literal[
    "Auto", "Projection", "Extragradient", "ForwardBackwardForward", "GoldenRatio",
    "SemismoothNewton", "ActiveSet", "Accelerated",
]  # fmt: skip
"""Solvers of the frozen law that need no argument, by their names in `dvax.vi`."""
Method = Literal[
    "ETD1", "ETD2RK", "ETD4RK", "ExpRosenbrock", "DormandPrince", "Implicit", "PiecewiseLinear"
]  # fmt: skip
LARGEST_MAX_STEPS = 2**31 - 1
"""The largest max_steps of `dvax.solve`."""
MAX_POINTS = 100_000_000
MAX_FRAMES = 10**7


def rule_error(rule: str, fix: str) -> PydanticCustomError:
    """Return the exception for a validator to raise: the rule that a value breaks, and the fix."""
    return PydanticCustomError("rule", "{rule}", {"rule": rule, "fix": fix})


LEAST_RTOL = 2.3e-14
"""A hundred unit roundoffs of double precision: the smallest rtol that steps can reach."""


def within_precision(rtol: float | None) -> float | None:
    """A relative tolerance that double precision can reach."""
    if rtol is not None and rtol < LEAST_RTOL:
        raise rule_error(
            f"a relative tolerance below {LEAST_RTOL:g} cannot be reached in double precision, whose "
            "rounding is 2.2e-16 an operation",
            f"Write rtol = {LEAST_RTOL:g} or more; atol is for states near 0",
        )
    return rtol


def _in_units(value: Any, kind: str, info: ValidationInfo) -> Any:
    """A text "number unit" as a number in working units; everything else as it is."""
    if not isinstance(value, str):
        return value
    units = (info.context or {}).get("units") or Units()
    try:
        return units.convert(value, kind)
    except UnitError as error:
        raise rule_error(error.rule, error.fix) from None


def in_quantity(kind: str) -> BeforeValidator:
    """A number in working units, or a text "number unit" of this kind."""

    def convert(value: Any, info: ValidationInfo) -> Any:
        return _in_units(value, kind, info)

    return BeforeValidator(convert)


def in_unit(unit: str) -> BeforeValidator:
    """A number in this unit, or a text "number unit" that converts to it."""

    def convert(value: Any) -> Any:
        return _converted(value, unit) if isinstance(value, str) else value

    return BeforeValidator(convert)


def number_or_file(unit: str) -> PlainValidator:
    """A number in this unit, a text "number unit", or else the name of a file."""

    def convert(value: Any) -> float | str:
        if isinstance(value, str):
            return _converted(value, unit) if is_quantity(value) else value
        if type(value) not in (int, float) or not math.isfinite(value):
            raise rule_error(
                f"it is a finite number in {unit}, or the name of a CSV file",
                f'Write "2.5 {unit}", or a file such as "history.csv"',
            )
        return float(value)

    return PlainValidator(convert)


def _converted(text: str, unit: str) -> float:
    number = converted(text, unit)
    if number is None and is_quantity(text) and not is_linear(unit):
        raise rule_error(
            f"its unit is {unit!r}, to which no text in another unit is converted: it is unknown, or "
            "does not start at zero",
            f'Write a bare number, or "2.5 {unit}"',
        )
    if number is None:
        raise rule_error(
            f"it is a number in {unit}, or a text with a number and a unit of that dimension",
            f'Write "2.5 {unit}"',
        )
    return number


def _finite(value: Any, kind: str, info: ValidationInfo, what: str) -> float:
    number = _in_units(value, kind, info)
    if type(number) not in (int, float) or not math.isfinite(number):
        raise rule_error(
            f"{what} is a finite number", f'Write a number, or a text such as "2.5 <unit>" ({kind})'
        )
    return float(number)


def _as_list(value: Any) -> Any:
    """Return a list as it is, and anything else as a list with one entry."""
    return value if isinstance(value, list) else [value]


def _check_count(points: list[int]) -> list[int]:
    """Refuse more points than a run has memory for."""
    if min(points) < 1 or math.prod(points) > MAX_POINTS:
        raise rule_error(
            f"a boundary has 1 to {MAX_POINTS} points in all", "Choose the resolution you need"
        )
    return points


def _perturbation(value: Any, info: ValidationInfo) -> float | str:
    """A number, a quantity, or else a formula, which `dvax.app.runs.fields` compiles."""
    if isinstance(value, str) and not is_quantity(value):
        return value
    return _finite(value, "indentation", info, "the perturbation")


def _working_unit(value: Any, info: ValidationInfo) -> Any:
    if isinstance(value, str):
        try:
            check_working_unit(str(info.field_name), value)
        except UnitError as error:
            raise rule_error(error.rule, error.fix) from None
    return value


class Section(BaseModel):
    """A table of the file: unknown keys, wrong types, NaN and infinity are errors."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class UnitsSection(Units):
    """The working units, each checked to have the dimension of its name."""

    time: Annotated[str, BeforeValidator(_working_unit)] = Field("s", description="a unit of time")
    length: Annotated[str, BeforeValidator(_working_unit)] = Field(
        "m", description="the unit of coordinates on the boundary"
    )
    indentation: Annotated[str, BeforeValidator(_working_unit)] = Field(
        "m", description="the unit of x, g and u"
    )
    pressure: Annotated[str, BeforeValidator(_working_unit)] = Field(
        "Pa", description="the unit of y = beta u and kappa0"
    )


class ModelSection(Section):
    """The contact law of the paper, section 7."""

    name: Literal["contact"] = Field("contact", description="the model")
    alpha: Annotated[float, in_quantity("rate")] = Field(
        gt=0, description="relaxation rate: A = -alpha I generates a decaying semigroup"
    )
    beta: Annotated[float, in_quantity("stiffness")] = Field(
        gt=0, description="pressure per reaction: P = beta I must be coercive"
    )
    b_x: Annotated[float, in_quantity("number")] = Field(
        gt=0, description="feedback of the state on the drive q = g - b_x x"
    )
    b_u: Annotated[float, in_quantity("number")] = Field(
        ge=0, description="self-feedback of the reaction: below 0 the law may lose its solution"
    )
    d_x: Annotated[float, in_quantity("rate")] = Field(
        gt=0, description="state feedback in f = ell - d_x x - d_u u"
    )
    d_u: Annotated[float, in_quantity("rate")] = Field(
        gt=0, description="reaction of the pressure in f = ell - d_x x - d_u u"
    )
    kappa0: Annotated[float, in_quantity("pressure")] = Field(
        gt=0, description="pressure capacity: K = {0 <= y <= kappa0} needs an interior"
    )


Length = Annotated[float, in_quantity("length")]


class BoundarySection(Section):
    """Gamma_C: ``length`` and ``points``, or ``lengths`` and ``points``, or ``file``."""

    length: Length | None = Field(None, gt=0, description="length of a one-dimensional boundary")
    lengths: (
        Annotated[list[Annotated[Length, Field(gt=0)]], Field(min_length=2, max_length=2)] | None
    ) = Field(None, description="sides of a rectangular boundary")
    points: (
        Annotated[
            list[int],
            Field(min_length=1, max_length=2),
            BeforeValidator(_as_list),
            AfterValidator(_check_count),
        ]
        | None
    ) = Field(None, description="midpoints of equal cells, one number a direction")
    file: str | None = Field(None, description="CSV file with the columns s and weight")

    @field_validator("points")
    @classmethod
    def _directions(cls, points: list[int], info: ValidationInfo) -> list[int]:
        sides = [name for name in ("length", "lengths") if info.data.get(name) is not None]
        if sides == ["lengths"] and len(points) == 1:
            raise rule_error(
                "lengths = [a, b] needs a number of points for each direction",
                "Write points = [n1, n2]",
            )
        if sides == ["length"] and len(points) > 1:
            raise rule_error(
                "length = ... is one-dimensional and has one number of points",
                "Write points = n, or lengths = [a, b]",
            )
        return points

    @model_validator(mode="after")
    def _one_boundary(self) -> Self:
        if self.model_fields_set not in ({"length", "points"}, {"lengths", "points"}, {"file"}):
            raise rule_error(
                "a boundary is length and points, or lengths and points, or a file of nodes",
                "Give exactly one of the three",
            )
        return self


class SeriesSection(Section):
    """A measured function of time."""

    file: str = Field(description="a CSV file, or an .at2 strong-motion record")
    column: str | None = Field(None, description="the column of values")
    time_column: str = Field("time", description="the column of times")
    kind: Literal["constant", "linear", "cubic"] = Field(
        "linear",
        description="how values are joined: held until the next, straight lines, C2 spline",
    )
    per_unit: float | str | None = Field(
        None, description="what one unit of the column stands for, such as 30 um/s per g"
    )


class ProfileSection(Section):
    """A measured function on the boundary."""

    file: str = Field(description="an NPY file with one value a point, or a CSV file over s")
    column: str | None = Field(None, description="the column of values")
    position_column: str = Field("s", description="the column of coordinates")
    per_unit: float | str | None = Field(
        None, description="what one unit of the file stands for, such as 1 um"
    )


class FieldSection(Section):
    """A field on the boundary: the product of the factors that are given."""

    quantity: ClassVar[str]

    value: float | None = Field(None, description="a constant factor")
    expression: str | None = Field(None, description="a formula in t and s (or s1, s2)")
    profile: ProfileSection | None = Field(None, description="a measured profile")

    @field_validator("value", mode="before")
    @classmethod
    def _value(cls, value: Any, info: ValidationInfo) -> Any:
        return _in_units(value, cls.quantity, info)

    @field_validator("series", "profile", mode="before", check_fields=False)
    @classmethod
    def _table(cls, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, dict) and "per_unit" in value:
            factor = _finite(value["per_unit"], cls.quantity, info, "per_unit")
            return {**value, "per_unit": factor}
        return value


class DrivingSection(FieldSection):
    """A field that may change in time."""

    knots: list[Annotated[float, in_quantity("time")]] | None = Field(
        None, description="times where the formula has a kink"
    )
    series: SeriesSection | None = Field(None, description="a measured history")

    @field_validator("knots")
    @classmethod
    def _of_formula(cls, knots: list[float], info: ValidationInfo) -> list[float]:
        if info.data.get("expression", "") is None:
            raise rule_error(
                "knots are the times where the expression has a kink; measured data has its own",
                "Remove knots or give the expression",
            )
        return knots

    @model_validator(mode="after")
    def _has_factor(self) -> Self:
        if not {"value", "expression", "series", "profile"} & self.model_fields_set:
            raise rule_error(
                "it is the product of value, expression, series and profile, at least one of them",
                "Write value = 0.0 for none",
            )
        return self


class DemandSection(DrivingSection):
    """g(t, s) [indentation]."""

    quantity = "indentation"


class LoadSection(DrivingSection):
    """ell(t, s) [indentation/time]."""

    quantity = "indentation rate"


class InitialSection(FieldSection):
    """x(0, s) [indentation], a formula of which depends on s alone, and a second start."""

    quantity = "indentation"

    companion: Annotated[float | str | None, PlainValidator(_perturbation)] = Field(
        None,
        description="what is added to x(0, s) to start the second trajectory; by default the "
        "indentation (1 + b_u) kappa0 / (beta b_x) that moves a point through the active regime",
    )


class TimeSection(Section):
    """The run ends at `end`; states are saved at `frames` + 1 equidistant times, 0 and end
    included."""

    end: Annotated[float, in_quantity("time")] = Field(
        gt=0, description="time passes forward from 0"
    )
    frames: int = Field(
        200, ge=1, le=MAX_FRAMES, description="number of intervals between saved states"
    )


def _alone(dt: float | None, info: ValidationInfo) -> float | None:
    """Refuse a fixed step together with tolerances, or with a method that needs them."""
    given = [name for name in ("rtol", "atol", "dt_max") if info.data.get(name) is not None]
    if dt is not None and given:
        raise rule_error(
            f"steps are fixed by dt, or chosen for {' and '.join(given)}, not both",
            f"Leave out dt, or {' and '.join(given)}",
        )
    if dt is not None and info.data.get("method") == "Implicit":
        raise rule_error(
            "the steps of an implicit method are chosen for rtol and atol", "Leave out dt"
        )
    return dt


def _apart(value: Any, info: ValidationInfo) -> Any:
    """Refuse options of steps and of law solvers for `PiecewiseLinear`, which has neither."""
    if value is not None and info.data.get("method") == "PiecewiseLinear":
        raise rule_error(
            "PiecewiseLinear steps from one change of the constraints to the next, and solves its law "
            "in closed form",
            f"Leave out {info.field_name}, or name another method",
        )
    return value


class SolverKeys(Section):
    """Keys that go to `dvax.solve`; one that is left out has the default of the model."""

    method: Method | None = Field(None, description="of a step; by default that of the model")
    rtol: Annotated[float | None, AfterValidator(within_precision)] = Field(
        None, gt=0, lt=1, description="relative tolerance of a run"
    )
    atol: float | None = Field(None, gt=0, description="absolute tolerance, in units of the state")
    dt_max: Annotated[float | None, AfterValidator(_apart)] = Field(
        None, gt=0, description="the longest step that adapts, in units of time"
    )
    dt: Annotated[float | None, AfterValidator(_apart), AfterValidator(_alone)] = Field(
        None, gt=0, description="fixed steps of this length, in the place of rtol and atol"
    )
    max_steps: int | None = Field(
        None, ge=1, le=LARGEST_MAX_STEPS, description="the most steps between two blocks of frames"
    )
    vi_solver: Annotated[ViSolver | None, AfterValidator(_apart)] = Field(
        None, description="of the frozen law; by default that of the model"
    )


class SolverSection(SolverKeys):
    """The same for a contact law, whose steps and tolerances may have units."""

    method: Literal["ETD2RK", "ETD4RK", "ExpRosenbrock", "DormandPrince", "ETD1"] = Field(
        "ETD2RK", description="of a step"
    )
    atol: Annotated[float | None, in_quantity("indentation")] = Field(
        None, gt=0, description="absolute tolerance of a step, an indentation"
    )
    dt_max: Annotated[float | None, in_quantity("time")] = Field(
        None, gt=0, description="the longest step that adapts"
    )
    dt: Annotated[float | None, in_quantity("time"), AfterValidator(_alone)] = Field(
        None, gt=0, description="fixed steps of this length"
    )


class ReportSection(Section):
    """What is written beside the results of any model."""

    report: bool = Field(True, description="write report.html")
    png: bool = Field(True, description="write the figures as PNG")
    checkpoint_seconds: float = Field(
        5.0, ge=0, description="seconds between two checkpoints, from which dvax resume goes on"
    )


class OutputSection(ReportSection):
    """What is written beside the trajectory of a contact law."""

    points_of_interest: list[Annotated[list[Length], BeforeValidator(_as_list)]] | None = Field(
        None, description="places whose histories are shown; each snaps to the nearest point"
    )


SECTIONS: dict[str, type[BaseModel]] = {
    "units": UnitsSection,
    "model": ModelSection,
    "boundary": BoundarySection,
    "demand": DemandSection,
    "load": LoadSection,
    "initial": InitialSection,
    "time": TimeSection,
    "solver": SolverSection,
    "output": OutputSection,
}
OPTIONAL = frozenset({"units", "initial", "solver", "output"})
