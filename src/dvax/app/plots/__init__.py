"""Pictures of a run, and the page that holds them.

`build_report` reads a run directory and writes `report.html` (self-contained, no network) and
`figures/*.png` into it. The library below the application never imports this room; it needs the
extra `dvax[app]`. `dvax.app.plots.change.change_figure` draws a `dvax.sensitivity.Change`.
"""

from dvax.app.plots.report import build_report

__all__ = ["build_report"]
