"""The settings of a run: the sections of a configuration together, checked and complete."""

from pathlib import Path
from typing import Any

from pydantic import PrivateAttr

from dvax.app.runs.fields import Sources
from dvax.app.runs.keys import flat_keys
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

    def is_folder(self, key: str) -> bool:
        """Whether a dotted key names a folder: none does."""
        return False

    def data_files(self) -> list[tuple[str, Path]]:
        """(dotted key, file) of every data file that the configuration names."""
        return [
            (key, self._source.parent / name)
            for key, name in flat_keys(self.tree()).items()
            if key.endswith(".file")
        ]

    def tree(self) -> dict[str, Any]:
        """All settings as a TOML file has them; reading it beside the same data gives the same
        configuration."""
        return self.model_dump(exclude_none=True)
