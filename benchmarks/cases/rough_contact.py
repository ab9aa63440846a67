"""Rough contact of a half-space: area against load beside the field's solvers, Hertz, and creep."""

import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvax
from dvax.models import RoughContact

from ..clock import in_turn, timed
from ..layout import duration
from ..peers.rough_contact import (
    constrained_cg,
    has_tamaas,
    nonnegative_least_squares,
    tamaas,
)
from ..rough_surface import surface
from ..section import Comparison, Section, Table, Target, compare

_THICKNESS = 3.0
"""Of the layer, in cells: e^{−2kH} is then below the rounding, and only the mean displacement, a rigid
motion, differs from that of a half-space."""
_APPROACHES = (0.5, 1.5, 5.0, 15.0)
"""Relative to the height of the highest point above the mean: light to heavy loads."""
_CG_TOL = 1e-10


def run(full: bool) -> Section:
    section = Section(
        title="rough contact: pressures of a half-space under self-affine surfaces",
        fair=(
            "The same surface, periodic cell, E* = 1 and mean pressure on all sides. dvax: "
            "`RoughContact.equilibrium` from a pressure of zero, as called, one compiled program for "
            "each size. Tamaas 2.9 (C++, FFTW, one core): PolonskyKeerRey at the loosest of the "
            "tolerances 1e-4, 1e-6, … whose pressure is within ten times the error of dvax, or at "
            "1e-10. Constrained CG and NNLS: SciPy as in Bemporad and Paggi 2015, transforms on "
            "all cores. Errors: the largest pressure, relative to the peak, against dvax with a "
            "tolerance of 1e-12."
        ),
    )
    sizes = (256, 512, 1024, 2048) if full else (256, 512)
    areas = Table(
        "Area against load, H = 0.8, root mean square slope h′ = 0.1",
        ("grid", "mean pressure / (E* h′)", "contact area", "area E* h′ / load", "evaluations of F",
         "bound of ‖p − p*‖ / ‖p‖", "dvax"), [],
    )  # fmt: skip
    section.tables.append(areas)
    for n in sizes:
        heights = surface(n)
        for times in _APPROACHES:
            _compare(section, areas, heights, times, 5 if full else 3)
    _small(section, 5 if full else 3)
    section.tables.append(_hertz((64, 128, 256, 512) if full else (64, 128, 256)))
    section.tables.append(_creep(section, (64, 128, 256) if full else (64, 128)))
    if not has_tamaas():
        section.notes.append("Tamaas is not installed (pip install tamaas): its rows are missing.")
    return section


def _model(heights: np.ndarray, approach: Any = 0.0, **more: Any) -> RoughContact:
    return RoughContact(
        profile=heights, lengths=1.0, modulus=1.0, thickness=_THICKNESS, approach=approach, **more
    )


def _approach(heights: np.ndarray, times: float) -> float:
    """An approach of so many heights of the highest point above the mean."""
    return times * float(heights.max() - heights.mean())


def _compare(
    section: Section, areas: Table, heights: np.ndarray, times: float, rounds: int
) -> None:
    n, model = len(heights), _model(heights)
    approach = _approach(heights, times)
    exact = np.asarray(model.equilibrium(approach, tol=1e-12).y)
    found = model.equilibrium(approach)
    mean, peak = exact.mean(), exact.max()
    away = lambda p: float(np.abs(np.asarray(p) - exact).max() / peak)  # noqa: E731
    error = away(found.y)
    assert found.error_bound is not None
    norm = float(model.space.norm(found.y))
    ours = timed(lambda: jax.block_until_ready(model.equilibrium(approach).y))
    row = f"{n}², {np.mean(exact > 0):.1%} in contact"
    base = float(model.operator.symbol[0, 0])
    shifted = heights - heights.max()
    peers: dict[str, tuple[Any, float]] = {
        "constrained CG": (
            lambda: constrained_cg(shifted, approach, base, _CG_TOL),
            away(constrained_cg(shifted, approach, base, _CG_TOL)),
        )
    }
    if has_tamaas():
        for exponent in (4, 6, 8, 10):
            solve = tamaas(heights, mean, 10.0**-exponent)
            peers[f"Tamaas, tolerance 1e-{exponent}"] = (solve, wrong := away(solve()))
            if wrong <= 10 * error or exponent == 10:
                break
            del peers[f"Tamaas, tolerance 1e-{exponent}"]
    taken = in_turn(
        {"ours": ours} | {name: timed(solve) for name, (solve, _) in peers.items()}, rounds,
        enough=60.0,
    )  # fmt: skip
    for name, (_, wrong) in peers.items():
        section.comparisons.append(
            compare(
                row, name, taken["ours"], taken[name], direction="other/dvax", error=error,
                error_other=wrong, target=("≥", 1.0),
            )
        )  # fmt: skip
    areas.rows.append(
        (
            f"{n}²", f"{mean / 0.1:.4f}", f"{np.mean(exact > 0):.4%}",
            f"{np.mean(exact > 0) * 0.1 / mean:.3f}", str(int(found.evaluations)),
            f"{float(found.error_bound) / norm:.0e}", duration(float(np.median(taken["ours"]))),
        )
    )  # fmt: skip


def _small(section: Section, rounds: int) -> None:
    """NNLS needs the dense matrix."""
    heights = surface(40)
    model, approach = _model(heights), _approach(heights, 1.5)
    base, shifted = float(model.operator.symbol[0, 0]), heights - heights.max()
    exact = np.asarray(model.equilibrium(approach, tol=1e-12).y)
    nnls = functools.partial(nonnegative_least_squares, shifted, approach, base)
    ours = timed(lambda: jax.block_until_ready(model.equilibrium(approach).y))
    taken = in_turn({"ours": ours, "nnls": timed(nnls)}, rounds, enough=60.0)
    error, other = (
        float(np.abs(np.asarray(p) - exact).max() / exact.max())
        for p in (model.equilibrium(approach).y, nnls())
    )
    section.comparisons.append(
        compare(
            "40²", "NNLS", taken["ours"], taken["nnls"], direction="other/dvax", error=error,
            error_other=other, target=("≥", 1.0),
        )
    )  # fmt: skip


def _hertz(sizes: tuple[int, ...]) -> Table:
    """A sphere of radius 1 on a cell of length 1, in contact on about a tenth of that length."""
    table = Table(
        "A sphere: p₀³ = 6FE*²/(π³R²) (Hertz), with the force F and the peak pressure p₀ of dvax",
        ("grid", "contact radius", "p₀ / p₀ by Hertz − 1", "time"), [],
    )  # fmt: skip
    for n in sizes:
        s = np.arange(n) / n - 0.5
        model = _model(-(s[:, None] ** 2 + s**2) / 2)
        solve = functools.partial(model.equilibrium, 0.004)
        found = solve()
        force, peak = float(jnp.sum(model.space.w * found.y)), float(found.y.max())
        started = time.perf_counter()
        jax.block_until_ready(solve().y)
        seconds = time.perf_counter() - started
        radius = np.sqrt(float(jnp.mean(found.y > 0)) / np.pi)
        hertz = (6 * force / np.pi**3) ** (1 / 3)
        table.rows.append((f"{n}²", f"{radius:.4f}", f"{peak / hertz - 1:+.2e}", duration(seconds)))
    return table


def _creep(section: Section, sizes: tuple[int, ...]) -> Table:
    """A step of the approach, and creep with c = 2 over three retardation times.

    The contact does not change, so that the state has a closed form (Lee and Radok 1960, J. Appl. Mech.
    27, 438–444): p(t) = λ(t)p(0) and x(t) = (1 − λ(t))P⁻¹p(0), λ = (1 + c e^{−(1+c)t/τ})/(1 + c)."""
    table = Table(
        "Creep under a constant approach (c = 2, t = 3τ), `dvax.solve` with rtol = 1e-3, against the "
        "closed form of Lee and Radok",
        ("grid", "contact area", "p̄ at t = 3τ / at t = 0", "closed form", "steps",
         "error of x / ‖x‖", "bound / ‖x‖", "bound is", "time"), [],
    )  # fmt: skip
    part = (1 + 2 * np.exp(-9)) / 3
    for n in sizes:
        heights = surface(n)
        model = _model(heights, _approach(heights, 1.5), creep=2.0)
        solve = functools.partial(
            dvax.solve, model.problem, model.untouched, 0.0, 3.0, ts=[0.0, 3.0],
            constants=model.constants, rtol=1e-3, atol=1e-5,
        )  # fmt: skip
        found = solve()
        started = time.perf_counter()
        jax.block_until_ready(solve().xs)
        seconds = time.perf_counter() - started
        bound = dvax.bound_error(model.problem, found, model.constants)
        first = model.equilibrium(relaxed=False, tol=1e-13).y
        exact = model.root.apply((1 - part) * model.operator.inverse(first))
        size = float(model.space.norm(exact))
        error = float(model.space.norm(found.xs[-1] - exact)) / size
        most = float(bound.x[-1]) / size
        means = np.mean(np.asarray(found.ys), axis=(1, 2))
        table.rows.append(
            (
                f"{n}²", f"{float(jnp.mean(first > 0)):.2%}", f"{means[1] / means[0]:.6f}",
                f"{part:.6f}", str(int(found.stats["steps"])), f"{error:.1e}", f"{most:.1e}",
                bound.status, duration(seconds),
            )
        )  # fmt: skip
        for target in (Target("≥", 1.0, most / error, "×"), Target("≤", 100.0, most / error, "×")):
            section.comparisons.append(
                Comparison(f"creep, {n}²: bound / error", "", None, None, target=target)
            )
    return table
