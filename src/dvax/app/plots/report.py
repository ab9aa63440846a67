"""From a run directory to its report: `report.html` and `figures/*.png`."""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from dvax.app.plots.applications import application_pictures
from dvax.app.plots.certificate import certificate_picture
from dvax.app.plots.downsample import scan
from dvax.app.plots.histories import histories_picture
from dvax.app.plots.page import page
from dvax.app.plots.picture import Picture
from dvax.app.plots.pressure import pressure_picture
from dvax.app.plots.regimes import regime_picture
from dvax.app.plots.run_reader import RunRecord, read_run
from dvax.app.plots.separation import separation_picture
from dvax.app.plots.surface import surface_pictures


def build_report(run_dir: Path | str, *, stills: bool = True) -> Path:
    """Write `report.html`, and with `stills` a PNG a picture, into the run directory `run_dir`.

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
            _written(file, lambda beside, drawn=drawn: beside.write_bytes(drawn))
        file = self.directory / "report.html"
        _written(file, lambda beside: beside.write_text(self.text, encoding="utf-8"))
        return file


@np.errstate(over="ignore", invalid="ignore")  # infinite values become gaps
def draw_report(run_dir: Path, *, stills: bool) -> Report:
    """Make the report of `build_report`, and write nothing."""
    run = read_run(run_dir)
    pictures, missing = _pictures(run)
    drawn = {f"{picture.key}.png": _png(picture) for picture in pictures} if stills else {}
    return Report(run.directory, page(run, pictures, missing), drawn)


def _pictures(run: RunRecord) -> tuple[list[Picture], list[str]]:
    """The pictures that the run can give, and a sentence for each that it cannot."""
    if run.data and "state_part0" in run.data:
        return [], ["The run was stopped before more than its states could be written."]
    if run.data:
        return application_pictures(run.model, run.data), []
    if run.trajectory is None:
        return [], ["There is no picture, because the run wrote no frame."]
    found = scan(run)
    pictures: list[Picture] = []
    if found.cells is not None:
        pictures.append(pressure_picture(run, found))
    else:
        pictures.extend(surface_pictures(run, found))
    pictures.append(regime_picture(run, found))
    pictures.append(histories_picture(run, found))
    missing: list[str] = []
    certificate, separation = certificate_picture(run), separation_picture(run)
    if certificate is None:
        missing.append("Certified error: the trajectory holds no error bound.")
    else:
        pictures.append(certificate)
    if separation is None:
        missing.append("Certified decay: the run had no companion trajectory.")
    else:
        pictures.append(separation)
    return pictures, missing


def _png(picture: Picture) -> bytes:
    drawn = BytesIO()
    picture.still().savefig(drawn, format="png")
    return drawn.getvalue()


def _written(file: Path, write: Callable[[Path], Any]) -> None:
    """Write beside, then rename: a file is whole or the old one, and where the disk is full nothing is
    left over.

    **Raises:** `OSError` with the name of the file.
    """
    beside = file.with_name(file.name + ".part")
    try:
        write(beside)
        os.replace(beside, file)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise type(error)(error.errno, error.strerror, str(file)) from error
