"""A matrix-free obstacle problem on several grids, and a path of warm starts."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvax

from ..clock import in_turn, timed
from ..layout import duration
from ..multigrid import minus_laplacian, prolong, v_cycle
from ..section import Comparison, Section, Table, Target, compare

_TOL = 1e-8
_SIDES = (128, 256, 512, 1024)
_FIRST = 64
"""Solved from zero; then each grid starts from the last."""
_PATHS = (200, 2000, 6000)
_POINTS = 100
_CONDITIONS = (1.0, 1e2, 1e4)


def run(full: bool) -> Section:
    table = Table(
        f"An obstacle under a membrane: VI with F(y) = −Δy − f, y ≥ ψ, to {_TOL:g} in ‖w‖",
        ("grid", "F", "Newton steps", "residual", "bound of ‖y − y*‖", "in contact", "solve",
         "V-cycles", "FFTs"),
        [],
    )  # fmt: skip
    section = Section(
        title="obstacle: a membrane over an obstacle, no matrix formed",
        fair=(
            "ActiveSet with conjugate gradients, preconditioned by the V-cycle of "
            "benchmarks/multigrid.py, which the caller brings; the guess is the solution of the next "
            "coarser grid, interpolated. Yardsticks, on the same array in the same run: one such "
            "V-cycle, and one real FFT in two dimensions. −Δ has γ = 2π² less than a percent."
        ),
        tables=[table],
    )
    y, side, counts = jnp.zeros((_FIRST - 1, _FIRST - 1)), _FIRST, []
    while side <= _SIDES[-1]:
        if side in _SIDES:
            counts.append(_measure(table, y, side, 7 if full else 3))
        y = prolong(_solve(y).y)
        side *= 2
    spread = max(counts) / min(counts)
    section.comparisons.append(
        Comparison(
            "evaluations of F from 128² to 1024²: most over fewest", "", None, None,
            target=Target("≤", 2.0, spread, "×"),
        )
    )  # fmt: skip
    _without_options(section, 7 if full else 3)
    path = Table(
        "Evaluations of F a solve along a path, each solve started from the one before",
        ("law", "solves a turn", "mean", "most"), [],
    )  # fmt: skip
    section.tables.append(path)
    for name, cubic in (("affine", 0.0), ("with 0.1 y³", 0.1)):
        for solves in _PATHS:
            mean, most = _along_a_path(solves, cubic)
            path.rows.append((name, str(solves), f"{mean:.2f}", str(most)))
        section.comparisons.append(
            Comparison(
                f"evaluations of F a solve, mean of {_PATHS[-1]}, {name}", "", None, None,
                target=Target("≤", 3.0, mean),
            )
        )  # fmt: skip
    section.notes.append(
        "The path: a nonsymmetric law of 100 unknowns in a box, to 1e-10, whose drive turns once "
        "(6000 solves are steps of a thousandth of its time scale); about half of the unknowns are "
        "held, and they change on the way."
    )
    return section


def _data(n: int) -> tuple[float, jax.Array, jax.Array]:
    """The mesh width, the obstacle ψ and the load f at the inner nodes of the unit square."""
    h = 1.0 / (n + 1)
    s = h * (jnp.arange(n) + 1.0)
    a, b = jnp.meshgrid(s, s, indexing="ij")
    hill = 0.25 - 1.5 * ((a - 0.4) ** 2 + (b - 0.5) ** 2)
    return h, hill + 0.05 * jnp.sin(9 * a) * jnp.cos(7 * b), 4.0 * a - 2.0


@jax.jit
def _solve(guess: jax.Array) -> dvax.vi.VISolution:
    n = guess.shape[0]
    h, obstacle, load = _data(n)
    gamma = 0.99 * 2 * np.pi**2
    solver = dvax.vi.ActiveSet(symmetric=True, preconditioner=lambda free, r: v_cycle(free, r, h))
    return dvax.solve_vi(
        lambda y, load: minus_laplacian(y, h) - load, dvax.sets.Box(obstacle, jnp.inf), guess,
        args=load, solver=solver, gamma=gamma, tol=_TOL / gamma,
        space=dvax.spaces.L2(jnp.full((n, n), h * h)),
    )  # fmt: skip


def _measure(table: Table, guess: jax.Array, side: int, rounds: int) -> int:
    n = guess.shape[0]
    found = _solve(guess)
    assert found.result == dvax.vi.RESULTS.successful and found.error_bound is not None
    free = jnp.ones((n, n), bool)
    cycle = jax.jit(functools.partial(v_cycle, h=1.0 / side))
    work: dict[str, Any] = {
        "solve": functools.partial(_solve, guess),
        "cycle": functools.partial(cycle, free, found.y),
        "fft": functools.partial(jax.jit(jnp.fft.rfft2), found.y),
    }
    taken = in_turn(
        {name: timed(lambda f=f: jax.block_until_ready(f())) for name, f in work.items()}, rounds
    )
    ratios = [compare("", "", taken["solve"], taken[name]).ratio for name in ("cycle", "fft")]
    held = float(jnp.mean(found.y <= _data(n)[1]))
    seconds = compare("", "", taken["solve"], taken["fft"]).dvax
    assert seconds is not None
    table.rows.append(
        (
            f"{side}²", str(int(found.evaluations)), str(int(found.iterations)),
            f"{float(found.residual):.1e}", f"{float(found.error_bound):.1e}", f"{held:.0%}",
            duration(seconds), *(f"{r.middle:.0f}" for r in ratios if r is not None),
        )
    )  # fmt: skip
    return int(found.evaluations)


def _without_options(section: Section, rounds: int) -> None:
    """Add laws y + κ(L + 0.3 S)y − b, with the five-point Laplacian L and a skew difference S."""
    table = Table(
        f"{_POINTS}² unknowns, y ≥ 0, F(y) = y + κ(L + sS)y − b, to {_TOL:g} in ‖w‖, from 0",
        ("κ", "s", "solver", "F", "solve", "result"), [],
    )  # fmt: skip
    section.tables.append(table)
    a, b = jnp.meshgrid(*2 * [jnp.linspace(-1.0, 1.0, _POINTS)], indexing="ij")
    load = jnp.exp(-8.0 * ((a - 0.3) ** 2 + b**2)) - 0.4
    solvers = {
        "plain call": None, "Accelerated": dvax.vi.Accelerated(), "GoldenRatio": dvax.vi.GoldenRatio(),
        "Extragradient": dvax.vi.Extragradient(),
    }  # fmt: skip

    def law(y: jax.Array, args: tuple[jax.Array, jax.Array]) -> jax.Array:
        kappa, skew = args
        v = jnp.pad(y, 1)
        east, west = v[1:-1, 2:], v[1:-1, :-2]
        coupling = 4.0 * y - east - west - v[2:, 1:-1] - v[:-2, 1:-1] + skew * (east - west)
        return y + kappa * coupling - (1.0 + jnp.sqrt(kappa)) * load

    for kappa in _CONDITIONS:
        for skew in (0.0, 0.3):
            solves, found = {}, {}
            for name, solver in solvers.items():
                if name == "Accelerated" and skew:
                    continue
                solves[name] = functools.partial(
                    dvax.solve_vi, law, dvax.sets.Box(0.0, jnp.inf), jnp.zeros_like(load),
                    (jnp.asarray(kappa), jnp.asarray(skew)), solver, _TOL,
                )  # fmt: skip
                found[name] = solves[name]()
            taken = in_turn(
                {n: timed(lambda f=f: jax.block_until_ready(f().y)) for n, f in solves.items()},
                rounds,
            )
            for name, vi in found.items():
                seconds = compare("", "", taken[name], taken["plain call"]).dvax
                assert seconds is not None
                chosen = f"{name}: {vi.solver}" if solvers[name] is None else name
                solved = "solved" if vi.result == dvax.vi.RESULTS.successful else "not solved"
                cost = str(int(vi.evaluations)), duration(seconds)
                table.rows.append((f"{kappa:g}", f"{skew:g}", chosen, *cost, solved))


def _along_a_path(solves: int, cubic: float) -> tuple[float, int]:
    """The mean and the largest number of evaluations a solve, each solve started from the last."""
    n = 100
    rng = np.random.default_rng(0)
    half = rng.normal(size=(n, n))
    skew = rng.normal(size=(n, n))
    matrix = jnp.asarray(half @ half.T / n + np.eye(n) + (skew - skew.T) / np.sqrt(n))
    drives = jnp.asarray(3 * rng.normal(size=(2, n)))

    def law(y: jax.Array, angle: jax.Array) -> jax.Array:
        drive = jnp.cos(angle) * drives[0] + jnp.sin(angle) * drives[1]
        return matrix @ y + cubic * y**3 - drive

    def step(y: jax.Array, angle: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        found = dvax.solve_vi(law, dvax.sets.Box(-1.0, 1.0), y, args=angle, gamma=1.0)
        return found.y, (found.evaluations, found.result == dvax.vi.RESULTS.successful)

    angles = jnp.linspace(0.0, 2 * jnp.pi, solves)
    _, (counts, solved) = jax.jit(lambda y: jax.lax.scan(step, y, angles))(jnp.zeros(n))
    assert bool(jnp.all(solved))
    return float(jnp.mean(counts[1:])), int(jnp.max(counts[1:]))
