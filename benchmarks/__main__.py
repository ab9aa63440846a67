"""`python -m benchmarks [--full] [--only NAME ...] [--part K/N] [--save [FILE]]`, from the root of the
repository."""

import argparse
import dataclasses
import datetime
import json
import platform
import re
import time
from pathlib import Path
from typing import Any

import jax

from . import machine
from .cases import CASES, load
from .layout import as_text, verdicts
from .section import Section, Target

_RESULTS = Path(__file__).with_name("results")


def main() -> None:
    options = _options()
    # Doubles throughout, on both sides of every comparison.
    jax.config.update("jax_enable_x64", True)
    # Nor a hand-over to another thread: JAX makes it for all but the smallest programs, and on a busy
    # machine it takes longer than a short solve.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    facts = machine.facts() | {"load before": machine.load()}
    print("\n".join(f"{name}: {value}" for name, value in facts.items()))
    print(
        "Times are medians of samples taken in turn, after compilation; ratios are formed round by"
    )
    print("round. benchmarks/README.md says how to read the tables.", flush=True)
    started = time.perf_counter()
    sections: list[Section] = []
    loads: list[str] = []
    names = _names(options)
    for name in names:
        loads.append(machine.load())
        sections.append(load(name)(options.full))
        print(f"\n{as_text(sections[-1])}\n(load at its start: {loads[-1]})", flush=True)
    facts["load after"] = machine.load()
    facts["seconds"] = f"{time.perf_counter() - started:.0f}"
    print(f"\nTargets\n-------\n{verdicts(sections)}")
    print(f"\n{facts['seconds']} s; load afterwards: {facts['load after']}")
    if options.save:
        content = {
            "date": datetime.datetime.now().isoformat(timespec="seconds"),
            "machine": facts,
            "sections": [
                {"name": name, "load": before, **_plain(section)}
                for name, before, section in zip(names, loads, sections)
            ],
        }
        options.save.parent.mkdir(exist_ok=True)
        options.save.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", "utf-8")
        print(f"Saved as {options.save}")


def _names(options: argparse.Namespace) -> list[str]:
    k, n = map(int, options.part.split("/"))
    return [name for name in CASES if not options.only or name in options.only][k - 1 :: n]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description="dvax against the peers that are found here."
    )
    parser.add_argument("--full", action="store_true", help="more rounds, longer runs, memory")
    parser.add_argument("--only", action="append", choices=CASES, help="this case (repeatable)")
    parser.add_argument(
        "--part", default="1/1", metavar="K/N", help="every N-th case, from number K on"
    )
    where = re.sub(r"\W+", "-", platform.node() or "machine").strip("-")
    default = _RESULTS / f"{datetime.datetime.now():%Y-%m-%dT%H%M}-{where}.json"
    parser.add_argument(
        "--save", nargs="?", type=Path, const=default, metavar="FILE",
        help=f"write all figures as JSON too ({_RESULTS.name}/DATE-MACHINE.json)",
    )  # fmt: skip
    return parser.parse_args()


def _plain(thing: Any) -> Any:
    """Dataclasses as dictionaries; a target also says whether it was met."""
    if isinstance(thing, list | tuple):
        return [_plain(entry) for entry in thing]
    if not dataclasses.is_dataclass(thing):
        return thing
    fields = {f.name: _plain(getattr(thing, f.name)) for f in dataclasses.fields(thing)}
    return fields | {"met": thing.met} if isinstance(thing, Target) else fields


if __name__ == "__main__":
    main()
