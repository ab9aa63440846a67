"""Shear frames in OpenSees, as a program that answers one line for every line.

It runs in a Python that imports `openseespy`, and imports nothing of this repository.

    {"do": "load", "mass": [...], "stiffness": [...], "yield_drift": [...], "damping": c,
     "hardening": a, "ground": [...], "step": h}
    {"do": "run", "parts": k}   ->  {"seconds": ..., "drift": [[...], ...], "memory": ...}

Newmark's method with constant average acceleration takes steps of h/k; the drifts are those at the
times of the record. `seconds` are those of the steps alone. `memory` is in MB.
"""

import json
import os
import resource
import sys
import time


def build(given):
    import openseespy.opensees as ops

    ops.wipe()
    ops.model("basic", "-ndm", 1, "-ndf", 1)
    ops.node(0, 0.0)
    ops.fix(0, 1)
    for i, mass in enumerate(given["mass"], 1):
        ops.node(i, 0.0)
        ops.mass(i, mass)
        k, y = given["stiffness"][i - 1], given["yield_drift"][i - 1]
        ops.uniaxialMaterial("Steel01", i, k * y, k, given["hardening"])
        ops.element("zeroLength", i, i - 1, i, "-mat", i, "-dir", 1)
    ops.rayleigh(given["damping"], 0.0, 0.0, 0.0)
    ops.timeSeries("Path", 1, "-dt", given["step"], "-values", *given["ground"])
    ops.pattern("UniformExcitation", 1, 1, "-accel", 1)
    ops.constraints("Plain")
    ops.numberer("Plain")
    ops.system("ProfileSPD")
    ops.test("NormDispIncr", 1e-12, 50)
    ops.algorithm("Newton")
    ops.integrator("Newmark", 0.5, 0.25)
    ops.analysis("Transient")
    return ops


def run(given, parts):
    ops = build(given)
    n, rows, seconds = len(given["mass"]), [[0.0] * len(given["mass"])], 0.0
    for _ in range(len(given["ground"]) - 1):
        start = time.perf_counter()
        failed = ops.analyze(parts, given["step"] / parts)
        seconds += time.perf_counter() - start
        if failed:
            raise RuntimeError("OpenSees did not converge")
        at = [0.0] + [ops.nodeDisp(i, 1) for i in range(1, n + 1)]
        rows.append([at[i + 1] - at[i] for i in range(n)])
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return {"seconds": seconds, "drift": rows, "memory": memory}


def main():
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    given = {}
    for line in sys.stdin:
        order = json.loads(line)
        answer = {}
        if order["do"] == "load":
            given = order
        else:
            answer = run(given, order["parts"])
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
