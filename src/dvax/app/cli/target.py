"""The rule for output directories: what is there is kept, unless the user says otherwise."""

from pathlib import Path

from dvax.errors import InputProblem


def target_problems(out: Path, *, force: bool) -> list[InputProblem]:
    """What speaks against writing a run into `out`; empty where nothing does."""
    if out.exists() and not out.is_dir():
        return [
            InputProblem(
                str(out),
                "a file",
                "results are written into a folder",
                "Give the name of a folder that does not exist yet.",
            )
        ]
    if not out.exists() or not any(out.iterdir()):
        return []
    if not force:
        return [
            InputProblem(
                str(out),
                "a folder that is not empty",
                "results are never written over others unasked",
                "Give another folder, or --force to replace what dvax wrote here.",
            )
        ]
    if not (out / "manifest.json").is_file():
        return [
            InputProblem(
                str(out),
                "a folder that is not empty and holds no manifest.json",
                "--force replaces a run of dvax and deletes nothing else",
                "Give another folder, or empty this one yourself.",
            )
        ]
    return []
