"""A client for OpenSees: it starts a Python that has openseespy, and exchanges lines with it."""

import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from ..yielding_frames import Frame
from .process import Process

_PROGRAM = Path(__file__).with_name("opensees_frame.py")


def python() -> str | None:
    """Return a Python that imports openseespy, or None. `DVAX_OPENSEES` may name one."""
    for candidate in (os.environ.get("DVAX_OPENSEES"), sys.executable, "python3"):
        try:
            command = [candidate or "", "-c", "import openseespy.opensees"]
            answer = subprocess.run(command, capture_output=True, timeout=60, check=False)
        except OSError:
            continue
        if answer.returncode == 0:
            return candidate
    return None


class OpenSees(Process):
    """Shear frames (`opensees_frame.py`), to be used in a `with` statement."""

    def __init__(self, interpreter: str):
        files = ExitStack()
        file = tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace")
        self._print = files.enter_context(file)
        super().__init__([interpreter, str(_PROGRAM)], files, stderr=self._print)

    def said(self) -> str:
        """Return what OpenSees has printed so far."""
        self._print.seek(0)
        return self._print.read().strip()

    def load(self, frame: Frame, ground: np.ndarray, step: float) -> None:
        given = {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in frame._asdict().items()
        }
        self.send(do="load", ground=ground.tolist(), step=step, **given)
        self.receive()

    def run(self, parts: int) -> dict[str, Any]:
        """Return seconds, the drifts at the times of the record, and the memory in MB."""
        self.send(do="run", parts=parts)
        answer = self.receive()
        return answer | {"drift": np.array(answer["drift"])}
