"""A configuration reads files in its own folder alone, and runs no code, unless it is allowed to."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from tests.fuzz import seeds

import dvax
from dvax.app.runs.applications.config import read_config
from dvax.errors import InputError

SOURCE = Path(dvax.__file__).parent

# Every key that names a file: the configuration, and the text of its value.
KEYS = {
    "load.series.file": (seeds.CONTACT, 'file = "load.csv"', "load.csv"),
    "demand.profile.file": (seeds.CONTACT, 'file = "strip.npy"', "strip.npy"),
    "boundary.file": (seeds.NODES, 'file = "nodes.csv"', "nodes.csv"),
    "model.netlist": (seeds.CIRCUIT, 'netlist = "tank.cir"', "tank.cir"),
    "model.record": (seeds.FRAME.split("yield_ratio")[0], 'record = "quake.at2"', "quake.at2"),
    "model.network": (seeds.TRAFFIC, 'network = "road_net.tntp"', "road_net.tntp"),
    "model.trips": (seeds.TRAFFIC, 'trips = "road_trips.tntp"', "road_trips.tntp"),
    "model.nodes": (seeds.TRAFFIC, 'nodes = "road_node.tntp"', "road_node.tntp"),
    "model.data": (seeds.MARKET, 'data = "market"', "market"),
    "model.mesh": (seeds.MESH, 'mesh = "block.msh"', "block.msh"),
    "model.python": (seeds.SEEDS[-1].text, 'python = "spring.py:build"', "spring.py"),
}


EXAMPLES = Path(__file__).parents[2] / "examples" / "configurations"
MATRICES = {
    "A": "0, 0, 1, 0\n0, 0, 0, 1\n-2, 1, -0.5, 0\n1, -2, 0, -0.5\n", "B": "0\n0\n1\n0\n",
    "Q": "1, 0, 0, 0\n0, 10, 0, 0\n0, 0, 0.1, 0\n0, 0, 0, 0.1\n", "R": "1\n",
}  # fmt: skip


def _examples() -> dict[str, tuple[str, str, str]]:
    """The same for the example configurations, whose keys may hold numbers in the place of a name."""
    found: dict[str, tuple[str, str, str]] = {}
    for name in ("heated_floor", "steel_cycles", "two_masses"):
        text = (EXAMPLES / f"{name}.toml").read_text(encoding="utf-8")
        for line in text.splitlines():
            key, _, value = line.partition(" = ")
            if value.endswith('.csv"'):
                found[f"model.{key}"] = (text, line, value.strip('"'))
            elif key in MATRICES:
                named = f'{key} = "{key}.csv"'
                found[f"model.{key}"] = (text.replace(line, named), named, f"{key}.csv")
    text, line, name = found["model.reference"]
    found["model.disturbance"] = (
        f'{text}disturbance = "push.csv"\n',
        'disturbance = "push.csv"',
        "push.csv",
    )
    return found


KEYS |= _examples()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    inside = seeds.write_folder(tmp_path)
    for file in EXAMPLES.glob("*.csv"):
        shutil.copy(file, inside)
    push = "time [s], place_1 [m/s], place_2 [m/s], speed_1 [m/s^2], speed_2 [m/s^2]\n"
    push += "0, 0, 0, 1, 0\n100, 0, 0, 1, 0\n"
    (inside / "push.csv").write_text(push)
    for name, text in MATRICES.items():
        (inside / f"{name}.csv").write_text(text)
    return inside


def test_every_key_that_names_a_file_is_tested() -> None:
    from dvax.app.runs.applications.config import APPLICATIONS, module_of

    for name in APPLICATIONS:
        application = module_of(name).APPLICATION
        for key in (*application.files, *application.folders):
            assert f"model.{key}" in KEYS


@pytest.mark.parametrize(
    "key", [pytest.param(k, marks=pytest.mark.thorough if k in _examples() else ()) for k in KEYS]
)
def test_files_outside_the_folder_are_refused_unless_allowed(key: str, folder: Path) -> None:
    if key == "model.mesh":
        pytest.importorskip("skfem")
    text, line, name = KEYS[key]
    assert line in text
    moved = folder.parent / "elsewhere" / name
    if (
        text.count(f'= "{name}"') > 1 and (folder / name).is_file()
    ):  # another key names the same file
        shutil.copy(folder / name, moved)
    else:
        (folder / name).rename(moved)
    (folder / "link").symlink_to(moved)
    (folder / "around").symlink_to(moved.parent)
    suffix = ":build" if key == "model.python" else ""
    given = (
        f"../elsewhere/{name}",
        str(moved),
        "link",
        f"around/{name}",
        f"folder/../../elsewhere/{name}",
    )
    config = folder / "case.toml"
    for value in given:
        config.write_text(text.replace(line, f'{line.split(" = ")[0]} = "{value}{suffix}"'))
        with pytest.raises(
            InputError, match=r"configuration's folder or below|no such|no file"
        ) as caught:
            read_config(config, quiet=True, allow_code=True)
        assert key in str(caught.value)
        if value != "link":  # its name has not the ending that says the format
            assert read_config(config, quiet=True, allow_code=True, allow_outside=True)


@pytest.mark.parametrize(
    "name", ["fifo", "link_zero", "link_loop", "link_gone", "folder", "huge.csv", "~"]
)
def test_places_that_are_no_files_are_refused(name: str, folder: Path) -> None:
    config = folder / "case.toml"
    config.write_text(seeds.CONTACT.replace('"load.csv"', f'"{name}"'))
    for allow_outside in (False, True):
        with pytest.raises(InputError, match=r"load\.series\.file"):
            read_config(config, allow_outside=allow_outside)
    for place in (folder / name, Path("/dev/zero")):
        with pytest.raises(InputError):
            read_config(place)


def test_link_within_a_data_folder_may_not_lead_out_of_it(folder: Path) -> None:
    outside = folder.parent / "elsewhere" / "gen.csv"
    (folder / "market" / "gen.csv").rename(outside)
    (folder / "market" / "gen.csv").symlink_to(outside)
    config = folder / "case.toml"
    config.write_text(seeds.MARKET)
    with pytest.raises(InputError, match=r"'market/gen\.csv'; data lies in"):
        read_config(config)
    assert read_config(config, allow_outside=True)


def test_market_data_in_the_folders_of_its_repository_are_data_files(folder: Path) -> None:
    """A run directory has copies of them, so that it can go on without the original."""
    from dvax.formats.rts_gmlc import RTS_FILES

    flat = folder / "market"
    for name, nested in RTS_FILES.values():
        place = folder / "whole" / nested
        place.parent.mkdir(parents=True, exist_ok=True)
        (flat / name).rename(place)
    config = folder / "case.toml"
    config.write_text(seeds.MARKET.replace('data = "market"', 'data = "whole"'))
    names = [path.name for _, path in read_config(config).data_files()]
    assert sorted(names) == sorted(name for name, _ in RTS_FILES.values())


def test_code_runs_only_where_it_is_allowed(folder: Path) -> None:
    (folder / "spring.py").write_text(f"open({str(folder / 'ran')!r}, 'w')\n")
    config = folder / "case.toml"
    for text in (seeds.SEEDS[-1].text, '[model]\nname = "python"\npython = "spring.py:build"\n'):
        config.write_text(text)
        with pytest.raises(InputError, match="--allow-code"):
            read_config(config)
    assert not (folder / "ran").exists()


def test_source_unpickles_nothing() -> None:
    for path in SOURCE.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for line in text.splitlines():
            if "allow_pickle" in line:
                assert "allow_pickle=False" in line, (path, line)
        loads = re.findall(
            r"\b(?:pickle|marshal|shelve|dill|cloudpickle|joblib)\b(?=\.|\s+import|$)", text
        )
        assert not loads, (path, loads)
        for call in re.finditer(r"np\.load\([^\n]*", text):
            assert "allow_pickle=False" in call[0], (path, call[0])


def test_npy_header_of_a_huge_shape_allocates_nothing(folder: Path) -> None:
    import io

    config = folder / "case.toml"
    config.write_text(seeds.CONTACT.replace("points = 8", "points = 100000000"))
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": "<f8", "fortran_order": False, "shape": (100_000_000,)}
    )
    (folder / "strip.npy").write_bytes(stream.getvalue() + bytes(64))
    from tests.fuzz.limits import examine

    verdict, error = examine(lambda: read_config(config))
    assert verdict == "refused", error
    (folder / "strip.npy").write_bytes(seeds.bomb(2**28))
    verdict, error = examine(lambda: read_config(config))
    assert verdict == "refused", error
