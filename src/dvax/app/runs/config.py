"""Configurations: a TOML file in, checked settings with every default filled in out.

`load_config` reads and checks everything that can be checked without running: the syntax, the
schema, the rules between values, the formulas, and every data file. All problems of the tables are
reported together, and where there are none all problems of the data.
"""

from pathlib import Path
from typing import Any

from dvax.app.runs.blocks import longest_block
from dvax.app.runs.contact_inputs import ContactInputs, read_inputs
from dvax.app.runs.schema import OPTIONAL, SECTIONS
from dvax.app.runs.sections import read_sections
from dvax.app.runs.settings import Config as Config
from dvax.app.runs.solver_options import check_dt_max, check_steps
from dvax.app.runs.toml_file import read_toml
from dvax.errors import Problems

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
    return read_inputs(config)


def check_contact(raw: dict[str, Any], source: Path, allow_outside: bool) -> Config:
    """The configuration of a contact law, checked and completed."""
    file = source.name
    sections = read_sections(raw, SECTIONS, file, frozenset(SECTIONS) - OPTIONAL)
    config = _with_defaults(Config.model_validate(sections))
    config._source, config._allow_outside = source, allow_outside
    quoted = frozenset(
        name
        for name in ("demand", "load", "initial")
        if isinstance(raw.get(name, {}).get("value"), str)
    )
    problems, end = Problems(), config.time.end
    with problems.collect():
        check_steps(config.solver, end, f"the length {end:g}", f"{file}: solver")
    with problems.collect():
        inputs = read_inputs(config, quoted)
        block = longest_block(inputs.frame_times, inputs.boundary.size)
        check_dt_max(config.solver, block, f"{file}: solver")
    problems.raise_any()
    return config


def _with_defaults(config: Config) -> Config:
    """Fill in what depends on the model: tolerances and the companion's perturbation."""
    # The indentation that carries a point through the active regime (paper,
    # eq:concrete_contact_states).
    model, solver, initial = config.model, config.solver, config.initial
    scale = (1 + model.b_u) * model.kappa0 / (model.beta * model.b_x)
    if solver.dt is None:
        tolerances = {
            "rtol": solver.rtol or _DEFAULT_RTOL,
            "atol": solver.atol or _ATOL_OF_SCALE * scale,
        }
        solver = solver.model_copy(update=tolerances)
    change = {}
    if initial.companion is None:
        change["companion"] = scale
    if initial.value is None and initial.expression is None and initial.profile is None:
        change["value"] = 0.0
    initial = initial.model_copy(update=change)
    return config.model_copy(update={"solver": solver, "initial": initial})
