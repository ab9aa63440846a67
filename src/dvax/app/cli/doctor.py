"""`dvax doctor`: describe this installation, and test that it computes correctly."""

from pathlib import Path

import typer

from dvax.app.cli import machine
from dvax.app.cli.console import print_error, print_table
from dvax.app.cli.failure import SOLVER_FAILED, reported
from dvax.app.cli.options import Debug
from dvax.app.cli.selftest import ALLOWED, END, self_test
from dvax.app.runs.compilation_cache import enable_double

Row = tuple[str, str, str]


def doctor(debug: Debug = False) -> None:
    """Show versions, devices and precision, and solve a problem whose solution is known."""
    with reported(debug):
        wrong: list[str] = []
        from dvax.app.runs.interrupt import interruptible

        rows = interruptible(lambda: [*_installation(wrong), *_machine(), *_numbers(wrong)])
        print_table(("what", "found", "remark"), rows)
        for text in wrong:
            print_error(f"error: {text}")
        if wrong:
            raise typer.Exit(SOLVER_FAILED)


def _installation(wrong: list[str]) -> list[Row]:
    from dvax import __version__

    rows: list[Row] = [("dvax", __version__, ""), ("Python", machine.python(), "")]
    for names, extra in ((machine.LIBRARY, "dvax"), (machine.APPLICATION, "dvax[app]")):
        for name, version in machine.versions(names).items():
            rows.append((name, version or "missing", "" if version else f"part of {extra}"))
            if version is None:
                wrong.append(f"{name} is not installed. Install it with: pip install '{extra}'.")
    return rows


def _machine() -> list[Row]:
    memory = machine.memory_gib()
    reason = machine.unwritable(Path.cwd())
    return [
        ("cores", str(machine.cores()), "that this process may use"),
        ("memory", "unknown" if memory is None else f"{memory:.1f} GiB", ""),
        ("working folder", str(Path.cwd()), reason or "can be written"),
    ]


def _numbers(wrong: list[str]) -> list[Row]:
    enable_double()
    import jax
    import jax.numpy as jnp

    devices = ", ".join(f"{device.device_kind} ({device.platform})" for device in jax.devices())
    # 1 + 2⁻⁵² differs from 1 in double precision only. This tests the device, not the setting.
    double = bool(jax.jit(lambda one: one + 2.0**-52 > one)(jnp.asarray(1.0)))
    if not double:
        wrong.append("the device computes in single precision. Choose another: JAX_PLATFORMS=cpu.")
    test = self_test()
    if not test.passed:
        wrong.append(
            f"the self-test is off by {test.error:.2e}, more than {ALLOWED:.0e}. "
            "This installation does not compute correctly; please report it with this output."
        )
    return [
        ("devices", devices, ""),
        ("precision", "double" if double else "single", "as the command line asks for"),
        (
            "self-test",
            "passed" if test.passed else "failed",
            f"paper's contact law at a point: x({END:g}) = {test.value:.12f}, "
            f"error {test.error:.1e}, {test.seconds:.1f} s with compiling",
        ),
    ]
