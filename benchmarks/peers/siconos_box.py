"""Affine inequalities on boxes in Siconos, as a program that answers one line for every line it reads.

    find y in [lower, upper] with (M y + q)ᵀ(v − y) ≥ 0 for all v in [lower, upper]

BOX_QI is its Newton method on the merit function of Qi, what it has for boxes; Lemke's method gets
the same problem as a complementarity problem of twice the size, y = lower + u with multipliers v of
u ≤ upper − lower. Problem objects are made beforehand; the solver alone is timed. It runs in the
Python that has Siconos, needs numpy beside it, and nothing of dvax.

    {"do": "load", "file": "problems.npz"}  ->  {"count": ...}
    {"do": "solve", "solver": "BOX_QI", "tol": 1e-10, "first": 0, "count": 1}
        ->  {"seconds": ..., "info": ..., "y": [...]}     info: the worst; y: of the last problem
"""

import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import siconos.numerics as numerics

Solve = Callable[[], tuple[int, np.ndarray]]

_KEPT: list[Any] = []
"""Siconos keeps pointers to functions and arrays, not references: these must outlive the problems."""


def box_qi(M: Any, q: Any, lower: Any, upper: Any, tol: float) -> Solve:
    def value(n: int, y: Any, F: Any) -> None:
        np.dot(M, y, out=F)
        F += q

    def slope(n: int, y: Any, J: Any) -> None:
        J[:] = M

    problem = numerics.VI(len(q), value)
    problem.set_box_constraints(lower, upper)
    problem.set_compute_nabla_F(slope)
    options = numerics.SolverOptions(numerics.SICONOS_VI_BOX_QI)
    options.dparam[numerics.SICONOS_DPARAM_TOL] = tol
    _KEPT.extend((value, slope, lower, upper))

    def solve() -> tuple[int, np.ndarray]:
        y, w = np.zeros(len(q)), np.zeros(len(q))
        info = numerics.variationalInequality_box_newton_QiLSA(problem, y, w, options)
        return info, y

    return solve


def lemke(M: Any, q: Any, lower: Any, upper: Any, tol: float) -> Solve:
    n = len(q)
    one = np.eye(n)
    matrix = np.block([[M, one], [-one, np.zeros((n, n))]])
    problem = numerics.LCP(matrix, np.concatenate([M @ lower + q, upper - lower]))
    options = numerics.SolverOptions(numerics.SICONOS_LCP_LEMKE)
    options.dparam[numerics.SICONOS_DPARAM_TOL] = tol

    def solve() -> tuple[int, np.ndarray]:
        z, w = np.zeros(2 * n), np.zeros(2 * n)
        info = numerics.linearComplementarity_driver(problem, z, w, options)
        return info, lower + z[:n]

    return solve


SOLVERS: dict[str, Callable[..., Solve]] = {"BOX_QI": box_qi, "Lemke": lemke}


def main() -> None:
    # Siconos prints into the standard output; answers get a channel of their own.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    problems: list[tuple[Any, ...]] = []
    made: dict[tuple[str, float, int], Solve] = {}
    for line in sys.stdin:
        order = json.loads(line)
        if order["do"] == "load":
            with np.load(order["file"]) as data:
                parts = [data[name] for name in ("M", "q", "lower", "upper")]
            problems, made = list(zip(*parts)), {}
            answer: dict[str, Any] = {"count": len(problems)}
        elif order["do"] == "solve":
            chosen, tol = order["solver"], order["tol"]
            which = range(order["first"], order["first"] + order["count"])
            for number in which:
                if (chosen, tol, number) not in made:
                    made[chosen, tol, number] = SOLVERS[chosen](*problems[number], tol)
            start = time.perf_counter()
            results = [made[chosen, tol, number]() for number in which]
            seconds = time.perf_counter() - start
            info = max(abs(result[0]) for result in results)
            answer = {"seconds": seconds, "info": info, "y": results[-1][1].tolist()}
        else:
            raise ValueError(f"unknown order {order['do']!r}: load or solve")
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
