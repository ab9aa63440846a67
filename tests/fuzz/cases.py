"""One numbered mutation of a configuration, or of a data file, in the folder of `write_folder`."""

import random
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from tests.fuzz import mutations
from tests.fuzz.limits import examine
from tests.fuzz.seeds import SEEDS, Seed, all_keys, data_files

from dvax.app.runs.applications.config import read_config
from dvax.formats import (
    read_at2,
    read_flows,
    read_mesh,
    read_netlist,
    read_network,
    read_nodes,
    read_rts,
    read_trips,
)
from dvax.formats.csv_columns import read_columns

_FILES = data_files()
_KEYS = all_keys()


@dataclass(frozen=True)
class Case:
    """Mutated `content` of a file, and how it is read."""

    name: str
    path: Path
    content: bytes
    original: bytes | None
    read: Callable[[], Any]

    def examine(self) -> tuple[str, Any]:
        """Write the file, read it, and put the original back."""
        self.path.write_bytes(self.content)
        try:
            return examine(self.read, unknowns)
        finally:
            if self.original is None:
                self.path.unlink()
            else:
                self.path.write_bytes(self.original)


def configuration(number: int, folder: Path) -> Case:
    """Return mutation `number` of a configuration: two in three change its keys and values, the others
    its bytes."""
    dice = random.Random(f"configuration {number}")
    seed = SEEDS[number % len(SEEDS)]
    text = mutations.mutate_lines(dice, seed.text, _KEYS) if dice.random() < 0.75 else seed.text
    content = text.encode()
    if text == seed.text or dice.random() < 0.05:
        content = mutations.mutate_bytes(dice, content)
    path = folder / "case.toml"
    return Case(
        f"configuration {number} ({seed.name})", path, content, None, lambda: load(path, seed)
    )


def load(path: Path, seed: Seed) -> Any:
    """Read a configuration, and write its settings as a run does."""
    config = read_config(path, quiet=True, allow_code=seed.allow_code)
    return config, config.tree()


def unknowns(value: Any) -> int:
    """Return the number of unknowns of a model of finite elements that was read, 0 of other values."""
    config = value[0] if isinstance(value, tuple) and value else None
    body = getattr(getattr(config, "model", None), "body", None)
    return 0 if body is None else body.unknowns


def data(number: int, folder: Path) -> Case:
    """Return mutation `number` of a data file, read by its reader or through a configuration."""
    dice = random.Random(f"data {number}")
    readers = _readers(folder)
    seed = SEEDS[number % len(SEEDS)]
    if seed.data and dice.random() < 0.5:
        name = dice.choice(seed.data)
        config = folder / f"{seed.name}.toml"
        if not config.exists():
            config.write_text(seed.text, encoding="utf-8")
        read, through = (lambda: load(config, seed)), seed.name
    else:
        name = dice.choice(sorted(readers))
        read, through = readers[name], "its reader"
    content = mutations.mutate_bytes(dice, _FILES[name])
    return Case(
        f"data {number} ({name} through {through})", folder / name, content, _FILES[name], read
    )


@cache
def _readers(folder: Path) -> dict[str, Callable[[], Any]]:
    network = read_network(folder / "road_net.tntp")
    readers: dict[str, Callable[[], Any]] = {
        "road_net.tntp": lambda: read_network(folder / "road_net.tntp"),
        "road_trips.tntp": lambda: read_trips(folder / "road_trips.tntp"),
        "road_node.tntp": lambda: read_nodes(folder / "road_node.tntp", network),
        "road_flow.tntp": lambda: read_flows(folder / "road_flow.tntp", network),
        "quake.at2": lambda: read_at2(folder / "quake.at2"),
        "tank.cir": lambda: read_netlist((folder / "tank.cir").read_bytes().decode("latin-1")),
        "load.csv": lambda: read_columns(folder / "load.csv", ["time", None], "time"),
    }
    for name in _FILES:
        if name.startswith("market/"):
            readers[name] = lambda: read_rts(folder / "market")
    for name, contact, clamped in (
        ("block.msh", "contact", "clamped"), ("four.msh", "contact", "clamped"),
        ("block.inp", "contact", "clamped"), ("block.mesh", "7", "4"),
    ):  # fmt: skip
        readers[name] = lambda n=name, c=contact, d=clamped: read_mesh(folder / n, c, d)
    return readers
