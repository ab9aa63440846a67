"""A process that does the work of `benchmarks/works.py` on the platform that JAX_PLATFORMS names.

    python -m benchmarks.peers.on_platform

It reads orders as lines of JSON, {"do": "prepare" or "sample", "work": NAME}, and answers each with a
line: the seconds of the first call and where its result is stored, or the seconds of one sample.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

_ROOT = Path(__file__).parents[2]


class Platform:
    """A client of such a process, to be used in a `with` statement.

    `name` is a value of JAX_PLATFORMS, or None for the device that JAX takes by itself.
    """

    def __init__(self, name: str | None):
        self._folder = tempfile.TemporaryDirectory()
        environment: Mapping[str, str] = os.environ
        if name is not None:
            environment = os.environ | {"JAX_PLATFORMS": name}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.peers.on_platform", self._folder.name],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=_ROOT, env=environment,
        )  # fmt: skip

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(timeout=60)
        self._folder.cleanup()

    def send(self, do: str, work: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"do": do, "work": work}) + "\n")
        self._process.stdin.flush()

    def receive(self) -> Any:
        """**Raises:** `RuntimeError` if the process ended; it has printed why."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"the process ended with status {self._process.wait()}")
        return json.loads(line)

    def prepared(self) -> tuple[float, np.ndarray]:
        """Seconds of the first call, and its result."""
        seconds, stored = self.receive()
        return seconds, np.load(stored)

    def sample(self, work: str) -> float:
        self.send("sample", work)
        return self.receive()


def _serve(folder: Path) -> None:
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    from benchmarks.clock import timed
    from benchmarks.works import WORKS

    samples: dict[str, Any] = {}
    for line in sys.stdin:
        order = json.loads(line)
        name = order["work"]
        if order["do"] == "prepare":
            call = WORKS[name].make()
            start = time.perf_counter()
            result = np.asarray(call())
            seconds = time.perf_counter() - start
            stored = folder / f"{len(samples)}.npy"
            np.save(stored, result)
            samples[name] = timed(call)
            print(json.dumps([seconds, str(stored)]), flush=True)
        else:
            print(json.dumps(samples[name]()), flush=True)


if __name__ == "__main__":
    _serve(Path(sys.argv[1]))
