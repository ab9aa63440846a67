"""Linear systems with a relay in Siconos, as a program that answers one line for every line it reads.

    x' = A x + b(t) + B λ,   w = C x + D λ + e,   −w ∈ N_[lower(t), upper(t)](λ)

by the scheme with θ = γ = ½. A relay has one pair of bounds for all its entries, so bounds that
differ or move are brought to 0 and 1: λ = lower + width μ, in which the matrices move. What depends on
time is tabulated beforehand, at the middle of each step, so that a step costs Siconos no call of Python
but its own. It runs in the Python that has Siconos, needs numpy beside it, and nothing of dvax.

    {"do": "build", "race": "heat", "n": 64, "steps": 1000}  ->  {"steps": 1000}
    {"do": "run"}                    ->  {"seconds": ..., "x": [...]}     stepping alone is timed
"""

import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import siconos.kernel as kernel
import siconos.numerics as numerics

_TOLERANCE = 1e-13
"""Of the relay problem: its error then stays far below that of the time step."""
_CHUNK = 1000
"""Steps whose data are tabulated at a time."""


class Relay(NamedTuple):
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    e: np.ndarray
    x0: np.ndarray
    end: float
    load: Callable[[float], np.ndarray]
    box: Callable[[float], tuple[np.ndarray, np.ndarray]] | None
    lower: np.ndarray
    upper: np.ndarray


def contact(n: int) -> Relay:
    one = np.ones((1, 1))
    return Relay(
        A=-1.5 * one, B=-one, C=2.0 * one, D=2.0 * one, e=np.array([-1.0]), x0=np.array([-1.0]),
        end=2.0, load=lambda t: np.array([3.0]), box=None,
        lower=np.array([0.0]), upper=np.array([0.5]),
    )  # fmt: skip


def moving_box(n: int) -> Relay:
    inverse = np.linalg.inv(np.array([[2.0, 0.5], [0.5, 1.0]]))

    def box(t: float) -> tuple[np.ndarray, np.ndarray]:
        return (
            np.array([-5.0, -1.0 + 0.25 * np.cos(2.0 * t)]),
            np.array([1.0 + 0.5 * np.sin(t), 5.0]),
        )

    return Relay(
        A=np.array([[-1.0, 2.0], [-2.0, -1.0]]), B=-np.diag([1.0, 0.5]) @ inverse,
        C=-0.2 * np.eye(2), D=1.5 * inverse, e=np.array([-4.0, 4.0]), x0=np.array([0.3, -0.2]),
        end=4.0, load=lambda t: np.array([1.0, 0.0]), box=box, lower=box(0.0)[0], upper=box(0.0)[1],
    )  # fmt: skip


def heat(n: int) -> Relay:
    width = np.pi / n
    s = (np.arange(n) + 0.5) * width
    second = np.eye(n, k=1) + np.eye(n, k=-1) - 2.0 * np.eye(n)
    second[0, 0] = second[-1, -1] = -3.0
    one = np.eye(n)

    def load(t: float) -> np.ndarray:
        wave = np.exp(-t) * np.sin(s)
        return 0.2 * wave + np.clip((1.0 - 1.5 * wave) / 1.5, 0.0, 0.4)

    return Relay(
        A=second / width**2 - 0.2 * one, B=-one, C=1.5 * one, D=1.5 * one, e=-np.ones(n),
        x0=np.sin(s) + 0.3 * np.sin(2.0 * s), end=1.0, load=load, box=None,
        lower=np.zeros(n), upper=np.full(n, 0.4),
    )  # fmt: skip


RACES = {"contact": contact, "moving_box": moving_box, "heat": heat}


class Run:
    def __init__(self, race: str, n: int, steps: int):
        self.data = data = RACES[race](n)
        self.steps, self.h = steps, data.end / steps
        # Siconos keeps pointers into these arrays, not references: they must outlive the run.
        self.kept: list[Any] = [a.copy(order="F") for a in data[:6]]
        A, B, C, D, e, x0 = self.kept
        self.point = kernel.FirstOrderLinearDS(x0, A, data.load(0.0).copy())
        if data.box is None:
            relation = kernel.FirstOrderLinearTIR(C, B)
            ends = float(data.lower[0]), float(data.upper[0])
        else:
            relation = kernel.FirstOrderLinearR(C, B)
            ends = 0.0, 1.0
        relation.setDPtr(D)
        relation.setePtr(e)
        law = kernel.RelayNSL(data.lower.size, *ends)
        interaction = kernel.Interaction(law, relation)
        system = kernel.NonSmoothDynamicalSystem(0.0, data.end)
        system.insertDynamicalSystem(self.point)
        system.link(interaction, self.point)
        # With its relation taken at the middle of the step too it is of order 2.
        scheme = kernel.EulerMoreauOSI(0.5, 0.5)
        scheme.setUseGamma(True)
        scheme.setUseGammaForRelation(True)
        grid = kernel.TimeDiscretisation(0.0, self.h)
        problem = kernel.Relay(numerics.SICONOS_RELAY_PGS)
        options = problem.numericsSolverOptions()
        options.dparam[numerics.SICONOS_DPARAM_TOL] = _TOLERANCE
        options.iparam[numerics.SICONOS_IPARAM_MAX_ITER] = 100_000
        self.loop = kernel.TimeStepping(system, grid, scheme, problem)
        # These look into the memory that Siconos reads.
        self.places = [self.point.b()]
        if data.box is not None:
            self.places += [relation.B(), relation.C(), relation.D(), relation.e()]
            self._write(self._row(0))
        self.kept += [law, relation, interaction, system, scheme, grid, problem]

    def run(self) -> float:
        """Seconds for all steps."""
        step, shift, seconds = self.loop.computeOneStep, self.loop.nextStep, 0.0
        for first in range(0, self.steps, _CHUNK):
            rows = [self._row(k) for k in range(first, min(first + _CHUNK, self.steps))]
            start = time.perf_counter()
            for row in rows:
                self._write(row)
                step()
                shift()
            seconds += time.perf_counter() - start
        return seconds

    def _row(self, k: int) -> list[np.ndarray]:
        """What step number k is made with."""
        data = self.data
        middle = (k + 0.5) * self.h
        load = data.load(middle)
        if data.box is None:
            return [load]
        lower, upper = data.box(middle)
        width = upper - lower
        scaled = width[:, None] * data.D * width
        return [
            load + data.B @ lower, data.B * width, width[:, None] * data.C, scaled,
            width * (data.e + data.D @ lower),
        ]  # fmt: skip

    def _write(self, row: list[np.ndarray]) -> None:
        for place, value in zip(self.places, row, strict=True):
            place[...] = value


def main() -> None:
    # Siconos prints into the standard output; answers get a channel of their own.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    run: Run | None = None
    for line in sys.stdin:
        order = json.loads(line)
        what = order.pop("do")
        if what == "build":
            run = Run(**order)
            answer: dict[str, Any] = {"steps": run.steps}
        elif what == "run" and run is not None:
            seconds = run.run()
            answer = {"seconds": seconds, "x": [float(v) for v in run.point.x()]}
            run = None
        else:
            raise ValueError(f"cannot {what!r} here: build, then run once")
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
