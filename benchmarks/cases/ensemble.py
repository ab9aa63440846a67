"""Many runs of one problem: against a pool of processes with SciPy, and against `jax.vmap`."""

import os
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import jax
import jax.numpy as jnp
import numpy as np

import dvax

from ..clock import in_turn, spread
from ..peers.scipy_ensemble import METHODS, ends
from ..section import Section, Table, compare

_MEMBERS, _SCIPY_MEMBERS, _VMAP_MEMBERS = 100_000, 2_000, 512
_TOL = 1e-6
_POOL, _VMAP = 50.0, 5.0
_LENGTHS = 20.0


def run(full: bool) -> Section:
    section = Section(
        title=f"ensemble: {_MEMBERS} runs of C1, and runs whose lengths differ",
        fair=(
            f"dvax.ensemble with {_MEMBERS} loads between 2 and 4, rtol {_TOL:g}, as called; SciPy's "
            f"solve_ivp on {_SCIPY_MEMBERS} of them in a pool with a process on each core that is "
            "already running, with the law written by hand in plain Python, at the same tolerance: as "
            f"called, and by the fastest of {', '.join(METHODS)}. Times are per member. Of runs whose "
            f"lengths differ {_LENGTHS:g}-fold (uniform in the logarithm; a clipped periodic drive, "
            f"whose steps are as many as its periods) {_VMAP_MEMBERS} members are compared with "
            "jax.jit(jax.vmap) of dvax.solve with the same method and tolerance."
        ),
    )
    rounds = 7 if full else 3
    _beside_scipy(section, rounds)
    _beside_vmap(section, rounds)
    return section


def _beside_scipy(section: Section, rounds: int) -> None:
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: args - 0.5 * x - u, h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )  # fmt: skip
    loads = np.linspace(2.0, 4.0, _MEMBERS)
    few = loads[:: _MEMBERS // _SCIPY_MEMBERS]
    solve = lambda: dvax.ensemble(  # noqa: E731
        problem, -1.0, 0.0, 2.0, loads, axes=(None, 0), rtol=_TOL, atol=1e-3 * _TOL
    )
    ends_found = np.asarray(solve().values)
    exact = np.asarray(
        dvax.ensemble(problem, -1.0, 0.0, 2.0, few, axes=(None, 0), rtol=1e-12, atol=1e-14).values
    )
    error = np.max(np.abs(ends_found[:: _MEMBERS // _SCIPY_MEMBERS] - exact))
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    pieces = [few[k::200].tolist() for k in range(200)]
    with ProcessPoolExecutor(cores, get_context("spawn")) as pool:

        def by_scipy(method: str) -> list[float]:
            made = pool.map(ends, [method] * len(pieces), pieces, [_TOL] * len(pieces))
            return [end for piece in made for end in piece]

        for method in METHODS:
            by_scipy(method)
        samples = {"dvax": lambda: _seconds(solve) / _MEMBERS} | {
            method: lambda m=method: _seconds(lambda: by_scipy(m)) / _SCIPY_MEMBERS
            for method in METHODS
        }
        taken = in_turn(samples, rounds)
        order = np.argsort(np.concatenate([few[k::200] for k in range(200)]))
        theirs = {method: np.asarray(by_scipy(method))[order] for method in METHODS}
    best = min(METHODS, key=lambda method: spread(taken[method]).middle)
    for method in dict.fromkeys((METHODS[0], best)):
        what = "as called" if method == METHODS[0] else "its fastest method"
        section.comparisons.append(
            compare(
                f"C1, time of a member; SciPy {what}", f"{method}, {cores} processes", taken["dvax"],
                taken[method], direction="other/dvax", error=float(error),
                error_other=float(np.max(np.abs(theirs[method] - exact))),
                target=("≥", _POOL) if method == METHODS[0] else None,
            )
        )  # fmt: skip
    rows = [(name, f"{1e6 * spread(taken[name]).middle:.3g} µs") for name in taken]
    section.tables.append(Table("C1: time of a member", ("by", "time"), rows))


def _beside_vmap(section: Section, rounds: int) -> None:
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: jnp.sin(5 * t) - u,
        h=lambda t, x, u, args: 0.5 * (x + jnp.cos(7 * t)),
    )  # fmt: skip
    rng = np.random.default_rng(0)
    times = 20.0 * np.exp(rng.uniform(-np.log(_LENGTHS), 0.0, _VMAP_MEMBERS))
    starts = rng.uniform(-0.5, 0.5, _VMAP_MEMBERS)
    one = lambda x, t1: dvax.solve(  # noqa: E731
        problem, x, 0.0, t1, rtol=_TOL, method=dvax.DormandPrince(), throw=False
    ).xs[-1]
    batched = jax.jit(jax.vmap(one))
    solve = lambda: dvax.ensemble(  # noqa: E731
        problem, starts, 0.0, times, rtol=_TOL, method=dvax.DormandPrince()
    )
    vmapped = lambda: batched(jnp.asarray(starts), jnp.asarray(times)).block_until_ready()  # noqa: E731
    apart = float(np.max(np.abs(solve().values - np.asarray(vmapped()))))
    taken = in_turn({"dvax": lambda: _seconds(solve), "vmap": lambda: _seconds(vmapped)}, rounds)
    section.comparisons.append(
        compare(
            f"lengths that differ {_LENGTHS:g}-fold, {_VMAP_MEMBERS} members", "jax.vmap",
            taken["dvax"], taken["vmap"], direction="other/dvax", error=apart, target=("≥", _VMAP),
        )
    )  # fmt: skip


def _seconds(run) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start
