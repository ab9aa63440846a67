"""Circuits in dvax, as a program that answers one line for every line.

It is a process of its own so that NumPy's small factorisations run on one thread, as those of Siconos
do, and so that its memory can be told. Run it from the repository's root as a module.

    {"do": "load", "netlist": ..., "r_on": ..., "g_leak": ..., "along": ..., "ts": [...]}    a netlist,
        with its bound along the trajectory or by constants, or
    {"do": "load", "buck": G, "ts": [...]}    the converter of `buck_converter.py`
    {"do": "run"}     ->  {"seconds": ...}    from t = 0 to the last of ts, saved there alone
    {"do": "result"}  ->  {"seconds": ..., "xs": [...], "bound": ..., "status": ...,
                           "switchings": ..., "memory": ...}

`bound` is the largest at ts, in √J, the energy norm of x (without a netlist: in the Euclidean norm), or
null where it is infinite. `seconds` include compilation. `memory` is the largest resident memory of
the process in MB.
"""

import json
import math
import os
import resource
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvax
from dvax.models import Circuit

from ..buck_converter import problem

_SETTINGS: dict[str, Any] = {"rtol": 1e-8, "atol": 1e-9, "max_steps": 10**7}


def prepare(order: dict[str, Any]) -> tuple[Callable[..., dvax.Solution], Callable[..., Any]]:
    """Return a solver, called with times to save at or None, and the bound of its solution."""
    end = order["ts"][-1]
    if "buck" in order:
        system = problem(order["buck"], end)
        constants = dvax.verify(system, jnp.zeros(5), 0.0, end).constants
        assert constants is not None

        def solve(ts: Any) -> dvax.Solution:
            return dvax.solve(
                system, jnp.zeros(5), 0.0, end, ts=ts, method=dvax.PiecewiseLinear(), **_SETTINGS
            )

        return solve, lambda sol: dvax.bound_error(system, sol, constants)
    circuit = Circuit(order["netlist"], r_on=order.get("r_on"), g_leak=order.get("g_leak"))
    constants = None if order.get("along") else circuit.constants
    return (
        lambda ts: circuit.solve(end, ts, **_SETTINGS),
        lambda sol: dvax.bound_error(circuit.problem, sol, constants),
    )


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    order: dict[str, Any] = {}
    solve, bound = None, None
    for line in sys.stdin:
        given = json.loads(line)
        answer: dict[str, Any] = {}
        if given["do"] == "load":
            order = given
            solve, bound = prepare(order)
        elif given["do"] == "run":
            assert solve is not None
            start = time.perf_counter()
            jax.block_until_ready(solve(None).xs)
            answer = {"seconds": time.perf_counter() - start}
        else:
            assert solve is not None and bound is not None
            start = time.perf_counter()
            sol = solve(np.array(order["ts"]))
            seconds = time.perf_counter() - start
            found = bound(sol)
            largest = float(np.max(np.asarray(found.x)))
            answer = {
                "seconds": seconds,
                "xs": np.asarray(sol.xs).tolist(),
                "bound": largest if math.isfinite(largest) else None,
                "status": found.status,
                "switchings": int(sol.stats["switchings"]),
                "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
            }
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
