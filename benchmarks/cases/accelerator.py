"""The same workloads on an accelerator and on the processor of the same machine."""

import jax
import numpy as np

from ..clock import in_turn
from ..layout import duration
from ..peers.on_platform import Platform
from ..section import Section, Table, compare
from ..workloads import WORKLOADS


def run(full: bool) -> Section:
    device = jax.devices()[0]
    section = Section(
        title=f"accelerator: {device.device_kind} beside the processor of the same machine",
        fair=(
            "The same calls in double precision in two processes, one with JAX_PLATFORMS=cpu, which "
            "uses all cores as XLA does. Inputs lie on the device before the clock starts; 'as called' "
            "includes the checks of a call and its Solution. 'error' is the largest difference of the "
            "two results. There is no target: which problems fit an accelerator is what the table says."
        ),
    )
    if device.platform == "cpu":
        section.skipped = "JAX finds no accelerator on this machine"
        return section
    first = Table("first call, with compilation", ("case", device.platform, "cpu"), [])
    with Platform(None) as ours, Platform("cpu") as theirs:
        for name, workload in WORKLOADS.items():
            sides = {"accelerator": ours, "cpu": theirs}
            for side in sides.values():
                side.send(do="prepare", workload=name)
            made = {key: side.prepared() for key, side in sides.items()}
            taken = in_turn(
                {
                    key: lambda side=side, name=name: side.sample(name)
                    for key, side in sides.items()
                },
                9 if full else 5,
            )
            (seconds, answer), (seconds_cpu, answer_cpu) = made["accelerator"], made["cpu"]
            section.comparisons.append(
                compare(
                    workload.what, "cpu", taken["accelerator"], taken["cpu"], direction="other/dvax",
                    error=float(np.max(np.abs(answer - answer_cpu))),
                )
            )  # fmt: skip
            first.rows.append((workload.what, duration(seconds), duration(seconds_cpu)))
    section.tables.append(first)
    return section
