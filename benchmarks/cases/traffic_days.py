"""Day-to-day traffic: 40 days from all or nothing, and its law beside a first-order method."""

import resource
import time

import jax
import jax.numpy as jnp
import numpy as np

import dvax
from dvax.models.traffic import Traffic
from dvax.vi import Accelerated, FrozenVI

from ..section import Section, Table, compare
from .traffic import networks

_STEP, _END = 0.25, 40.0
_LAWS = (0.0, 1.0, 4.0, 16.0)
_AT = ", ".join(f"{day:g}" for day in _LAWS)
_GAP = 1e-6
_MAX_ITERATIONS = 20_000
_PAIRS = 10_000


def run(full: bool) -> Section:
    section = Section(
        title="traffic_days: 40 days of day-to-day traffic, and its law alone",
        fair=(
            f"Steps of {_STEP} days with certificates, as `dvax run` has them; equilibria to a gap "
            f"of {_GAP:.0e}. Laws: a step after the days {_AT}, from the "
            "response at that day, with dvax.vi.Accelerated to the same tolerance, which knows L_F; "
            "under jax.jit, errors are ‖w‖. Networks of more than 10⁴ pairs with --full alone."
        ),
    )
    rows = []
    for name, (network, trips, weights) in networks(section).items():
        if len(trips) > _PAIRS and not full:
            continue
        toll, distance = weights
        started = time.process_time()
        model = Traffic(network, trips, toll_weight=toll, distance_weight=distance, gap=_GAP)
        generated = time.process_time() - started
        days = np.sort([*_LAWS, *(day + _STEP for day in _LAWS), _END])
        started, on_the_clock = time.process_time(), time.perf_counter()
        solution = dvax.solve(
            model.problem, model.all_or_nothing(), 0.0, _END, ts=days, dt=_STEP, measure=True,
            vi_solver=model.vi_solver, constants=model.constants,
        )  # fmt: skip
        spent, waited = time.process_time() - started, time.perf_counter() - on_the_clock
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        assert solution.defect is not None and solution.law_defect is not None
        rows.append(
            (
                name, str(len(network)), str(len(trips)), str(len(model.paths.lengths)),
                f"{generated:.1f}", f"{spent:.1f}", f"{waited:.1f}",
                f"{solution.stats['compile_time']:.1f}",
                f"{peak:.2f}", f"{float(solution.defect[-1]):.1e}",
                f"{float(solution.law_defect[-1]):.1e}",
            )
        )  # fmt: skip
        _laws(section, name, model, solution, 3 if full else 1)
    header = (
        "network", "links", "pairs", "paths", "CPU-s of the equilibrium", "CPU-s of 40 days",
        "seconds of 40 days", "of them compiling [s]", "peak memory so far [GB]", "defect in time",
        "defect of the law",
    )  # fmt: skip
    section.tables.append(Table(f"40 days in steps of {_STEP}", header, rows))
    return section


def _laws(
    section: Section, name: str, model: Traffic, solution: dvax.Solution, rounds: int
) -> None:
    """A law a step after each of the days, in both ways."""
    problem, newton = model.problem, model.vi_solver
    first_order = Accelerated(max_steps=_MAX_ITERATIONS)
    space = problem.spaces(solution.xs[0])[1]

    def solved(x, guess, tol, solver):
        vi = FrozenVI(problem.frozen(0.0, x), problem.set_at(0.0), space, 1.0, model.constants.L_F)
        return solver.solve(vi, guess, tol)

    ways = {
        "ours": jax.jit(lambda x, guess, tol: solved(x, guess, tol, newton)),
        "theirs": jax.jit(lambda x, guess, tol: solved(x, guess, tol, first_order)),
    }
    at = {float(t): k for k, t in enumerate(np.asarray(solution.ts))}
    for day in _LAWS:
        x, guess = solution.xs[at[day + _STEP]], solution.us[at[day]]
        tol = jnp.asarray(newton.least)
        taken: dict[str, list[float]] = {way: [] for way in ways}
        found = {way: call(x, guess, tol) for way, call in ways.items()}
        for _ in range(rounds):
            for way, call in ways.items():
                started = time.perf_counter()
                jax.block_until_ready(call(x, guess, tol).y)
                taken[way].append(time.perf_counter() - started)
        one, other = found["ours"], found["theirs"]
        counts = f"{int(one.iterations)} iterations against {int(other.iterations)}"
        section.comparisons.append(
            compare(
                f"{name}, day {day:g}: {counts}",
                "dvax.vi.Accelerated", taken["ours"], taken["theirs"],
                error=float(one.residual), error_other=float(other.residual),
            )
        )  # fmt: skip
