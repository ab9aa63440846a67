"""A process that runs `benchmarks/workloads.py` on the platform that JAX_PLATFORMS names.

    python -m benchmarks.peers.on_platform

It reads orders as lines of JSON, {"do": "prepare" or "sample", "workload": NAME}, and answers each with
a line: the seconds of the first call and where its result is stored, or the seconds of one sample.
"""

import json
import os
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from .process import Process

_ROOT = Path(__file__).parents[2]


class Platform(Process):
    """A client of such a process.

    `name` is a value of JAX_PLATFORMS, or None for the device that JAX takes by itself.
    """

    def __init__(self, name: str | None):
        files = ExitStack()
        folder = files.enter_context(tempfile.TemporaryDirectory())
        chosen = {} if name is None else {"JAX_PLATFORMS": name}
        super().__init__(
            [sys.executable, "-m", "benchmarks.peers.on_platform", folder], files, cwd=_ROOT,
            env=os.environ | chosen,
        )  # fmt: skip

    def prepared(self) -> tuple[float, np.ndarray]:
        """Seconds of the first call, and its result."""
        seconds, stored = self.receive()
        return seconds, np.load(stored)

    def sample(self, workload: str) -> float:
        self.send(do="sample", workload=workload)
        return self.receive()


def _serve(folder: Path) -> None:
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    from benchmarks.clock import timed
    from benchmarks.workloads import WORKLOADS

    samples: dict[str, Any] = {}
    for line in sys.stdin:
        order = json.loads(line)
        name = order["workload"]
        if order["do"] == "prepare":
            call = WORKLOADS[name].make()
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
