"""A linear system with complementarity in Siconos, as a program that answers one line for every line.

    x' = A x + B λ,    0 ≤ y = C x + D λ ⟂ λ ≥ 0

by EulerMoreauOSI with θ = ½ and an LCP a step. It runs in the Python that has Siconos, needs numpy
beside it, and nothing of dvax.

    {"do": "build", "A": ..., "B": ..., "C": ..., "D": ..., "x0": ..., "h": 1e-6, "steps": 1000} -> {}
    {"do": "run"}  ->  {"seconds": ..., "x": [...]}      from x0 to the end, the stepping alone
"""

import json
import os
import sys
import time

import numpy as np
import siconos.kernel as sk

_NAMES = ("A", "B", "C", "D", "x0")


def stepping(order):
    A, B, C, D, x0 = (np.array(order[name], float) for name in _NAMES)
    h, steps = order["h"], order["steps"]
    model = sk.NonSmoothDynamicalSystem(0.0, h * (steps + 1))
    system = sk.FirstOrderLinearDS(x0, A)
    relation = sk.FirstOrderLinearTIR(C, B)
    relation.setDPtr(D)
    interaction = sk.Interaction(sk.ComplementarityConditionNSL(len(D)), relation)
    model.insertDynamicalSystem(system)
    model.link(interaction, system)
    grid = sk.TimeDiscretisation(0.0, h)
    loop = sk.TimeStepping(model, grid, sk.EulerMoreauOSI(0.5), sk.LCP())
    return loop, system, (relation, D)


def main():
    # Siconos prints into the standard output; answers get a channel of their own.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    built = {}
    for line in sys.stdin:
        order = json.loads(line)
        answer = {}
        if order["do"] == "build":
            built = order
        else:
            loop, system, _kept = stepping(built)
            start = time.perf_counter()
            for _ in range(built["steps"]):
                loop.computeOneStep()
                loop.nextStep()
            answer = {"seconds": time.perf_counter() - start, "x": system.x().tolist()}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
