"""The sections of a sweep file as pydantic models."""

from typing import Any, Literal

from pydantic import Field

from dvax.app.runs.schema import Section


class SampleSection(Section):
    """Random or quasi-random points in a box of parameters."""

    method: Literal["sobol", "latin-hypercube", "random"] = Field(
        "sobol", description="Sobol sequence (scrambled), Latin hypercube, or independent points"
    )
    count: int = Field(ge=1, le=10**6, description="number of points", examples=[64])
    seed: int = Field(0, ge=0, description="seed of the generator: the same seed, the same points")
    between: dict[str, Any] = Field(
        description='for each key { low, high }, with spacing = "log" where wanted, or '
        "{ mean, deviation } of a normal distribution"
    )


class TableSection(Section):
    """Members from a table."""

    file: str = Field(
        description="CSV file, a row a member; its header holds keys of the configuration",
        examples=["members.csv"],
    )


class SweepOutput(Section):
    """What is kept of the members."""

    variables: list[str] | None = Field(
        None, description="variables of the trajectories to store, by default all; [] for none"
    )
    runs: Literal["all", "failed", "none"] = Field(
        "failed", description="whose run folders are kept in members/"
    )
    report: bool = Field(True, description="write report.html")


class SweepFile(Section):
    """A sweep file: a configuration, and what varies in it."""

    config: str = Field(description="the configuration that is varied", examples=["model.toml"])
    title: str = Field("", description="title of the report")
    grid: dict[str, Any] = Field(
        default_factory=dict, description="for each key its values: all combinations are run"
    )
    zip: dict[str, Any] = Field(
        default_factory=dict, description="for each key its values: they advance together"
    )
    sample: SampleSection | None = Field(None, description="random points")
    table: TableSection | None = Field(None, description="members from a table")
    output: SweepOutput = Field(SweepOutput.model_validate({}), description="what is kept")
