"""The members of a sweep: products, ranges, units, samples, tables; and what is refused."""

import collections
import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvax.app.runs.sweeps.members import parameters
from dvax.app.runs.sweeps.sweep import _checked
from dvax.app.runs.toml_file import read_toml
from dvax.errors import InputError


def members(folder, text):
    file = folder / "sweep.toml"
    file.write_text('config = "model.toml"\n' + text)
    found = parameters(_checked(read_toml(file), file.name), file, False)
    return {p.key: p for p in found}


def refused(folder, text):
    with pytest.raises(InputError) as caught:
        members(folder, text)
    return "\n".join(str(problem) for problem in caught.value.problems)


def test_grid_runs_all_combinations_and_its_last_key_varies_fastest(tmp_path):
    found = members(
        tmp_path, '[grid]\n"a.x" = [1, 2]\n"a.y" = [true, false]\nb.z = ["p", "q", "r"]\n'
    )
    rows = list(zip(*(p.values for p in found.values()), strict=True))
    assert list(found) == ["a.x", "a.y", "b.z"]
    assert rows == list(itertools.product([1, 2], [True, False], ["p", "q", "r"]))


def test_blocks_multiply_and_the_keys_of_zip_advance_together(tmp_path):
    (tmp_path / "rows.csv").write_text("m.c, m.name\n1.5, one\n2, two\n")
    found = members(
        tmp_path,
        '[grid]\n"m.a" = [1, 2]\n[zip]\n"m.b" = [10, 20, 30]\n"m.d" = ["x", "y", "z"]\n'
        '[table]\nfile = "rows.csv"\n',
    )
    assert len(found["m.a"].values) == 2 * 3 * 2
    assert found["m.b"].values[:4] == (10, 10, 20, 20)
    pairs = set(zip(found["m.b"].values, found["m.d"].values, strict=True))
    assert pairs == {(10, "x"), (20, "y"), (30, "z")}
    assert set(zip(found["m.c"].values, found["m.name"].values, strict=True)) == {
        (1.5, "one"), (2, "two"),
    }  # fmt: skip


@given(
    first=st.floats(1e-3, 1e3), factor=st.floats(1.1, 1e3), count=st.integers(2, 9),
    log=st.booleans(),
)  # fmt: skip
def test_range_has_its_ends_exactly_and_even_spacing(tmp_path_factory, first, factor, count, log):
    last, spacing = first * factor, "log" if log else "linear"
    where = f'{{ from = {first!r}, to = {last!r}, count = {count}, spacing = "{spacing}" }}'
    values = np.array(
        members(tmp_path_factory.getbasetemp(), f'[grid]\n"m.a" = {where}\n')["m.a"].values
    )
    assert (values[0], values[-1], len(values)) == (first, last, count)
    apart = np.diff(np.log(values) if log else values)
    np.testing.assert_allclose(apart, apart[0], rtol=1e-9)


def test_whole_ends_give_whole_values_where_these_are_evenly_spaced(tmp_path):
    found = members(
        tmp_path,
        '[zip]\n"m.a" = { from = 1, to = 9, count = 5 }\n"m.b" = { from = 0, to = 1, count = 5 }\n',
    )
    assert found["m.a"].values == (1, 3, 5, 7, 9)
    assert all(isinstance(value, int) for value in found["m.a"].values)
    assert found["m.b"].values == (0.0, 0.25, 0.5, 0.75, 1.0)


def test_quantities_become_numbers_in_the_unit_of_the_first(tmp_path):
    found = members(
        tmp_path,
        '[zip]\n"m.a" = ["5 mm", "1 cm", "0.1 m"]\n'
        '"m.b" = { from = "1 kN", to = "3000 N", count = 3 }\n"m.file" = ["1 a.csv", "2 b.csv", "c"]\n',
    )
    assert found["m.a"].unit == "mm" and np.allclose(found["m.a"].numbers, [5, 10, 100])
    assert found["m.a"].values == ("5 mm", "1 cm", "0.1 m")
    assert found["m.b"].values == ("1.0 kN", "2.0 kN", "3.0 kN")
    assert found["m.file"].numbers is None


@pytest.mark.parametrize("method", ["sobol", "latin-hypercube", "random"])
def test_samples_lie_in_their_box_and_follow_from_the_seed(tmp_path, method):
    def drawn(seed, count=100):
        return members(
            tmp_path,
            f'[sample]\nmethod = "{method}"\ncount = {count}\nseed = {seed}\n[sample.between]\n'
            '"m.a" = { low = 2.0, high = 3.0 }\n'
            '"m.b" = { low = "1 mm", high = "1 m", spacing = "log" }\n'
            '"m.c" = { mean = 5.0, deviation = 0.5 }\n',
        )

    one, again, other = drawn(3), drawn(3), drawn(4)
    assert all(one[key].values == again[key].values != other[key].values for key in one)
    a, b, c = (np.array(p.numbers) for p in one.values())
    assert a.min() >= 2 and a.max() <= 3 and b.min() >= 1 and b.max() <= 1000
    assert one["m.b"].values[0] == f"{one['m.b'].numbers[0]!r} mm"
    # Halves of the box have equally many points, and the moments are those of the distributions.
    assert abs(np.mean(np.log10(b) < 1.5) - 0.5) < (0.2 if method == "random" else 0.03)
    assert abs(c.mean() - 5) < 0.2 and abs(c.std() - 0.5) < 0.15
    if method == "sobol":
        assert (
            drawn(3, 16)["m.a"].values == one["m.a"].values[:16]
        )  # more points keep the first ones


def test_sobol_points_have_one_in_each_interval_of_a_power_of_two(tmp_path):
    found = members(
        tmp_path, '[sample]\ncount = 64\n[sample.between]\n"m.a" = [0.0, 1.0]\n"m.b" = [0.0, 1.0]\n'
    )
    for p in found.values():
        assert sorted(math.floor(64 * v) for v in p.values) == list(range(64))


def test_whole_samples_take_every_number_equally_often(tmp_path):
    found = members(
        tmp_path,
        '[sample]\ncount = 64\n[sample.between]\n"m.a" = { low = 3, high = 6, whole = true }\n'
        '"m.b" = { mean = 5, deviation = 2.0, whole = true }\n',
    )
    assert collections.Counter(found["m.a"].values) == dict.fromkeys([3, 4, 5, 6], 16)
    assert all(type(v) is int for p in found.values() for v in p.values)
    assert abs(np.mean(found["m.b"].numbers) - 5.0) < 0.2


def test_cells_of_a_table_are_numbers_flags_and_texts(tmp_path):
    (tmp_path / "rows.csv").write_text(
        '\ufeffm.a,m.b,m.c,m.d\r\n1,true,2 mm,"a, b"\r\n-1.5e3,false,3 cm,c\r\n', encoding="utf-8"
    )
    found = members(tmp_path, '[table]\nfile = "rows.csv"\n')
    assert found["m.a"].values == (1, -1500.0) and found["m.b"].values == (True, False)
    assert found["m.c"].numbers == (2.0, 30.0) and found["m.d"].values == ("a, b", "c")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "[grid], [zip], [sample] or [table]"),
        ('[grid]\n"m.a" = 3\n', "m.a: got 3; a swept key has a list of values, or a range"),
        ('[grid]\n"m.a" = []\n', "a list of values"),
        ('[grid]\n"m.a" = [1]\n[zip]\n"m.a" = [2]\n', "m.a: got twice"),
        ('[grid]\n"m.a" = [1]\n"m.a.b" = [2]\n', "one contains the other"),
        ('[zip]\n"m.a" = [1, 2]\n"m.b" = [1]\n', "2 values of m.a, 1 values of m.b"),
        ('[grid]\n"m.a" = { from = 1, to = 2 }\n', "m.a.count: got None"),
        ('[grid]\n"m.a" = { from = 1, to = 2, count = 3, step = 1 }\n', "m.a.step"),
        ('[grid]\n"m.a" = { from = 0, to = 2, count = 3, spacing = "log" }\n', "positive numbers"),
        ('[grid]\n"m.a" = { from = 1, to = 2, count = 3, spacing = "lgo" }\n', '"linear" or "log"'),
        ('[grid]\n"m.a" = { from = "1 mm", to = "2 s", count = 3 }\n', "must convert to the unit"),
        ('[grid]\n"m.a" = { from = "1 mm", to = 2, count = 3 }\n', "both have a unit, or none"),
        ('[grid]\n"m.a" = ["1 mm", "2 s"]\n', "must convert to the unit of the first value, mm"),
        ('[grid]\n"output.png" = [true]\n', "does not change the results"),
        ('[sample]\ncount = 0\n[sample.between]\n"m.a" = [0.0, 1.0]\n', "sample.count"),
        ('[sample]\ncount = 4\n[sample.between]\n"m.a" = { mean = 1.0, deviation = 0.0 }\n',
         "positive"),
        ('[sample]\ncount = 4\n[sample.between]\n"m.a" = { low = 1.0 }\n', "m.a.high: got nothing"),
        ('[sample]\ncount = 4\n[sample.between]\n"m.a" = { low = 3.0, high = 2.0 }\n',
         "m.a.low: got 3.0, and high = 2.0"),
        ('[sample]\ncount = 4\n[sample.between]\n"m.a" = { low = 1.5, high = 3, whole = true }\n',
         "whole numbers have whole ends"),
        ('[sample]\nmethod = "soboll"\ncount = 4\n[sample.between]\n"m.a" = [0.0, 1.0]\n', "'sobol'"),
        ('[table]\nfile = "none.csv"\n', "there is no such file"),
        ('[table]\nfile = "../rows.csv"\n', "in the configuration's folder"),
        ("[grind]\nx = [1]\n", "Did you mean 'grid'?"),
        ('[grid]\n"m.a" = { from = 1, to = 2, count = 2000 }\n'
         '"m.b" = { from = 1, to = 2, count = 2000 }\n',
         "at most 1000000"),
    ],
)  # fmt: skip
def test_wrong_sweep_is_refused_with_its_place(tmp_path, text, told):
    assert told in refused(tmp_path, text)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("m.a\n", "1 rows"),
        ("m.a,m.b\n1\n", "row 2: got 1 cells"),
        ("m.a,m.a\n1,2\n", "column 2: got 'm.a'"),
        ('m.a\n"1\n', "CSV"),
    ],
)
def test_wrong_table_is_refused_with_its_row_or_column(tmp_path, text, told):
    (tmp_path / "rows.csv").write_text(text)
    assert told in refused(tmp_path, '[table]\nfile = "rows.csv"\n')
