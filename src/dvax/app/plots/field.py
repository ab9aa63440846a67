"""A field over a line, or the entries of a vector: a map over time, and a profile at one time."""

from collections.abc import Sequence

import numpy as np

from dvax.app.plots.downsample import centres
from dvax.app.plots.map_panel import MapPanel
from dvax.app.plots.panels import Curve, panels_picture
from dvax.app.plots.picture import Picture
from dvax.app.plots.section import Axis, section_picture
from dvax.app.plots.theme import pressure_bar


def field_pictures(
    key: str,
    title: str,
    times: np.ndarray,
    places: np.ndarray | None,
    values: np.ndarray,
    across: Axis,
    upward: Axis,
    time_unit: str,
    references: Sequence[Curve] = (),
    label_unit: str | None = None,
) -> list[Picture]:
    """Return the map of `values` (times, places), and the profile over the places, whose time a slider
    chooses. Without `places` they are the entries of a vector, by their numbers; `references` are
    curves beside the profile, and `label_unit` is the unit beside the slider if it is not `time_unit`.
    """
    entries = np.arange(values.shape[1]) if places is None else places
    panel = MapPanel(times, values, upward.words, across.title, upward.unit, 1.2, places)
    edges_of_time, edges_of_place, means = panel.cells()
    whole = panels_picture(
        key, f"{title} over {'entries' if places is None else 'space'} and time",
        "Time to the right; a line marks the time of the profile below, and a click chooses it.",
        [panel], "time", time_unit,
    )  # fmt: skip
    # A bar at the side would take half of the width of a phone.
    plot, height = whole.interactive, whole.interactive["layout"]["height"]
    plot.data[0].colorbar = pressure_bar(plot, upward.title, height)
    profile = section_picture(
        key, f"{title} at one time", "The slider and the button choose the time.",
        centres(edges_of_place, entries), centres(edges_of_time, times), means, across, upward,
        time_unit if label_unit is None else label_unit, references,
    )  # fmt: skip
    return [whole, profile]
