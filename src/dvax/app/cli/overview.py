"""An overview of a configured run before it starts: constants, assumptions, verdicts, sizes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dvax.app.runs.applications.config import ModelConfig
    from dvax.app.runs.config import Config
    from dvax.app.runs.contact_inputs import ContactInputs
    from dvax.theory import Assumption

Row = tuple[str, str, str]
ConstantRow = Mapping[str, Any]

FRAME_BYTES = 8 + 8 + 1
"""A saved frame holds indentation and pressure in double precision and the regime in one byte."""
ARRAYS, BASE_BYTES = 100, 550 * 2**20
"""Measured on runs of 24 and of 10⁶ points, report included: arrays of n numbers that live at once
(states, stages and data of the trajectory and its companion), and what JAX, Python and the report take
without any point."""


@dataclass(frozen=True)
class Overview:
    """Rows of the tables that `dvax check` prints, and notes; `fit` says whether an application is in
    the class."""

    fit: str
    constants: Sequence[ConstantRow]
    assumptions: "Sequence[Assumption]"
    verdicts: Sequence[Row]
    sizes: Sequence[Row]
    notes: Sequence[str]


def overview(config: "Config | ModelConfig") -> Overview:
    """Read the data that a checked configuration names, and describe the run. Nothing is solved."""
    from dvax.app.runs.applications.config import ModelConfig

    if isinstance(config, ModelConfig):
        return _of_application(config)
    return _of_contact(config)


def _of_application(config: "ModelConfig") -> Overview:
    from dvax.app.runs.applications.run import constant_rows

    known = config.model.describe()
    files = [("data", f.name, f"sha256 {f.sha256[:16]}…") for f in config.fingerprints()]
    rows = constant_rows(known.constants)
    sizes = [*known.sizes, steps_of_application(config.model.settings), *files]
    return Overview(config.model.fit, rows, known.assumptions, [], sizes, known.notes)


def _of_contact(config: "Config") -> Overview:
    from dvax.app.runs.config import build_contact
    from dvax.app.runs.contact_frames import constant_rows
    from dvax.app.runs.contact_model import assumptions, contact_model

    inputs = build_contact(config)
    constants = contact_model(config, inputs).constants
    # q_ρ is given at ρ = β, the paper's choice.
    rows = constant_rows(constants, config, config.time.end, config.model.beta)
    known = assumptions(config, inputs)
    return Overview("", rows, known, verdicts(rows), sizes(config, inputs), inputs.notices)


def outside_the_class(rows: Sequence[ConstantRow]) -> list[ConstantRow]:
    """The constants that put a system outside the class: γ not positive, or anything refuted."""
    return [
        row
        for row in rows
        if row["status"] == "refuted" or (row["name"] == "gamma" and not row["value"] > 0)
    ]


def verdicts(rows: Sequence[ConstantRow]) -> list[Row]:
    """Statement, verdict and reason. Only the first decides whether the system is in the class."""
    known = {row["name"]: row for row in rows}
    gamma, decay, q = known["gamma"], known["decay_rate"], known["q_rho"]
    statements = (
        ("one response at every state", gamma, gamma["value"] > 0,
         f"γ > 0 ({gamma['label']}); every figure of a run rests on it"),
        ("certified decay", decay, decay["value"] > 0,
         f"η − M L̃ > 0 ({decay['label']}); a run is well posed without it"),
        ("projection route", q, q["value"] < 1,
         f"q_ρ < 1 ({q['label']}); a narrower proof of the first line, not needed"),
    )  # fmt: skip
    # A sufficient condition that fails does not refute the statement.
    return [
        (statement, f"holds, {row['status']}" if holds else "does not hold", reason)
        for statement, row, holds, reason in statements
    ]


def sizes(config: "Config", inputs: "ContactInputs") -> list[Row]:
    """Rows (what, value, remark): points, steps, disk and memory of a run."""
    points, frames = inputs.boundary.size, len(inputs.frame_times)
    shape = " × ".join(map(str, inputs.boundary.shape))
    unit = config.units
    edge = f"{unit.length}²" if len(inputs.boundary.shape) == 2 else unit.length
    measure = float(inputs.boundary.weights.sum())
    return [
        ("points", shape, f"quadrature weights add up to {measure:.6g} {edge}"),
        ("time", f"0 to {config.time.end:.6g} {unit.time}", ""),
        ("frames", str(frames), "saved, the first and the last instant included"),
        ("steps", *_steps(config)),
        ("disk", f"at most {_bytes(points * frames * FRAME_BYTES)}", "before compression"),
        ("memory", f"about {_bytes(BASE_BYTES + points * 8 * ARRAYS)}", "an estimate"),
        *(("data", file.name, f"sha256 {file.sha256[:16]}…") for file in inputs.data_files),
    ]


def _steps(config: "Config") -> tuple[str, str]:
    solver = config.solver
    if solver.dt is not None:
        least = -(-config.time.end // solver.dt)
        return f"at least {least:.0f}", f"{solver.method}, fixed, no longer than {solver.dt:g}"
    return "adaptive", f"{solver.method}, rtol {solver.rtol:g}, atol {solver.atol:g}"


def steps_of_application(settings: Mapping[str, Any]) -> Row:
    """The row of the steps of an application with these settings, the method named."""
    method = settings.get("method")
    name = "chosen from the problem" if method is None else type(method).__name__
    if settings.get("dt") is not None:
        # `dvax.solve` takes this one where steps are given.
        name = "ETD2RK" if method is None else name
        return ("steps", f"fixed, no longer than {settings['dt']:g}", name)
    if name == "PiecewiseLinear":
        return ("steps", "from kink to kink, each solved exactly", name)
    tolerances = [f"{key} {settings[key]:g}" for key in ("rtol", "atol") if key in settings]
    return ("steps", "adaptive", ", ".join([name, *tolerances]))


def _bytes(count: float) -> str:
    for unit in ("B", "KiB", "MiB", "GiB"):
        if count < 1024:
            return f"{count:.3g} {unit}"
        count /= 1024
    return f"{count:.3g} TiB"
