"""Run directories from formulas, without a solver, in the format that a run writes."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from dvax.app.runs.rundir import consolidate

KAPPA, BETA = 4.0, 0.8
CONSTANTS = [
    ("strong_monotonicity", "γ", 1.875, "µm/MPa", "eq:concrete_strong_mono", "modulus of F"),
    ("response_lipschitz", "L", 1.0 / 1.5, "1", "eq:concrete_LU_vi", "of u in x"),
    ("decay_rate", "η − ML̃", 0.31, "1/s", "cor:incremental_stability", "certified decay"),
    ("hadamard", "C_T", 1.6667, "1", "eq:concrete_CT", "Hadamard constant on [0, T]"),
    ("slope", "α_h", 3.2e-7, "1", "eq:slope", "a small one"),
    ("growth", "ω", -1.5, "1/s", "eq:growth", "a negative one"),
    ("stiffness", "k", 17000.0, "MPa", "eq:stiffness", "a large one"),
    ("radius", "R", "inf", "um", "eq:radius", "an infinite one"),
]


@dataclass(frozen=True)
class Recipe:
    """The size and the state of a synthetic run."""

    points: tuple[int, ...] = (200,)
    frames: int = 60
    written: int | None = None
    status: str = "finished"
    companion: bool = True
    title: str = "Synthetic strip"


def _fields(recipe: Recipe) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray, np.ndarray]:
    time = np.linspace(0.0, 40.0, recipe.frames)
    lengths = (100.0, 60.0)[: len(recipe.points)]
    axes = [
        (np.arange(n) + 0.5) / n * length for n, length in zip(recipe.points, lengths, strict=True)
    ]
    grids = [grid.ravel() for grid in np.meshgrid(*axes, indexing="ij")]
    names = ["s"] if len(grids) == 1 else ["s1", "s2"]
    waves = np.random.default_rng(5)
    rough = np.zeros(grids[0].size)
    for wave in range(1, 40):
        angle = sum(waves.normal() * grid / side for grid, side in zip(grids, lengths, strict=True))
        rough += wave**-1.3 * np.cos(2 * np.pi * wave * angle + waves.uniform(0, 7))
    load = np.exp(-(((time - 15) / 12) ** 2)) * (3 + 2 * np.sin(1.7 * time) + np.sin(4.1 * time))
    drive = load[:, None] * 1.2 + 1.5 * rough
    return time, dict(zip(names, grids, strict=True)), drive, load


def write_run(folder: Path, recipe: Recipe = Recipe()) -> Path:
    """Write a run directory; `written` frames of `frames` where the run stopped early."""
    folder.mkdir(parents=True)
    time, places, drive, load = _fields(recipe)
    pressure = np.clip(drive, 0.0, KAPPA)
    regime = np.where(drive <= 0, 0, np.where(drive >= KAPPA, 2, 1)).astype(np.int8)
    weight = np.full(drive.shape[1], 100.0 / drive.shape[1])
    decay = np.exp(-0.31 * time)
    norm = "um mm^(1/2)"
    series = {
        "demand_mean": (1.0 + 0 * time, "um", {}),
        "load_mean": (load, "um/s", {}),
        "law_error": (1e-12 * (1 + load), norm, {"status": "proved"}),
        "defect": (1e-5 * time, norm, {}),
        "error_bound_x": (2e-6 * (1 - decay), norm, {"status": "proved"}),
        "error_bound_sharp_x": (1e-6 * (1 - decay), norm, {"status": "proved"}),
        "error_bound_u": (1.4e-6 * (1 - decay) + 1e-12, norm, {"status": "declared"}),
    }
    if recipe.companion:
        series |= {
            "separation_x": (3 * np.exp(-1.1 * time), norm, {}),
            "separation_u": (1.1 * np.exp(-1.1 * time), norm, {}),
            "separation_bound_x": (3 * decay, norm, {}),
            "separation_bound_u": (2 * decay, norm, {}),
            "separation_sharp_x": (3 * np.exp(-0.9 * time), norm, {}),
        }
    fields = {
        "indentation": (1.5 + 0.2 * drive, "um"),
        "pressure": (pressure, "MPa"),
        "regime": (regime, "1"),
    }
    dataset = xr.Dataset(
        {
            name: (("time", "point"), values, {"units": unit})
            for name, (values, unit) in fields.items()
        }
        | {
            name: ("time", values, {"units": unit, **attrs})
            for name, (values, unit, attrs) in series.items()
        },
        coords={
            "time": ("time", time, {"units": "s"}),
            "weight": ("point", weight, {"units": "mm"}),
        }
        | {name: ("point", values, {"units": "mm"}) for name, values in places.items()},
        attrs={
            "title": recipe.title,
            "model": "contact",
            "beta": BETA,
            "kappa0": KAPPA,
            "dvax_version": "0.1.0",
        }
        | ({"boundary_shape": list(recipe.points)} if len(recipe.points) == 2 else {}),
    )
    written = recipe.frames if recipe.written is None else recipe.written
    if written:
        dataset.isel(time=slice(0, written)).to_zarr(folder / "trajectory.zarr", consolidated=False)
        consolidate(folder / "trajectory.zarr")
    manifest = {
        "dvax": "0.1.0",
        "packages": {"jax": "0.10.2", "diffrax": "0.7.2"},
        "python": "3.11.9",
        "precision": "float64",
        "device": "cpu",
        "started": "2026-01-05T10:00:00+00:00",
        "compile_seconds": 1.25,
        "run_seconds": 7.5,
        "steps": 4000,
        "constants": [
            dict(name=n, symbol=s, value=v, unit=u, label=la, status="proved", meaning=m)
            for n, s, v, u, la, m in CONSTANTS
        ],
        "status": recipe.status,
        "stop_reason": "The end time was reached."
        if recipe.status == "finished"
        else "Stopped by Ctrl-C.",
    }
    summary = {
        "peak_pressure": {
            "value": float(pressure[:written].max(initial=0.0)),
            "unit": "MPa",
            "meaning": "Highest pressure over the boundary and the run.",
        },
        "error_bound_x": {
            "value": 2e-6,
            "unit": "um mm^(1/2)",
            "meaning": "bound on ‖x_h − x‖ in L2 at the end (proved)",
            "bound": "proved",
            "relative": 1.6e-7,
        },
        "regimes_seen": {"value": ["unloaded", "active"], "unit": "", "meaning": "Regimes met."},
    }
    (folder / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
    (folder / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    (folder / "config.resolved.toml").write_text(
        "[time]\nend = 40.0\n[output]\npoints_of_interest = []\n", encoding="utf-8"
    )
    events = [
        {"event": "start"},
        {"event": "warning", "message": "A point was snapped to s = 0.25 mm."},
    ]
    (folder / "log.jsonl").write_text(
        "".join(json.dumps(e) + "\n" for e in events), encoding="utf-8"
    )
    return folder
