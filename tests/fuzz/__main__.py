"""Judge many mutations: `python -m tests.fuzz configuration FIRST LAST`, or data, or expression.

Prints every one that breaks the promise, and at the end how many were read and refused.
"""

import sys
import tempfile
from collections import Counter
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

from tests.fuzz import cases  # noqa: E402
from tests.fuzz.seeds import write_folder  # noqa: E402


def main(kind: str, first: int, last: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        inside = write_folder(Path(folder))
        make = getattr(cases, kind)
        count: Counter[str] = Counter()
        for number in range(first, last):
            case = make(number, inside)
            verdict, value = case.examine()
            count[verdict] += 1
            if verdict == "broken":
                print(f"{case.name}: {value}", flush=True)
        print(dict(count))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
