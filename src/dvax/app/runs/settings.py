"""The settings of a run: the sections of a configuration together, checked and complete."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import PrivateAttr

from dvax.app.runs.fields import Sources
from dvax.app.runs.schema import (
    BoundarySection,
    DemandSection,
    InitialSection,
    LoadSection,
    ModelSection,
    OutputSection,
    Section,
    SolverSection,
    TimeSection,
    UnitsSection,
)


class Config(Section):
    """A checked configuration; every quantity is a number in the working units of `units`."""

    units: UnitsSection
    model: ModelSection
    boundary: BoundarySection
    demand: DemandSection
    load: LoadSection
    initial: InitialSection
    time: TimeSection
    solver: SolverSection
    output: OutputSection

    _source: Path = PrivateAttr(default=Path("configuration"))
    _allow_outside: bool = PrivateAttr(default=False)

    @property
    def source(self) -> Path:
        """The file that was read. Data files are named relative to its folder."""
        return self._source

    @property
    def sources(self) -> Sources:
        """Where the data files lie."""
        return Sources(self._source.name, self._source.parent, self._allow_outside)

    def data_files(self) -> dict[str, str]:
        """Dotted key -> file name, for every data file that the configuration names."""
        return dict(_files(self.model_dump(exclude_none=True)))

    def to_toml(self, files: Mapping[str, str] | None = None) -> str:
        """All settings as TOML; reading it again beside the same data gives the same configuration.

        `files` gives other names to data files, by dotted key: for a copy elsewhere.
        """
        import tomli_w

        tree = _plain(self.model_dump(exclude_none=True))
        for key, name in (files or {}).items():
            *path, last = key.split(".")
            table = tree
            for part in path:
                table = table[part]
            table[last] = name
        return tomli_w.dumps(tree)


def _files(tree: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    found = []
    for key, value in tree.items():
        if isinstance(value, Mapping):
            found += _files(value, f"{prefix}{key}.")
        elif key == "file":
            found.append((f"{prefix}{key}", value))
    return found


def _plain(value: Any) -> Any:
    """Tuples as TOML writes them: one entry stands for itself, more are an array."""
    if isinstance(value, Mapping):
        return {
            key: [_plain(p) for p in inner]
            if key in {"points_of_interest", "knots"}
            else _plain(inner)
            for key, inner in value.items()
        }
    if isinstance(value, tuple):
        return value[0] if len(value) == 1 else list(value)
    return value
