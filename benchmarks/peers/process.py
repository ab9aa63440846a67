"""A child process that answers lines of JSON with lines of JSON."""

import json
import subprocess
from contextlib import ExitStack
from typing import Any, Self


class Process:
    """A running child, to be used in a `with` statement, which ends it and closes the `files` that it
    writes to."""

    def __init__(self, command: list[str], files: ExitStack, **options: Any):
        self._files = files
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, **options
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        with self._files, self._process.stdout:
            self._process.stdin.close()
            self._process.wait(timeout=60)

    def send(self, **order: Any) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()

    def receive(self) -> Any:
        """**Raises:** `RuntimeError` if the child ended instead of answering."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            status = self._process.wait()
            raise RuntimeError(f"the process ended with status {status}. {self.said()[-2000:]}")
        return json.loads(line)

    def said(self) -> str:
        """What the child printed for people, where that is kept."""
        return ""
