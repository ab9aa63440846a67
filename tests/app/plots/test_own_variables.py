"""Pictures of a user's problem: states and responses have a panel each, vectors a map."""

import numpy as np

from dvax.app.plots.applications.python import pictures
from dvax.app.plots.store import Variable

TIMES = np.linspace(0.0, 1.0, 5)


def drawn(**series):
    def variable(values, unit):
        return Variable.of(values, ("time",), {"units": unit})

    found = {name: variable(values, "m") for name, values in series.items()}
    return pictures({"time": variable(TIMES, "s"), **found})


def titles_of_axes(picture):
    layout = picture.interactive["layout"]
    axes = [name for name in layout if name.startswith("yaxis")]
    return {layout[name]["title"]["text"].replace("<br>", " ") for name in axes}


def test_numbered_names_have_a_panel_each_and_other_names_one_for_their_unit():
    names = ("x0", "x1", "u0", "u1", "depth", "gap")
    (picture,) = drawn(**{name: k + TIMES for k, name in enumerate(names)})
    assert titles_of_axes(picture) == {"x [m]", "u [m]", "value [m]"}


def test_entries_of_a_vector_are_not_called_places():
    titles = [picture.title for picture in drawn(x=np.ones((5, 9)) * TIMES[:, None])]
    assert titles == ["x over entries and time", "x at one time"]


def test_a_single_number_or_a_space_before_it_parts_no_names_of_one_unit():
    (picture,) = drawn(**dict.fromkeys(("level 1", "level_2"), TIMES))
    assert titles_of_axes(picture) == {"level [m]"}
    (picture,) = drawn(**dict.fromkeys(("inner", "outer_2", "gap"), TIMES))
    assert titles_of_axes(picture) == {"value [m]"}


def test_a_short_vector_has_a_curve_for_each_entry():
    (picture,) = drawn(x=TIMES[:, None] * np.arange(1.0, 5.0))
    curves = picture.interactive["data"]
    assert [curve["name"] for curve in curves] == ["x[0]", "x[1]", "x[2]", "x[3]"]
    assert titles_of_axes(picture) == {"x [m]"}
