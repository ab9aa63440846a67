"""A client for Siconos: it starts the Python that has Siconos, and exchanges lines with it."""

import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from ..contact_law import ContactLaw
from .affine_boxes import Affine
from .process import Process

_HERE = Path(__file__).parent
_PYTHONS = (sys.executable, "/usr/bin/python3", "python3")
_ENVIRONMENT = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
"""Its matrices are small: several threads would wait for one another, a hundred times as long."""
_LETTERS = ("alpha", "beta", "b_x", "b_u", "d_x", "d_u", "kappa0", "ell", "x0")


def python() -> str | None:
    """A Python that imports Siconos: this one, the system's (Debian: python3-siconos), or None."""
    for candidate in _PYTHONS:
        try:
            answer = subprocess.run(
                [candidate, "-c", "import siconos.kernel, siconos.numerics"],
                capture_output=True, timeout=60, check=False,
            )  # fmt: skip
        except OSError:
            continue
        if answer.returncode == 0:
            return candidate
    return None


class _Running(Process):
    """A running Siconos process, to be used in a `with` statement.

    Some of its solvers report success with NaN, and print a warning where they did not converge:
    answers are checked here, and `said` gives back what was printed.
    """

    def __init__(self, interpreter: str, program: str):
        files = ExitStack()
        file = tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace")
        self._print = files.enter_context(file)
        command = [interpreter, str(_HERE / program)]
        super().__init__(command, files, stderr=self._print, env=_ENVIRONMENT)

    def said(self) -> str:
        """What Siconos has printed so far."""
        self._print.seek(0)
        return self._print.read().strip()

    def _ask(self, **order: Any) -> dict[str, Any]:
        self.send(**order)
        return self.receive()


class Siconos(_Running):
    """The contact law (`siconos_contact.py`)."""

    def __init__(self, interpreter: str):
        super().__init__(interpreter, "siconos_contact.py")

    def build(self, law: ContactLaw, h: float, theta: float, t1: float) -> None:
        letters = {name: getattr(law, name) for name in _LETTERS}
        self._ask(do="build", law=letters, g=law.g.tolist(), h=h, theta=theta, t1=t1)

    def advance(self, steps: int) -> float:
        """Seconds for that many steps."""
        return self._ask(do="advance", steps=steps)["seconds"]

    def state(self) -> np.ndarray:
        """x now.

        **Raises:** `RuntimeError` where an entry is not finite.
        """
        x = np.array(self._ask(do="state")["x"])
        bad = np.flatnonzero(~np.isfinite(x))
        if bad.size:
            raise RuntimeError(
                f"Siconos returned {x[bad[0]]} at point {bad[0]} without reporting a failure: its "
                "times are not those of a solution"
            )
        return x


class SiconosBox(_Running):
    """Affine inequalities on boxes (`siconos_box.py`)."""

    def __init__(self, interpreter: str):
        super().__init__(interpreter, "siconos_box.py")

    def load(self, problems: Affine) -> None:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "problems.npz"
            np.savez(file, **problems._asdict())
            self._ask(do="load", file=str(file))

    def seconds(self, solver: str, tol: float, first: int, count: int) -> float:
        """For so many of the problems, one after the other."""
        return self._ask(do="solve", solver=solver, tol=tol, first=first, count=count)["seconds"]

    def solution(self, solver: str, tol: float, which: int) -> np.ndarray:
        """**Raises:** `RuntimeError` where Siconos fails, or returns what is not finite."""
        answer = self._ask(do="solve", solver=solver, tol=tol, first=which, count=1)
        y = np.array(answer["y"])
        if answer["info"] != 0 or not np.all(np.isfinite(y)):
            raise RuntimeError(f"Siconos {solver} ended with info = {answer['info']}")
        return y


class SiconosRaces(_Running):
    """The races that are linear systems with a relay (`siconos_races.py`)."""

    names = ("contact", "moving_box", "heat")

    def __init__(self, interpreter: str):
        super().__init__(interpreter, "siconos_races.py")

    def run(self, race: str, n: int, steps: int) -> tuple[float, np.ndarray]:
        """Seconds for the steps, and x at the end, which may not be finite."""
        self._ask(do="build", race=race, n=n, steps=steps)
        answer = self._ask(do="run")
        return answer["seconds"], np.array(answer["x"])


class DvaxCircuits(Process):
    """Circuits in dvax, in a process with one thread (`dvax_circuits.py`)."""

    def __init__(self) -> None:
        command = [sys.executable, "-m", "benchmarks.peers.dvax_circuits"]
        super().__init__(command, ExitStack(), env=_ENVIRONMENT, cwd=_HERE.parents[1])

    def load(self, ts: np.ndarray, **system: Any) -> None:
        self.send(do="load", ts=ts.tolist(), **system)
        self.receive()

    def seconds(self) -> float:
        """For one run to the end, as called."""
        self.send(do="run")
        return self.receive()["seconds"]

    def result(self) -> dict[str, Any]:
        """The answer to "result", with x at `ts` as an array."""
        self.send(do="result")
        answer = self.receive()
        return answer | {"xs": np.array(answer["xs"])}


class SiconosCircuit(_Running):
    """Linear circuits with ideal diodes (`siconos_circuit.py`)."""

    def __init__(self, interpreter: str):
        super().__init__(interpreter, "siconos_circuit.py")

    def build(self, matrices: dict[str, Any], h: float, steps: int, **options: Any) -> None:
        """`options` are those that `siconos_circuit.py` lists."""
        self._ask(do="build", **matrices, h=h, steps=steps, **options)

    def run(self) -> tuple[float, np.ndarray]:
        """Seconds for the steps, and x at the end.

        **Raises:** `RuntimeError` where an entry is not finite.
        """
        answer = self._ask(do="run")
        x = np.array(answer["x"])
        if not np.all(np.isfinite(x)):
            raise RuntimeError("Siconos returned a state that is not finite")
        return answer["seconds"], x

    def trajectory(self) -> np.ndarray:
        """x after every step of a system built with keep=True."""
        return np.array(self._ask(do="run")["xs"])
