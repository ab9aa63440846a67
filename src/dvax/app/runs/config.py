"""Configurations: a TOML file in, checked settings with every default filled in out.

`load_config` reads and checks everything that can be checked without running: the syntax, the
schema, the rules between values, the formulas, and every data file. All problems are reported
together.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from dvax.app.runs.blocks import longest_block
from dvax.app.runs.consistency import check_consistency
from dvax.app.runs.contact_inputs import ContactInputs, read_inputs
from dvax.app.runs.fields import Sources
from dvax.app.runs.schema import OPTIONAL, SECTIONS
from dvax.app.runs.schema_errors import translate, unknown_key
from dvax.app.runs.settings import Config as Config
from dvax.app.runs.solver_options import check_dt_max, check_steps
from dvax.app.runs.toml_file import read_toml
from dvax.app.runs.units import Units
from dvax.errors import InputProblem, Problems

_DEFAULT_RTOL = 1e-6
_ATOL_OF_SCALE = 1e-9  # relative to the indentation scale of the model


def load_config(path: str | Path, *, allow_outside: bool = False) -> Config:
    """Read, check and complete a configuration file.

    Defaults are filled in, so the result says everything that a run will do. Data files lie in the
    configuration's folder or below; `allow_outside` lifts that.

    **Raises:** `InputError` with all problems found: syntax (line and column), unknown or missing
    keys, types, units, ranges, contradictions, formulas (column) and data (file, line and column).
    """
    source = Path(path)
    return check_contact(read_toml(source), source, allow_outside)


def build_contact(config: Config) -> ContactInputs:
    """Return the data of a run as arrays and signals. Raises `InputError` where a file has changed and
    is now wrong."""
    inputs = read_inputs(config, config.sources, config.units)
    assert inputs is not None  # all sections are there
    return inputs


def with_points(config: Config, points: int) -> Config:
    """The same configuration on a one-dimensional boundary of other resolution."""
    boundary = config.boundary.model_copy(update={"points": [points]})
    return config.model_copy(update={"boundary": boundary})


def check_contact(raw: dict[str, Any], source: Path, allow_outside: bool) -> Config:
    """The configuration of a contact law, checked and completed."""
    file = source.name
    problems = Problems()
    for key, value in raw.items():
        if key not in SECTIONS:
            problems.append(unknown_key(f"{file}: {key}", key, value, list(SECTIONS)))
    # Where the units are wrong, dimensions are still checked, in the default units.
    units, broken = _section("units", raw.get("units", {}), file, Units())
    problems += broken
    working = units if isinstance(units, Units) else Units()
    sections: dict[str, BaseModel] = {} if units is None else {"units": units}
    for name in SECTIONS:
        if name == "units":
            continue
        if name not in raw and name not in OPTIONAL:
            fix = f"Add [{name}]."
            problems.add(f"{file}: {name}", "nothing", "it is required", fix)
            continue
        section, broken = _section(name, raw.get(name, {}), file, working)
        problems += broken
        if section is not None:
            sections[name] = section
    between = check_consistency(raw, file)
    problems += between
    contradictory = {p.place.removeprefix(f"{file}: ").split(".")[0] for p in between}
    usable = {name: s for name, s in sections.items() if name not in contradictory}
    draft = Config.model_construct(**usable)  # pyright: ignore[reportArgumentType]
    sources = Sources(file, source.parent, allow_outside)
    quoted = frozenset(
        name
        for name in ("demand", "load", "initial")
        if isinstance(raw.get(name), dict) and isinstance(raw[name].get("value"), str)
    )
    draft = _with_defaults(draft, usable)
    edges = raw.get("boundary")
    rectangle = isinstance(edges, dict) and "lengths" in edges and "length" not in edges
    names = ("s1", "s2") if rectangle else ("s",)
    inputs = None
    if "time" in usable and "solver" in usable:
        end = draft.time.end
        with problems.collect():
            check_steps(draft.solver, end, f"the length {end:g}", f"{file}: solver")
    with problems.collect():
        inputs = read_inputs(draft, sources, working, quoted, names)
    problems.raise_any()
    assert inputs is not None
    check_dt_max(
        draft.solver, longest_block(inputs.frame_times, inputs.boundary.size), f"{file}: solver"
    )
    draft._source, draft._allow_outside = source, allow_outside
    return draft


def _section(
    name: str, value: Any, file: str, units: Units
) -> tuple[BaseModel | None, list[InputProblem]]:
    model = SECTIONS[name]
    try:
        return model.model_validate(value, context={"units": units}), []
    except ValidationError as error:
        problems = translate(error, file, name, model)
        refused = {e["loc"][0] for e in error.errors(include_url=False) if e["loc"]}
    if name not in {"demand", "load", "initial"}:
        return None, problems
    # Check the remaining factors too, so that all problems are reported at once.
    rest = {key: v for key, v in value.items() if key not in refused} if refused else {}
    try:
        return model.model_validate(rest, context={"units": units}), problems
    except ValidationError:
        return None, problems  # the problems are reported above


def _with_defaults(draft: Config, usable: Mapping[str, BaseModel]) -> Config:
    """Fill in what depends on the model: tolerances and the companion's perturbation."""
    if "model" not in usable:
        return draft
    # The indentation that carries a point through the active regime (paper,
    # eq:concrete_contact_states).
    model = draft.model
    scale = (1 + model.b_u) * model.kappa0 / (model.beta * model.b_x)
    update: dict[str, BaseModel] = {}
    if "solver" in usable and draft.solver.dt is None:
        solver = draft.solver
        tolerances = {
            "rtol": solver.rtol or _DEFAULT_RTOL,
            "atol": solver.atol or _ATOL_OF_SCALE * scale,
        }
        update["solver"] = solver.model_copy(update=tolerances)
    if "initial" in usable:
        initial, change = draft.initial, {}
        if initial.companion is None:
            change["companion"] = scale
        if initial.value is None and initial.expression is None and initial.profile is None:
            change["value"] = 0.0
        update["initial"] = initial.model_copy(update=change)
    return draft.model_copy(update=update)
