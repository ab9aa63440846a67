"""From a run directory to its report: `report.html` and `figures/*.png`."""

from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np

from dvax.app.plots.applications import application_pictures
from dvax.app.plots.certificate import certificate_picture
from dvax.app.plots.downsample import downsample
from dvax.app.plots.histories import histories_picture
from dvax.app.plots.maps import map_pictures, shares_picture
from dvax.app.plots.page import page
from dvax.app.plots.picture import Picture
from dvax.app.plots.run_reader import CONTACT, RunRecord, read_run
from dvax.app.plots.separation import separation_picture
from dvax.app.plots.sweep import sweep_page
from dvax.app.runs.rundir import write_whole
from dvax.app.runs.sweeps.records import is_sweep


def build_report(run_dir: Path | str, *, stills: bool = True) -> Path:
    """Write `report.html`, and with `stills` a PNG a picture, into the folder of a run or a sweep.

    Works on a run that stopped early too, and says so at the top of the page. Returns the path of
    the page. Raises InputError where `run_dir` is not a run directory or a file in it is damaged.
    """
    return draw_report(Path(run_dir), stills=stills).write()


@dataclass(frozen=True)
class Report:
    """A report that is made and not yet written: the text of its page, and a PNG a picture."""

    directory: Path
    text: str
    stills: Mapping[str, bytes]

    def write(self) -> Path:
        """Write all of it, and return the path of the page."""
        for name, drawn in self.stills.items():
            file = self.directory / "figures" / name
            file.parent.mkdir(exist_ok=True)
            write_whole(file, drawn)
        file = self.directory / "report.html"
        write_whole(file, self.text.encode())
        return file


@np.errstate(over="ignore", invalid="ignore")  # infinite values become gaps
def draw_report(run_dir: Path, *, stills: bool) -> Report:
    """Make the report of `build_report`, and write nothing."""
    if is_sweep(run_dir):
        text, pictures = sweep_page(run_dir)
    else:
        run = read_run(run_dir)
        pictures, missing = _pictures(run)
        text = page(run, pictures, missing)
    drawn = {f"{picture.key}.png": _png(picture) for picture in pictures} if stills else {}
    return Report(run_dir, text, drawn)


def _pictures(run: RunRecord) -> tuple[list[Picture], list[str]]:
    """The pictures that the run can give, and a sentence for each that it cannot."""
    if run.trajectory is None:
        return [], ["There is no picture, because the run wrote no results."]
    if run.model != CONTACT:
        return application_pictures(run.model, run.trajectory.variables), []
    reduced = downsample(run)
    pictures = [
        *map_pictures(run, reduced),
        shares_picture(run, reduced),
        histories_picture(run, reduced),
    ]
    missing: list[str] = []
    for picture, reason in (
        (certificate_picture(run), "Certified error: the trajectory holds no error bound."),
        (separation_picture(run), "Certified decay: the run had no companion trajectory."),
    ):
        if picture is None:
            missing.append(reason)
        else:
            pictures.append(picture)
    return pictures, missing


def _png(picture: Picture) -> bytes:
    drawn = BytesIO()
    picture.still().savefig(drawn, format="png")
    return drawn.getvalue()
