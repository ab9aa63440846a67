"""A linear system with complementarity in Siconos, as a program that answers one line for every line.

    x' = A x + B λ + b(t),    0 ≤ y = C x + D λ + e + F r(t) ⟂ λ ≥ 0

by EulerMoreauOSI and an LCP a step. It runs in the Python that has Siconos, needs numpy beside it, and
nothing of dvax.

    {"do": "build", "A": ..., "B": ..., "C": ..., "D": ..., "x0": ..., "h": 1e-6, "steps": 1000} -> {}
    {"do": "run"}  ->  {"seconds": ..., "x": [...]}      from x0 to the end, the stepping alone

Optional: "theta" (½ if absent); "solver": "lemke"; "keep": true for x after every step, as "xs"; "e";
with a row of values for each step, "inputs" with b = inputs · "rate_values", and "F" with
"law_values".
"""

import json
import os
import sys
import time

import numpy as np
import siconos.kernel as sk
import siconos.numerics as sn

_NAMES = ("A", "B", "C", "D", "x0")


def stepping(order):
    A, B, C, D, x0 = (np.array(order[name], float) for name in _NAMES)
    h, steps = order["h"], order["steps"]
    model = sk.NonSmoothDynamicalSystem(0.0, h * (steps + 1))
    rates = np.zeros((1, len(x0)))
    if "inputs" in order:
        rates = np.array(order["rate_values"]) @ np.array(order["inputs"]).T
    offsets = np.zeros((1, len(D))) + np.array(order.get("e", 0.0))
    if "F" in order:
        offsets = offsets + np.array(order["law_values"]) @ np.array(order["F"]).T
    system = sk.FirstOrderLinearDS(x0, A)
    relation = sk.FirstOrderLinearTIR(C, B)
    relation.setDPtr(D)
    # Arrays that Siconos reads in every step, and that the loop below changes.
    rate, offset = sk.SiconosVector(rates[0].tolist()), sk.SiconosVector(offsets[0].tolist())
    system.setbPtr(rate)
    relation.setePtr(offset)
    interaction = sk.Interaction(sk.ComplementarityConditionNSL(len(D)), relation)
    model.insertDynamicalSystem(system)
    model.link(interaction, system)
    grid = sk.TimeDiscretisation(0.0, h)
    problem = sk.LCP(sn.SICONOS_LCP_LEMKE) if order.get("solver") == "lemke" else sk.LCP()
    integrator = sk.EulerMoreauOSI(order.get("theta", 0.5))
    loop = sk.TimeStepping(model, grid, integrator, problem)

    def prepare(k):
        for values, vector in ((rates, rate), (offsets, offset)):
            if len(values) > 1:
                for i, value in enumerate(values[k]):
                    vector.setValue(i, value)

    return loop, system, prepare, (relation, D)


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
            loop, system, prepare, _kept = stepping(built)
            rows, keep = [], built.get("keep")
            start = time.perf_counter()
            for k in range(built["steps"]):
                prepare(k)
                loop.computeOneStep()
                loop.nextStep()
                if keep:
                    rows.append(system.x().tolist())
            answer = {"seconds": time.perf_counter() - start, "x": system.x().tolist()}
            if keep:
                answer["xs"] = rows
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
