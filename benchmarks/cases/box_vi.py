"""Dense nonsymmetric inequalities on boxes against other solvers, and one factorisation."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jla
import numpy as np

import dvax

from ..clock import Sample, spread, timed
from ..peers import box_solvers
from ..peers.affine_boxes import Affine, affine_boxes
from ..peers.siconos_client import SiconosBox, python
from ..section import Section, compare

_TOL = 1e-10
_SIZES = (100, 1000)
_MANY = 512
_SHARE = 64
"""Of the many problems, so many are given to BOX_QI in each round, and its time is scaled."""
_LEAST = {"BOX_QI": 5.0, "batch": 20.0}
_FACTORISATIONS = 3.0


def run(full: bool) -> Section:
    section = Section(
        title="box_vi: dense nonsymmetric F(y) = My + q on a box, μ = 0.5, to 1e-10",
        fair=(
            "Solutions are known by construction (peers/affine_boxes.py): a third of the entries on "
            "each bound; all start from 0. dvax: solve_vi under jax.jit with M, q and the bounds as "
            "arguments, the default solver, certificate included. Siconos: its box Newton BOX_QI "
            "and Lemke's pivots on the complementarity problem of twice the size, timed inside its "
            "own process, its problem object made beforehand; BOX_QI calls F through Python, which "
            "is one matrix-vector product by BLAS. PATH: its own solver time as GAMS reports it, "
            "in whole milliseconds, not the writing of the model. scipy: root, its default "
            "(MINPACK's hybr), with the exact Jacobian. Extragradient: hand-written in JAX with its "
            "best fixed step. LU: one factorisation of the same M, which no Newton method can "
            "do without; jax and scipy call the same LAPACK. Many problems at once: vmap of the "
            "same call beside a loop over BOX_QI."
        ),
    )
    interpreter = python()
    if interpreter is None:
        section.notes.append("No Python here imports siconos.numerics: its rows are left out.")
    for n in _SIZES:
        _one_size(section, n, interpreter, 15 if full else 7, full)
    _batch(section, interpreter, 9 if full else 5)
    return section


def _solver() -> Callable[..., Any]:
    def solve(M: Any, q: Any, lower: Any, upper: Any) -> Any:
        F = lambda y, args: args[0] @ y + args[1]  # noqa: E731
        K = dvax.sets.Box(lower, upper)
        return dvax.solve_vi(F, K, jnp.zeros_like(q), (M, q), tol=_TOL)

    return solve


def _one_size(section: Section, n: int, interpreter: str | None, rounds: int, full: bool) -> None:
    p = affine_boxes(n, seed=n)
    data = [jnp.asarray(part[0]) for part in p[:4]]
    solve = jax.jit(_solver())
    ours = solve(*data)
    section.notes.append(
        f"n = {n}: dvax chose {ours.solver}; {int(ours.iterations)} iterations, "
        f"{int(ours.evaluations)} evaluations of F; {'successful' if _fine(ours) else 'FAILED'}."
    )
    own_error = _error(ours.y, p)
    samples: dict[str, Sample] = {"dvax": timed(lambda: solve(*data).y.block_until_ready())}
    errors: dict[str, float] = {}

    factor = jax.jit(jla.lu_factor)
    samples["LU, jax"] = timed(lambda: jax.block_until_ready(factor(data[0])))
    samples["LU, scipy"] = timed(functools.partial(_scipy_lu, p.M[0]))
    peers = {"extragradient, JAX": box_solvers.extragradient(p, _TOL)}
    # A second a call at n = 1000: one sample a round is enough, but not of every short run.
    if n <= 100 or full:
        peers["scipy root"] = box_solvers.scipy_root(p, _TOL)
    for name, peer in peers.items():
        errors[name] = _error(peer(), p)
        samples[name] = timed(peer)
    through_path = box_solvers.path(p)
    if isinstance(through_path, str):
        section.notes.append(f"n = {n}: {through_path}")
    else:
        samples["PATH"], answer = through_path
        errors["PATH"] = _error(answer(), p)

    taken: dict[str, list[float]] = {name: [] for name in samples}
    solvers = ("BOX_QI", "Lemke") if n <= 100 or full else ("BOX_QI",)
    if interpreter is None:
        _take(samples, taken, rounds)
    else:
        with SiconosBox(interpreter) as siconos:
            siconos.load(p)
            for name in solvers:
                errors[name] = _error(siconos.solution(name, _TOL, 0), p)
                samples[name] = functools.partial(siconos.seconds, name, _TOL, 0, 1)
                taken[name] = []
            _take(samples, taken, rounds)
    for name, series in taken.items():
        if name == "dvax":
            continue
        bound = name.startswith("LU")
        target = None
        if n == _SIZES[-1] and bound:
            target = ("≤", _FACTORISATIONS)
        elif n == _SIZES[-1] and name == "BOX_QI":
            target = ("≥", _LEAST[name])
        section.comparisons.append(
            compare(
                f"n = {n}",
                f"Siconos {name}" if name in solvers else name,
                taken["dvax"],
                series,
                direction="dvax/other" if bound else "other/dvax",
                error=own_error,
                error_other=errors.get(name),
                target=target,
            )
        )


def _batch(section: Section, interpreter: str | None, rounds: int) -> None:
    n = _SIZES[0]
    p = affine_boxes(n, _MANY, seed=1)
    data = [jnp.asarray(part) for part in p[:4]]
    solve = jax.jit(jax.vmap(_solver()))
    ours = solve(*data)
    unfinished = _MANY - int(np.sum(np.asarray(ours.result == dvax.vi.RESULTS.successful)))
    if unfinished:
        section.notes.append(f"{unfinished} of the {_MANY} problems did not end in success.")
    error = float(np.max(np.abs(np.asarray(ours.y) - p.solution)))
    sample = timed(lambda: solve(*data).y.block_until_ready())
    if interpreter is None:
        section.notes.append(f"{_MANY} problems of n = {n} at once: {spread([sample()]).middle} s.")
        return
    mine, theirs = [], []
    with SiconosBox(interpreter) as siconos:
        siconos.load(p)
        worst = max(
            float(np.max(np.abs(siconos.solution("BOX_QI", _TOL, k) - p.solution[k])))
            for k in range(_MANY)
        )
        for number in range(rounds):
            first = number * _SHARE % _MANY
            theirs.append(siconos.seconds("BOX_QI", _TOL, first, _SHARE) * _MANY / _SHARE)
            mine.append(sample())
    section.comparisons.append(
        compare(
            f"{_MANY} problems, n = {n}",
            "a loop over Siconos BOX_QI",
            mine,
            theirs,
            direction="other/dvax",
            error=error,
            error_other=worst,
            target=("≥", _LEAST["batch"]),
        )
    )


def _take(samples: dict[str, Sample], taken: dict[str, list[float]], rounds: int) -> None:
    names = list(samples)
    for number in range(rounds):
        for name in names[number % len(names) :] + names[: number % len(names)]:
            taken[name].append(samples[name]())


def _scipy_lu(M: np.ndarray) -> object:
    from scipy.linalg import lu_factor

    return lu_factor(M)


def _error(y: Any, p: Affine) -> float:
    return float(np.max(np.abs(np.asarray(y) - p.solution[0])))


def _fine(vi: Any) -> bool:
    return bool(vi.result == dvax.vi.RESULTS.successful)
