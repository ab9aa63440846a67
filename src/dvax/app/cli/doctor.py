"""`dvax doctor`: describe this installation, and test that it computes correctly."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from dvax.app.cli import machine
from dvax.app.cli.console import print_error, print_line, print_table
from dvax.app.cli.failure import SOLVER_FAILED, reported
from dvax.app.cli.options import Debug
from dvax.app.cli.selftest import ALLOWED, END, self_test
from dvax.app.runs.compilation_cache import cache_folder, enable_double

Row = tuple[str, str, str]


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    debug: Debug = False,
) -> None:
    """Show what a report of a defect needs, and solve a problem whose solution is known."""
    with reported(debug):
        wrong: list[str] = []
        from dvax.app.runs.interrupt import interruptible

        rows = interruptible(
            lambda: [*_installation(wrong), *_extras(), *_machine(), *_numbers(wrong)]
        )
        if as_json:
            found = {what: {"found": value, "remark": remark} for what, value, remark in rows}
            print_line(json.dumps({"facts": found, "errors": wrong}, indent=2, ensure_ascii=False))
        else:
            print_table(("what", "found", "remark"), rows)
        for text in wrong:
            print_error(f"error: {text}")
        if wrong:
            raise typer.Exit(SOLVER_FAILED)


def _installation(wrong: list[str]) -> list[Row]:
    from dvax import __version__

    commit = _commit()
    rows: list[Row] = [
        ("dvax", __version__, f"commit {commit}" if commit else str(Path(__file__).parents[2])),
        ("Python", machine.python(), ""),
    ]
    for names, extra in ((machine.LIBRARY, "dvax"), (machine.APPLICATION, "dvax[app]")):
        for name, version in machine.versions(names).items():
            rows.append((name, version or "missing", "" if version else f"part of {extra}"))
            if version is None:
                wrong.append(f"{name} is not installed. Install it with: pip install '{extra}'.")
    return rows


def _commit() -> str | None:
    from dvax.app.runs.provenance import commit

    return commit()


def _extras() -> list[Row]:
    rows: list[Row] = []
    for extra, packages in machine.extras().items():
        known = ", ".join(f"{n} {v}" for n, v in packages.items() if v)
        missing = [n for n, v in packages.items() if v is None]
        command = f"pip install 'dvax[{extra}]'"
        fix = "" if not missing else f"incomplete: {command}" if known else command
        rows.append((f"extra {extra}", known or "not installed", fix))
    return rows


def _machine() -> list[Row]:
    memory = machine.memory_gib()
    here = Path.cwd()
    reason = machine.unwritable(here)
    rows = [
        ("processor", machine.processor(), ""),
        ("cores", str(machine.cores()), "that this process may use"),
        ("memory", "unknown" if memory is None else f"{memory:.1f} GiB", ""),
        ("working folder", str(here), f"{reason or 'can be written'}, {_free(here)}"),
    ]
    return [*rows, *((name, value, "environment") for name, value in machine.variables().items())]


def _free(folder: Path) -> str:
    return f"{machine.free_gib(folder):.1f} GiB free"


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
        ("devices", devices, f"{jax.local_device_count()} in this process"),
        ("precision", "double" if double else "single", "as the command line asks for"),
        _cache(),
        (
            "self-test",
            "passed" if test.passed else "failed",
            f"paper's contact law at a point: x({END:g}) = {test.value:.12f}, "
            f"error {test.error:.1e}, {test.seconds:.1f} s with compiling",
        ),
    ]


def _cache() -> Row:
    """Where compiled programs are kept, with their number and the space left."""
    import jax

    # The type of jax.config does not list its options.
    config: Any = jax.config
    if not config.jax_enable_compilation_cache:
        return ("compiled programs", "not kept", "JAX_ENABLE_COMPILATION_CACHE is off")
    path = Path(config.jax_compilation_cache_dir or cache_folder())
    count = sum(file.is_file() for file in path.iterdir()) if path.is_dir() else 0
    return ("compiled programs", str(path), f"{count} files, {_free(path)}")
