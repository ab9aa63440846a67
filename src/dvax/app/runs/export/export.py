"""From a run directory to files of one format, all of them or none."""

import shutil
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType

from dvax.app.runs.export.selection import select
from dvax.errors import Problems, input_error

_MODULES = {
    "netcdf": "netcdf", "csv": "csv_files", "npz": "npz", "parquet": "parquet", "vtk": "vtk",
}  # fmt: skip
FORMATS = tuple(_MODULES)
ENDINGS = {".nc": "netcdf", ".csv": "csv", ".npz": "npz", ".parquet": "parquet", ".pvd": "vtk"}


def export_run(
    directory: Path,
    target: Path,
    *,
    format: str | None = None,
    variables: Sequence[str] | None = None,
    force: bool = False,
    say: Callable[[str], None] = lambda text: None,
) -> list[Path]:
    """Write the results of a run directory to files, and return their paths. The run is only read.

    **Arguments:** `target`: a file, whose ending is that of the format, or a folder for several files;
    a format whose tables or series do not fit into one file writes NAME-LABEL files beside the first.
    `format`: by default that of the ending. `variables`: by default all; `force`: replace files. `say`
    is called with sentences about frames that are left out.

    **Raises:** `dvax.InputError` if the run has no results, a file exists, or the format does not fit.
    """
    kind = _format(target, format)
    module = import_module(f"dvax.app.runs.export.{_MODULES[kind]}")
    selection = select(directory, variables)
    parts = module.parts(selection)
    folder, names = _names(target, module.SUFFIX, list(parts))
    final = [folder / name for name in names]
    series = [_frames(module, path) for path in final]
    _check(target, folder, [*final, *(path for path in series if path is not None)], force)
    folder.mkdir(parents=True, exist_ok=True)
    staging = staging_folder(target)
    shutil.rmtree(staging, ignore_errors=True)
    staging.mkdir()
    try:
        for name, write in zip(names, parts.values(), strict=True):
            write(staging / name)
        for path, frames in zip(final, series, strict=True):
            if frames is not None:
                _replace_folder(staging / frames.name, frames)
            (staging / path.name).replace(path)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    for note in (*selection.notes, *module.notes(selection)):
        say(note)
    return final


def staging_folder(target: Path) -> Path:
    """Return the folder in which files are written before they are renamed: beside a file, or inside a
    folder."""
    if _is_file(target):
        return target.with_name(f".{target.name}.new")
    return target / ".dvax-export.new"


def _is_file(target: Path) -> bool:
    """Return whether `target` names a file and no folder."""
    return target.suffix.lower() in ENDINGS and not target.is_dir()


def _format(target: Path, format: str | None) -> str:
    """Return the name of the format."""
    of_ending = ENDINGS.get(target.suffix.lower())
    if format is None and of_ending is None:
        known = ", ".join(f"{ending} for {name}" for ending, name in ENDINGS.items())
        raise input_error(
            "-o", str(target), f"the ending of a file names the format: {known}",
            f"Add such an ending, or name the format of a folder: --format {FORMATS[0]}",
        )  # fmt: skip
    if format is not None and format not in FORMATS:
        raise input_error(
            "--format", repr(format), f"it is one of {', '.join(FORMATS)}", "Choose one of these"
        )
    if format is not None and of_ending not in (None, format):
        raise input_error(
            "--format, -o", f"{format}, {target.name}", f"the ending {target.suffix} is that of "
            f"{of_ending}", "Leave out --format, or correct the ending",
        )  # fmt: skip
    return format or str(of_ending)


def _names(target: Path, suffix: str, labels: list[str]) -> tuple[Path, list[str]]:
    """Return the folder of the files, and their names: NAME.suffix and NAME-LABEL.suffix for a file,
    LABEL.suffix for a folder."""
    if _is_file(target):
        others = [f"{target.stem}-{label}{target.suffix}" for label in labels[1:]]
        return target.parent, [target.name, *others]
    return target, [f"{label}{suffix}" for label in labels]


def _frames(module: ModuleType, path: Path) -> Path | None:
    of = getattr(module, "frames_folder", None)
    return None if of is None else of(path)


def _check(target: Path, folder: Path, paths: list[Path], force: bool) -> None:
    """Raise an `InputError` if a file stands in the way."""
    above = next(p for p in (folder, *folder.parents) if p.exists())
    if not above.is_dir():
        raise input_error(str(target), f"{above} is a file", "files are written into a folder",
                          "Give another path")  # fmt: skip
    problems = Problems()
    for path in paths:
        if path.exists() and not force:
            problems.add(
                str(path), "a file that exists" if path.is_file() else "a folder that exists",
                "results are never written over others unasked",
                "Give another name, or --force to replace it",
            )  # fmt: skip
        elif path.is_dir() and not _is_own(path):
            problems.add(
                str(path), "a folder with other files than frames",
                "--force replaces what dvax export wrote, and deletes nothing else",
                "Give another name",
            )  # fmt: skip
    problems.raise_any()


def _is_own(folder: Path) -> bool:
    """Return whether a folder holds frames of a series alone."""
    return all(
        f.name.startswith("frame-") and f.suffix in (".vtp", ".vtr") for f in folder.iterdir()
    )


def _replace_folder(new: Path, folder: Path) -> None:
    if folder.exists():
        shutil.rmtree(folder)
    new.replace(folder)
