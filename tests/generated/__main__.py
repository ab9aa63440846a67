"""Run generated problems and print what fails.

    python -m tests.generated --samples 20 --families tent pulse --first 100
    python -m tests.generated --family "Ball, K tent" --first 17 --samples 1 --methods default

`--families` chooses by parts of names; each family's problem number k is the same on every machine.
"""

import argparse
import sys
import time
import traceback

import jax

jax.config.update("jax_enable_x64", True)

from . import driver, reference  # noqa: E402
from .families import FAMILIES  # noqa: E402


def main() -> int:
    ask = argparse.ArgumentParser(prog="python -m tests.generated", description=__doc__,
                                  formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    ask.add_argument("--families", nargs="*", default=[""], help="parts of names (all by default)")
    ask.add_argument("--family", help="one family by its whole name")
    ask.add_argument("--methods", nargs="*", help="methods (those of the family by default)")
    ask.add_argument("--samples", type=int, default=10, help="problems of each family")
    ask.add_argument("--first", type=int, default=0, help="the number of the first one")
    ask.add_argument("--bounds", type=int, default=3, help="bounds of every k-th problem; 0: none")
    ask.add_argument("--list", action="store_true", help="print the names of the families")
    asked = ask.parse_args()
    chosen = [
        family
        for name, family in FAMILIES.items()
        if (name == asked.family if asked.family else any(p in name for p in asked.families))
    ]
    if asked.list:
        print("\n".join(family.name for family in chosen))
        return 0
    worst = 0
    print(f"{'problems':>8} {'runs':>5} {'wrong':>5} {'died':>5} {'bound':>5} {'CPU s':>6}  family")
    for family in chosen:
        jax.clear_caches()  # each family has programs of its own, and memory maps are limited
        started, runs, failed = time.process_time(), [], []
        for seed in range(asked.first, asked.first + asked.samples):
            bounds = asked.bounds > 0 and seed % asked.bounds == 0
            try:
                of_seed = list(
                    driver.run(family, seed, asked.methods, bounds, bounds and seed % 2 == 0)
                )
            except reference.NoReference as error:
                failed.append(f"    number {seed}: no reference: {error}")
                continue
            except Exception:  # noqa: BLE001  (anything that is raised is a finding)
                text = traceback.format_exc(limit=-2)
                failed.append(f"    number {seed}: raised\n{text}")
                continue
            runs += of_seed
            failed += [
                f"    number {r.seed} {r.method}, rtol {r.rtol:g}, {r.steps} steps: {r.failure}"
                for r in of_seed
                if r.failure
            ]
        counts = [sum(word in r.failure for r in runs) for word in ("wrong", "died", "bound")]
        spent = time.process_time() - started
        figures = " ".join(f"{n:5d}" for n in (len(runs), *counts))
        print(f"{asked.samples:8d} {figures} {spent:6.1f}  {family.name}")
        if failed:
            print("\n".join(failed))
        sys.stdout.flush()
        worst += len(failed)
    print(f"{worst} failures")
    return int(worst > 0)


if __name__ == "__main__":
    sys.exit(main())
