"""A saved run, which is read and not changed."""

from collections.abc import Callable
from pathlib import Path

from dvax.app.explore import run_drawings
from dvax.app.explore.subject import (
    AbstractFrames,
    AbstractSubject,
    Answer,
    Drawing,
    Question,
    Values,
)
from dvax.app.plots.page import UNFINISHED
from dvax.app.plots.run_reader import CONTACT, read_run
from dvax.app.runs.resolved import NAME
from dvax.errors import input_error


class SavedRun(AbstractSubject):
    """The run of a directory that `dvax run` wrote. It has no sliders."""

    def __init__(self, directory: Path):
        self.run = run = read_run(directory)
        self.title = run.title
        self.subtitle = f"saved run, model {run.model}, {run.status}"
        self.parameters, self.planes = (), ()
        self.exports = ("configuration", "code") if (directory / NAME).is_file() else ("code",)
        note = UNFINISHED.get(run.status)
        self._notes = tuple(filter(None, (note, *run.notes, *run.warnings)))

    def solve(self, question: Question, check: Callable[[], None]) -> Answer:
        run = self.run
        return Answer(
            run_drawings.drawings(run),
            run_drawings.numbers(run.summary),
            run_drawings.certificate(run.summary),
            self._frames(),
            notes=self._notes,
        )

    def _frames(self) -> AbstractFrames | None:
        run = self.run
        if run.trajectory is None:
            return None
        shape = run.boundary_shape if run.model == CONTACT else None
        return run_drawings.frames(run.trajectory.variables, shape)

    def stability_map(self, values: Values, across: str, upward: str) -> Drawing:
        raise input_error(
            "the map of stability", "a saved run", "it needs a model with parameters",
            "Explore the configuration of the run",
        )  # fmt: skip

    def export(self, kind: str, values: Values) -> tuple[str, str]:
        path = self.run.directory.resolve()
        if kind == "configuration":
            return NAME, (path / NAME).read_text(encoding="utf-8")
        return f"{path.name}.py", _script(path)


def _script(path: Path) -> str:
    return f'''"""Written by dvax explore: read a run and print its figures."""

import json
from pathlib import Path

import xarray

run = Path({str(path)!r})
print(xarray.open_zarr(run / "trajectory.zarr"))
for name, figure in json.loads((run / "summary.json").read_text(encoding="utf-8")).items():
    print(name, figure["value"], figure["unit"])
'''
