"""The pictures of the pages: before the build, docs/figures/NAME.py writes docs/generated/NAME.svg."""

import runpy
from pathlib import Path

from sphinx.application import Sphinx


def draw(app: Sphinx) -> None:
    here = Path(app.srcdir)
    target = here / "generated"
    target.mkdir(exist_ok=True)
    for script in sorted((here / "figures").glob("*.py")):
        # The picture of the README is committed, so that it shows without a build.
        if script.stem == "readme":
            continue
        picture = target / f"{script.stem}.svg"
        if not picture.is_file() or picture.stat().st_mtime < script.stat().st_mtime:
            runpy.run_path(str(script))["draw"](picture)


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", draw)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
