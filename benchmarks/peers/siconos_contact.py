"""The contact law in Siconos, as a program that answers one line for every line it reads.

    x' = −a x + d_u λ' + ℓ,   y = b_x x + (1 + b_u) λ − g,   −y ∈ N_[0, κ₀/β](λ)

Every point is a first-order system of its own with a relay of its own, the one-step problem is
solved by projected Gauss-Seidel: of Siconos's layouts and solvers the fastest for this law. It runs
in the Python that has Siconos, needs numpy beside it, and nothing of dvax.

    {"do": "build", "law": {...}, "g": [...], "h": 0.001, "theta": 0.5, "t1": 2.0}  ->  {"n": ...}
    {"do": "advance", "steps": 100}  ->  {"seconds": ...}      stepping alone, nothing else timed
    {"do": "state"}                  ->  {"t": ..., "x": [...]}
"""

import json
import os
import sys
import time
from typing import Any

import numpy as np
import siconos.kernel as kernel
import siconos.numerics as numerics

_TOLERANCE = 1e-12
"""Of the relay problem: its error then stays far below that of the time step."""


class Strip:
    """n points under the Moreau-Euler θ-scheme with steps h."""

    def __init__(self, law: dict[str, float], g: list[float], h: float, theta: float, t1: float):
        rate = law["alpha"] + law["d_x"]
        system = kernel.NonSmoothDynamicalSystem(0.0, t1)
        self.points: list[Any] = []
        # Siconos keeps pointers into these arrays, not references: they must outlive the run.
        self._kept: list[Any] = [system]
        for demand in g:
            point = kernel.FirstOrderLinearDS(
                np.array([law["x0"]]), np.array([[-rate]]), np.array([law["ell"]])
            )
            onto, back = np.array([[law["b_x"]]]), np.array([[-law["d_u"]]])
            own, offset = np.array([[1.0 + law["b_u"]]]), np.array([-demand])
            relation = kernel.FirstOrderLinearTIR(onto, back)
            relation.setDPtr(own)
            relation.setePtr(offset)
            relay = kernel.RelayNSL(1, 0.0, law["kappa0"] / law["beta"])
            interaction = kernel.Interaction(relay, relation)
            system.insertDynamicalSystem(point)
            system.link(interaction, point)
            self.points.append(point)
            self._kept += [onto, back, own, offset, relation, relay, interaction]
        scheme = kernel.EulerMoreauOSI(theta)
        grid = kernel.TimeDiscretisation(0.0, h)
        problem = kernel.Relay(numerics.SICONOS_RELAY_PGS)
        problem.numericsSolverOptions().dparam[numerics.SICONOS_DPARAM_TOL] = _TOLERANCE
        self.loop = kernel.TimeStepping(system, grid, scheme, problem)
        self._kept += [scheme, grid, problem]

    def advance(self, steps: int) -> float:
        """Seconds for that many steps."""
        step, shift = self.loop.computeOneStep, self.loop.nextStep
        start = time.perf_counter()
        for _ in range(steps):
            step()
            shift()
        return time.perf_counter() - start

    def state(self) -> list[float]:
        return [float(point.x()[0]) for point in self.points]


def main() -> None:
    # Siconos prints into the standard output; answers get a channel of their own.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    strip: Strip | None = None
    for line in sys.stdin:
        order = json.loads(line)
        what = order.pop("do")
        if what == "build":
            strip = Strip(**order)
            answer: dict[str, Any] = {"n": len(strip.points)}
        elif strip is None:
            raise ValueError(f"{what!r} came before 'build': there is nothing to step yet")
        elif what == "advance":
            answer = {"seconds": strip.advance(order["steps"])}
        elif what == "state":
            answer = {"t": strip.loop.startingTime(), "x": strip.state()}
        else:
            raise ValueError(f"unknown order {what!r}: build, advance or state")
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
