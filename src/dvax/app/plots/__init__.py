"""Pictures of a run and of a solution, and the page that holds those of a run.

`build_report` reads a run directory and writes `report.html` (self-contained, no network) and
`figures/*.png` into it. `dvax.app.plots.solution.plot_solution` draws a `dvax.Solution`, and
`dvax.app.plots.change.change_figure` a `dvax.sensitivity.Change`. It needs the extra `dvax[app]`.

The name is imported at its first use, so that readers of a run directory do not load Plotly.
"""

from typing import TYPE_CHECKING

from dvax._lazy import lazy_names

if TYPE_CHECKING:
    from dvax.app.plots.report import build_report as build_report

__all__, __getattr__, __dir__ = lazy_names(__name__, {"report": ("build_report",)})
