"""The report of a sweep: its figures over its parameters, and the members that failed."""

import json
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import zarr
from matplotlib import rc_context
from matplotlib.figure import Figure as Still

from dvax._figure_text import entry_text
from dvax.app.plots.page import Part, alert, document, fold, lead_section, section, sections
from dvax.app.plots.panels import DASHES, Curve, Panel, panels_picture
from dvax.app.plots.picture import Picture, Views
from dvax.app.plots.tables import escaped, facts_table, table
from dvax.app.plots.theme import (
    FONT,
    INK,
    PRESSURE_MAP,
    STILL_STYLE,
    SURFACE,
    axis_title,
    blank,
    counted,
    number,
    pressure_bar,
    quantity,
    still_axes,
    unit_text,
)
from dvax.app.runs.sweeps.records import MANIFEST, records
from dvax.app.runs.sweeps.store import NAME
from dvax.theory.status import ORDER

_PANELS, _CURVES, _FAILURES = 8, 6, 200
_ENTRIES = 8
"""Vectors of up to this many entries are figures, an entry each."""
_DOTS = 60
"""Curves of up to this many members have dots."""


@dataclass(frozen=True)
class _Axis:
    """A parameter or a figure: one value a member."""

    name: str
    values: np.ndarray
    unit: str
    words: str

    @property
    def is_number(self) -> bool:
        return self.values.dtype.kind in "fiu"

    @property
    def short(self) -> str:
        """The name without the table that it stands in."""
        return self.name.rpartition(".")[2].removeprefix("summary_").replace("_", " ")

    @property
    def is_wide(self) -> bool:
        """Whether the values need a logarithmic axis: over a decade or more, and spread more evenly by
        their logarithms than by themselves; or over twelve decades, three for two values."""
        values = np.unique(self.values[np.isfinite(self.values)]).astype(float)
        if len(values) < 2 or not 0 < 10 * values[0] <= values[-1]:
            return False
        if len(values) == 2 or values[-1] >= 1e12 * values[0]:
            return bool(values[-1] >= 1e3 * values[0])
        middle = np.log(np.median(values))
        even = np.log(0.5 * (values[0] + values[-1]))
        return bool(abs(middle - np.mean(np.log(values[[0, -1]]))) < abs(middle - even))


@dataclass(frozen=True)
class _Members:
    """What the store of a sweep holds of every member."""

    parameters: list[_Axis]
    figures: list[_Axis]
    finished: np.ndarray


def sweep_page(directory: Path) -> tuple[str, list[Picture]]:
    """Return the text of the page of a sweep, and its pictures."""
    manifest = json.loads((directory / MANIFEST).read_text(encoding="utf-8"))
    lines = list(records(directory, int(manifest["members"])))
    members = _members(directory / NAME, list(manifest["parameters"]))
    pictures = [] if members is None else _pictures(members)
    failed = [line for line in lines if line["status"] == "failed"]
    open_ = [line for line in lines if line["status"] not in ("failed", "finished")]
    unfit = [line for line in lines if line.get("unfit")]
    banner = ""
    if failed or open_ or unfit:
        said = [
            f"{counted(len(failed), 'member')} failed." if failed else "",
            f"{counted(len(open_), 'member')} did not run to the end." if open_ else "",
            f"Of {counted(len(unfit), 'member')} some results have another size, and are not stored."
            if unfit
            else "",
        ]
        text = escaped(" ".join(filter(None, said)))
        banner = alert(text)
    parts = [
        *sections(pictures),
        *_failures(failed),
        *_ranges(members),
        *fold("provenance", "The sweep", facts_table(manifest)),
    ]
    done = sum(line["status"] == "finished" for line in lines)
    subtitle = " · ".join(
        (f"dvax {manifest.get('dvax') or ''}".strip(), f"sweep of {Path(manifest['config']).name}",
         f"{done} of {counted(len(lines), 'member')}")
    )  # fmt: skip
    top = banner + lead_section(_lead(manifest, members, done, lines))
    return document(manifest["title"], subtitle, top, parts, pictures), pictures


def _lead(
    manifest: Mapping[str, Any], members: _Members | None, done: int, lines: list[dict[str, Any]]
) -> list[str]:
    """The sentences at the top: what varies, how many members finished, and their error bounds."""
    config = Path(manifest["config"]).name
    said = []
    for axis in [] if members is None else members.parameters:
        values = np.unique(axis.values)
        if len(values) > 1 and axis.is_number:
            ends = f"{number(float(values[0]))} to {quantity(float(values[-1]), axis.unit)}"
            said.append(f"{axis.short} ({counted(len(values), 'value')}, {ends})")
        elif len(values) > 1:
            said.append(f"{axis.short} ({counted(len(values), 'value')})")
    over = f" over {' and '.join(said)}" if said else ""
    count = counted(len(lines), "member")
    text = f"This sweep ran {config} for {count}{over}: {done} of them finished."
    return [text, *_bounds(members, lines)]


def _bounds(members: _Members | None, lines: list[dict[str, Any]]) -> list[str]:
    """A sentence on the error bounds; none where the members have none."""
    figures = [] if members is None else members.figures
    for figure in figures:
        # In the store, a figure with the name of a variable has this prefix.
        name = figure.name.removeprefix("summary_")
        statuses = Counter(
            line["bounds"][name]
            for line in lines
            if line["status"] == "finished" and name in line.get("bounds", {})
        )
        if "error_bound" not in figure.name or not statuses or members is None:
            continue
        words = " and ".join(
            f"{status} for {counted(n, 'member')}" for status, n in statuses.items()
        )
        values = figure.values[members.finished]
        if not np.isfinite(values).all():
            return [
                f"The error bound is {words}; it is not finite for some, and states nothing there."
            ]
        largest = entry_text(
            {"value": float(values.max()), "bound": max(statuses, key=ORDER.index)}
        )
        return [
            f"The error bound is {words}; the largest is {largest} {unit_text(figure.unit)}".rstrip()
            + "."
        ]
    return []


def _with_numbers(name: str) -> list[Any]:
    """Return a key that sorts names by their numbers: q2 before q10."""
    parts = re.split(r"([0-9]+)", name)
    return [int(part) if k % 2 else part for k, part in enumerate(parts)]


def _members(path: Path, keys: list[str]) -> _Members | None:
    if not path.is_dir():
        return None
    group = zarr.open_group(path, mode="r", use_consolidated=False)

    def axis(name: str) -> _Axis:
        array: Any = group[name]
        about = array.attrs.asdict()
        words = str(about.get("long_name", name))
        values = np.asarray(array[...])
        # Some releases of NumPy have no cast from its type of texts of any length.
        values = np.array(values.tolist(), str) if values.dtype.kind == "T" else values
        return _Axis(name, values, str(about.get("units", "")), words)

    apart, figures = {*keys, "member", "status"}, []
    for name, array in sorted(group.arrays(), key=lambda item: _with_numbers(item[0])):
        dims = tuple(getattr(array.metadata, "dimension_names", None) or ())
        if dims == ("member",) and name not in apart:
            figures.append(axis(name))
        # A vector among the figures has a dimension of its own; variables over time have not.
        elif dims == ("member", f"{name}_0") and array.shape[1] <= _ENTRIES:
            whole = axis(name)
            figures += [
                replace(whole, name=f"{name}[{k}]", values=whole.values[:, k])
                for k in range(array.shape[1])
            ]
    finished = axis("status").values == 1
    # The figures that the author of a model chose are drawn first, since only some are drawn.
    last = lambda name: (name == "steps", "error_bound" in name, name.startswith("final_"))  # noqa: E731
    figures.sort(key=lambda figure: last(figure.name))
    varying = [figure for figure in figures if np.isfinite(figure.values[finished]).any()]
    return _Members([axis(key) for key in keys], varying, finished)


def _pictures(members: _Members) -> list[Picture]:
    if not members.finished.any() or not members.figures:
        return []
    varying = [p for p in members.parameters if len(np.unique(p.values)) > 1]
    numbers = [p for p in varying if p.is_number]
    pictures = []
    if len(varying) == 2 and len(numbers) == 2 and (grid := _grid(varying)) is not None:
        pictures.append(_surface(members, varying, grid))
    pictures += [_response(members, p, varying) for p in numbers[:_PANELS]]
    if len(varying) > 1:
        pictures.append(_parallel(members, varying))
    return pictures


def _omission(members: _Members) -> str:
    """Return a sentence about the figures for which there is no panel, or ""."""
    if len(members.figures) <= _PANELS:
        return ""
    return (
        f" {_PANELS} of {len(members.figures)} figures are drawn; the table of ranges and sweep.zarr "
        "have all."
    )


def _grid(axes: list[_Axis]) -> np.ndarray | None:
    """Return the number of the member at every pair of values; None where the pairs are no grid."""
    columns, rows = (np.unique(axis.values, return_inverse=True) for axis in axes)
    place = np.full((len(rows[0]), len(columns[0])), -1)
    place[rows[1], columns[1]] = np.arange(len(axes[0].values))
    return place if place.size == len(axes[0].values) and (place >= 0).all() else None


def _surface(members: _Members, axes: list[_Axis], grid: np.ndarray) -> Picture:
    """Figures over two parameters, as maps."""
    figures = members.figures[:_PANELS]
    across, along = (np.unique(axis.values) for axis in axes)
    plot = blank(480)
    bar = pressure_bar(plot, "", 480)
    plot.update_layout(margin=dict(t=100))
    maps = [np.where(members.finished[grid], f.values[grid], np.nan) for f in figures]
    maps = [np.where(np.isfinite(values), values, np.nan) for values in maps]
    # Even cells, since values of a logarithmic range would make some of them too narrow to see.
    names = [[number(v) for v in values] for values in (across, along)]
    for k, (figure, values) in enumerate(zip(figures, maps, strict=True)):
        title = axis_title(figure.short, figure.unit)
        shown = np.log10(values) if figure.is_wide else values
        ticks = dict(tickprefix="10^", exponentformat="none") if figure.is_wide else {}
        plot.add_trace(
            go.Heatmap(
                x=names[0], y=names[1], z=shown, customdata=values, colorscale=PRESSURE_MAP,
                visible=k == 0, colorbar=dict(bar, title=dict(text=title, side="top"), **ticks),
                hovertemplate="%{x}, %{y}: %{customdata:.5g}<extra></extra>",
            )
        )  # fmt: skip
    plot.update_xaxes(title_text=axis_title(axes[0].short, axes[0].unit), type="category")
    plot.update_yaxes(title_text=axis_title(axes[1].short, axes[1].unit), type="category")

    def still() -> Still:
        with rc_context(STILL_STYLE):
            columns = min(2, len(figures))
            rows = -(-len(figures) // columns)
            drawn, places = still_axes(
                rows, columns, figsize=(4.5 * columns, 3.6 * rows), squeeze=False
            )
            for place in places.flat[len(figures) :]:
                place.set_visible(False)
            for place, figure, values in zip(places.flat, figures, maps, strict=False):
                image = place.imshow(
                    values, origin="lower", aspect="auto", cmap=PRESSURE_MAP,
                    norm="log" if figure.is_wide else None,
                )  # fmt: skip
                place.set_xticks(range(len(across)), names[0], rotation=45, ha="right")
                place.set_yticks(range(len(along)), names[1])
                place.grid(visible=False)
                place.set_title(axis_title(figure.short, figure.unit))
                place.set_xlabel(axis_title(axes[0].short, axes[0].unit))
                place.set_ylabel(axis_title(axes[1].short, axes[1].unit))
                drawn.colorbar(image, ax=place)
        return drawn

    labels = tuple(figure.short for figure in figures)
    return Picture(
        "surface", "Response surfaces",
        "Each figure over both parameters; members without results are gaps. Cells have one size "
        f"whatever the distance of the values.{_omission(members)}",
        plot, still, Views("Figure", labels) if len(labels) > 1 else None,
        alternative=f"Maps over {axes[0].short} and {axes[1].short} of {', '.join(labels)}.",
    )  # fmt: skip


def _response(members: _Members, over: _Axis, varying: list[_Axis]) -> Picture:
    """Figures over one parameter: a curve for each choice of the others, where they are few."""
    others = [axis for axis in varying if axis is not over]
    groups: dict[tuple[str, ...], list[int]] = {}
    for k in np.flatnonzero(members.finished):
        label = tuple(f"{axis.short} {_value(axis, int(k))}" for axis in others)
        groups.setdefault(label, []).append(int(k))
    repeats = len(groups) <= _CURVES
    if not repeats:
        groups = {("members",): [int(k) for k in np.flatnonzero(members.finished)]}
    panels = []
    for figure in members.figures[:_PANELS]:
        curves = []
        for colour, (label, rows) in enumerate(groups.items()):
            order = np.array(rows)[np.argsort(over.values[rows], kind="stable")]
            curves.append(
                Curve(
                    over.values[order], figure.values[order], ", ".join(label), colour,
                    DASHES[colour % len(DASHES)], marks=not repeats or len(order) <= 2,
                    dots=len(order) <= _DOTS,
                )
            )  # fmt: skip
        panels.append(Panel(curves, figure.short, figure.unit, log=figure.is_wide))
    others_said = " for each value of the other parameters" if others and repeats else ""
    return panels_picture(
        f"response-{over.name.replace('.', '-')}", f"Figures over {over.short}",
        f"The figures of the members over {over.name}{others_said}.{_omission(members)}",
        panels, over.short, over.unit,
        log=over.is_wide,
    )  # fmt: skip


def _value(axis: _Axis, member: int) -> str:
    value = axis.values[member]
    return quantity(float(value), axis.unit) if axis.is_number else str(value)


def _parallel(members: _Members, varying: list[_Axis]) -> Picture:
    """Parallel coordinates: a line a member through its parameters and figures."""
    axes = [*varying, *members.figures[:_PANELS]]
    rows = members.finished
    first = members.figures[0]
    scales = [_scale(axis, rows) for axis in axes]
    plot = go.Figure(
        go.Parcoords(
            line=dict(
                color=first.values[rows], colorscale=PRESSURE_MAP, showscale=True,
                colorbar=dict(title=dict(text=axis_title(first.short, first.unit), side="right")),
            ),
            dimensions=[
                dict(label=axis_title(a.short, a.unit), values=values, **ticks)
                for a, (values, ticks) in zip(axes, scales, strict=True)
            ],
        ),
        layout=dict(
            height=460, font=dict(family=FONT, size=12, color=INK), paper_bgcolor=SURFACE,
            margin=dict(l=70, r=40, t=60, b=40),
        ),
    )  # fmt: skip

    def still() -> Still:
        with rc_context(STILL_STYLE):
            drawn, place = still_axes(figsize=(1.6 * len(axes) + 2, 4.5))
            heights = np.stack([_unit_interval(values) for values, _ in scales], axis=1)
            shade = _unit_interval(first.values[rows])
            colours = _colours(shade)
            for line, colour in zip(heights, colours, strict=True):
                place.plot(range(len(axes)), line, color=colour, linewidth=1, alpha=0.8)
            for k, (values, ticks) in enumerate(scales):
                ends = (float(np.nanmin(values)), float(np.nanmax(values)))
                words = ticks.get("ticktext") or [number(v) for v in ends]
                place.text(k, -0.03, words[0], ha="center", va="top", fontsize=8)
                place.text(k, 1.03, words[-1], ha="center", va="bottom", fontsize=8)
            names = [axis_title(a.short, a.unit).replace(" [", "\n[") for a in axes]
            place.set_xticks(range(len(axes)), names, fontsize=8)
            place.tick_params(axis="x", pad=18)
            place.set_yticks([])
            place.set_ylim(-0.02, 1.1)
            place.spines[["left", "bottom"]].set_visible(False)
            drawn.suptitle("Parameters and figures", x=0.01, ha="left", fontsize=11)
        return drawn

    return Picture(
        "parallel", "Parameters and figures",
        f"A line a member; its colour is {first.short}. Drag along an axis to select members.",
        plot, still,
        alternative=f"Parallel axes: {', '.join(axis.short for axis in axes)}; a line for each of "
        f"{counted(int(rows.sum()), 'member')}.",
    )  # fmt: skip


def _scale(axis: _Axis, rows: np.ndarray) -> tuple[np.ndarray, Mapping[str, Any]]:
    """Return the values of an axis as numbers, logarithms where they are wide, and its ticks where
    they are texts."""
    if axis.is_number and axis.is_wide:
        powers = np.log10(axis.values[rows].astype(float))
        ticks = np.unique(np.linspace(powers.min(), powers.max(), 5).round().astype(int))
        texts = [number(10.0**power, 1) for power in map(float, ticks)]
        return powers, dict(tickvals=ticks.tolist(), ticktext=texts)
    if axis.is_number:
        return axis.values[rows].astype(float), {}
    texts, places = np.unique(axis.values[rows].astype(str), return_inverse=True)
    return places.astype(float), dict(tickvals=list(range(len(texts))), ticktext=list(texts))


def _unit_interval(values: np.ndarray) -> np.ndarray:
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return np.full(values.shape, 0.5) if high == low else (values - low) / (high - low)


def _colours(shade: np.ndarray) -> np.ndarray:
    from matplotlib import colormaps

    return colormaps[PRESSURE_MAP](shade)


def _ranges(members: _Members | None) -> list[Part]:
    """The table of parameters and figures with their ranges."""
    if members is None:
        text = '<p class="caption">No member has finished, so that there are no results.</p>'
        return section("ranges", "Parameters and figures", text)
    rows = []
    for kind, axes, chosen in (
        ("parameter", members.parameters, slice(None)),
        ("figure", members.figures, members.finished),
    ):
        for axis in axes:
            values = axis.values[chosen]
            if axis.is_number and len(values):
                low, high = np.nanmin(values), np.nanmax(values)
                shown = [quantity(float(v), axis.unit) for v in (low, high)]
            else:
                texts = sorted({str(v) for v in values})
                shown = [", ".join(texts[:_CURVES]) + (", …" if len(texts) > _CURVES else ""), ""]
            words = "" if kind == "parameter" else axis.words
            rows.append(
                (kind, f"<code>{escaped(axis.name)}</code>", *map(escaped, (*shown, words)))
            )
    head = ("kind", "name", "smallest", "largest", "meaning")
    return fold("ranges", "Ranges of parameters and figures", table(head, rows), len(rows))


def _failures(failed: list[dict[str, Any]]) -> list[Part]:
    """The table of the members that failed; none without any."""
    if not failed:
        return []
    rows = [
        tuple(
            map(escaped, (
                str(line["member"]),
                ", ".join(f"{k} = {v}" for k, v in line.get("values", {}).items()),
                str(line.get("reason", "")),
            ))
        )
        for line in failed[:_FAILURES]
    ]  # fmt: skip
    more = len(failed) - len(rows)
    rest = f'<p class="caption">{counted(more, "more")} in members.jsonl.</p>' if more else ""
    head = ("member", "values", "reason")
    return fold("failures", "Members that failed", f"{table(head, rows)}{rest}", len(failed))
