"""How large a run will be: points, steps, disk and memory, before it starts."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dvax.app.runs.config import Config
    from dvax.app.runs.contact_inputs import ContactInputs

Row = tuple[str, str, str]

# A saved frame holds indentation and pressure in double precision and the regime in one byte.
FRAME_BYTES = 8 + 8 + 1
# Measured on runs of 24 and of 10⁶ points, report included: arrays of n numbers that live at once
# (states, stages and data of the trajectory and its companion), and what JAX, Python and the report
# take without any point.
ARRAYS, BASE_BYTES = 100, 550 * 2**20


def sizes(config: "Config", inputs: "ContactInputs") -> list[Row]:
    """Rows (what, value, remark)."""
    points, frames = inputs.boundary.size, len(inputs.frame_times)
    shape = " × ".join(map(str, inputs.boundary.shape))
    unit = config.units
    edge = f"{unit.length}²" if len(inputs.boundary.shape) == 2 else unit.length
    measure = float(inputs.boundary.weights.sum())
    rows: list[Row] = [
        ("points", shape, f"quadrature weights add up to {measure:.6g} {edge}"),
        ("time", f"0 to {config.time.end:.6g} {unit.time}", ""),
        ("frames", str(frames), "saved, the first and the last instant included"),
        ("steps", *_steps(config)),
        ("disk", f"at most {_bytes(points * frames * FRAME_BYTES)}", "before compression"),
        ("memory", f"about {_bytes(BASE_BYTES + points * 8 * ARRAYS)}", "an estimate"),
    ]
    for file in inputs.data_files:
        rows.append(("data", file.name, f"sha256 {file.sha256[:16]}…"))
    return rows


def _steps(config: "Config") -> tuple[str, str]:
    solver = config.solver
    if solver.dt is not None:
        least = -(-config.time.end // solver.dt)
        return f"at least {least:.0f}", f"{solver.method}, fixed, no longer than {solver.dt:g}"
    return "adaptive", f"{solver.method}, rtol {solver.rtol:g}, atol {solver.atol:g}"


def _bytes(count: float) -> str:
    for unit in ("B", "KiB", "MiB", "GiB"):
        if count < 1024:
            return f"{count:.3g} {unit}"
        count /= 1024
    return f"{count:.3g} TiB"
