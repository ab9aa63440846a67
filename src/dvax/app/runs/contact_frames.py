"""The contact law's frames: which variables a saved time has, and how a block of them is made."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dvax.app.runs.contact_inputs import ContactInputs
from dvax.app.runs.json_files import json_ready
from dvax.app.runs.run import assumption_rows
from dvax.app.runs.settings import Config
from dvax.evolution import Solution
from dvax.models import Contact
from dvax.spaces import AbstractSpace
from dvax.theory import Assumption, Bound, Constants, Row


def coordinates(inputs: ContactInputs, config: Config) -> dict[str, Any]:
    """The boundary's points and weights."""
    boundary, length = inputs.boundary, config.units.length
    out: dict[str, Any] = {
        name: (("point",), values, {"long_name": f"place on the boundary, {name}", "units": length})
        for name, values in zip(boundary.names, boundary.coordinates, strict=True)
    }
    measure = length if len(boundary.names) == 1 else f"{length}^2"
    meta = {"long_name": "quadrature weight", "units": measure}
    out["weight"] = (("point",), boundary.weights, meta)
    return out


def norm_unit(config: Config, dimensions: int) -> str:
    """The unit of an L2 norm of an indentation over a curve or a surface."""
    length = config.units.length
    return f"{config.units.indentation} {length}" + ("^(1/2)" if dimensions == 1 else "")


def variables(config: Config, dimensions: int) -> dict[str, Any]:
    """Name -> (dimensions, type, attributes) of everything that is saved."""
    u = config.units
    x, p, t = u.indentation, u.pressure, u.time
    norm = norm_unit(config, dimensions)
    rate = f"{x}/{t}"
    fields = {
        "indentation": ("indentation x", x, np.float64, {}),
        "pressure": ("contact pressure y = beta u", p, np.float64, {}),
        "regime": (
            "contact regime", "1", np.int8,
            {"flag_values": [0, 1, 2], "flag_meanings": "unloaded active saturated"},
        ),
    }  # fmt: skip
    series = {
        "demand_mean": ("mean indentation demand g", x),
        "load_mean": ("mean load ell", rate),
        "law_error": ("certified bound on ||u - u*|| of the law", norm),
        "defect": ("accumulated defect of the trajectory", norm),
        "error_bound_x": ("bound on ||x_h - x||", norm),
        "error_bound_u": ("bound on ||u_h - u||", norm),
        "error_bound_sharp_x": ("bound on ||x_h - x||, one-sided rate", norm),
        "separation_x": ("||x1 - x2|| of two trajectories", norm),
        "separation_u": ("||u1 - u2|| of two trajectories", norm),
        "separation_bound_x": ("certified bound on ||x1 - x2||", norm),
        "separation_bound_u": ("certified bound on ||u1 - u2||", norm),
        "separation_sharp_x": ("bound on ||x1 - x2||, one-sided rate", norm),
    }
    return {
        name: (("time", "point"), dtype, {"long_name": words, "units": unit, **more})
        for name, (words, unit, dtype, more) in fields.items()
    } | {
        name: (("time",), np.float64, {"long_name": words, "units": unit})
        for name, (words, unit) in series.items()
    }


def constant_rows(constants: Constants, config: Config, T: float, rho: float) -> list[dict]:
    """The table of constants as the report shows it, with units."""
    x, p, t = config.units.indentation, config.units.pressure, config.units.time
    compliance = dict.fromkeys(("gamma", "L_F", "m_P", "norm_P_inv"), f"{x}/{p}")
    rates = (
        "alpha_f",
        "beta_f",
        "omega",
        "L_tilde",
        "growth_rate",
        "decay_rate",
        "sharp_decay_rate",
    )
    units = {**compliance, **dict.fromkeys(rates, f"1/{t}")}

    def one(row: Row) -> dict[str, Any]:
        return {**row._asdict(), "unit": units.get(row.name, "1")}

    return [one(row) for row in constants.table(T, rho)]


def attributes(
    config: Config,
    title: str,
    rows: Sequence[Mapping[str, Any]],
    shape: tuple[int, ...],
    known: tuple[Assumption, ...],
) -> dict[str, Any]:
    """Attributes of the whole dataset."""
    return {
        "title": title,
        "model": "contact",
        "beta": config.model.beta,
        "kappa0": config.model.kappa0,
        "reaction": "the normalised reaction u is pressure / beta",
        "boundary_shape": list(shape),
        "constants": json.dumps(json_ready(list(rows)), ensure_ascii=False),
        "assumptions": json.dumps(assumption_rows(known), ensure_ascii=False),
    }


def block_values(
    model: Contact,
    space: AbstractSpace,
    main: Solution,
    other: Solution,
    bound: Bound,
    apart: float | None,
) -> dict[str, np.ndarray]:
    """All variables at the saved times of a block. `apart` holds ‖Δx₀‖ of the companion, None where
    the block begins with it."""
    assert bound.x_sharp is not None and main.law_error is not None
    frames = _of_frames(model, space, main.ts, (main.xs, main.us), (other.xs, other.us))
    values = {name: np.asarray(value) for name, value in frames.items()}
    c, ts = model.constants, np.asarray(main.ts)
    # Roundoff of the distance of two computed states of this size.
    rounding = 64 * np.finfo(main.xs.dtype).eps * values.pop("size")
    initial = values["separation_x"][0] if apart is None else apart
    certified = float(c.M) * np.exp(c.growth_rate * ts) * initial + rounding
    return {
        **values,
        "indentation": np.asarray(main.xs),
        "pressure": np.asarray(main.ys),
        "law_error": np.asarray(main.law_error),
        "error_bound_x": np.asarray(bound.x_paper),
        "error_bound_u": np.asarray(bound.u_paper),
        "error_bound_sharp_x": np.asarray(bound.x_sharp),
        "separation_bound_x": certified,
        "separation_bound_u": c.L * certified,
        "separation_sharp_x": np.exp(-c.sharp_decay_rate * ts) * initial + rounding,
    }


@jax.jit
def _of_frames(
    model: Contact, space: AbstractSpace, ts: Any, main: Any, other: Any
) -> dict[str, jax.Array]:
    measure = space.size()

    def one(frame: tuple[Any, Any, Any]) -> dict[str, jax.Array]:
        t, (x, u), (companion_x, companion_u) = frame
        ones = jnp.ones_like(x)
        return {
            "regime": model.regimes(t, x),
            "demand_mean": space.inner(model.g(t) * ones, ones) / measure,
            "load_mean": space.inner(model.ell(t) * ones, ones) / measure,
            "separation_x": space.norm(x - companion_x),
            "separation_u": space.norm(u - companion_u),
            "size": space.norm(x),
        }

    return jax.lax.map(one, (ts, main, other))
