"""A graded mesh of a rectangle, refined under the punch."""

import math
from typing import Any

import numpy as np

from ...errors import InputProblem, Problems
from ...formats.optional import needed

_MIN_ASPECT_RATIO = 1e-9
"""Smallest ratio of the sides of an element; below, its area is dominated by roundoff."""


_MAX_ELEMENTS = 250_000
"""A block of so many has two million unknowns; its factorisation needs gigabytes."""


def block(
    width: Any = 8.0,
    height: Any = 4.0,
    fine_half_width: Any = 0.5,
    fine: Any = 20,
    coarse: Any = 9,
    layers: Any = 21,
    growth: Any = 1.18,
) -> Any:
    """Return a mesh of the rectangle |x| ≤ width/2, −height ≤ y ≤ 0, symmetric about x = 0.

    The boundary "contact" is the top, and "clamped" the bottom. On each side of x = 0 there are `fine`
    columns of equal width up to `fine_half_width`, and `coarse` columns with abscissae in geometric
    progression up to the edge. Each of the `layers` is `growth` times as high as the one above. The
    reference meshes have (fine, coarse, layers) = (10, 4, 17), (20, 9, 21) and (40, 19, 25).

    **Raises:** `dvax.InputError` with all invalid sizes.

    **Returns:** a scikit-fem `MeshQuad`.
    """
    sizes = {"width": width, "height": height, "fine_half_width": fine_half_width, "growth": growth}
    counts = {"fine": fine, "coarse": coarse, "layers": layers}
    wrong = Problems(
        _problem(
            name, value, "it must be a positive number", "Give a length, or a ratio of heights"
        )
        for name, value in sizes.items()
        if isinstance(value, bool)
        or not isinstance(value, int | float)
        or not (0 < value < math.inf)
    )
    wrong += [
        _problem(name, value, "it must be an integer ≥ 1", "Give a number of elements")
        for name, value in counts.items()
        if isinstance(value, bool) or not isinstance(value, int) or value < 1
    ]
    if not wrong and not fine_half_width < width / 2:
        wrong.append(
            _problem(
                "fine_half_width", fine_half_width,
                f"it must be less than half of the width, {width / 2:g}, where the coarse columns end",
                "Make the block wider or the fine zone narrower",
            )
        )  # fmt: skip
    if not wrong and 2 * (fine + coarse) * layers > _MAX_ELEMENTS:
        keys = ", ".join(f"mesh[{name!r}]" for name in counts)
        wrong.add(
            f"dvax.models.ElasticBody({keys})", f"{2 * (fine + coarse) * layers} elements",
            f"a block has at most {_MAX_ELEMENTS}", "Use fewer columns or layers",
        )  # fmt: skip
    wrong.raise_any()
    skfem = needed("skfem")
    inner = np.linspace(0.0, fine_half_width, fine + 1)
    outer = np.geomspace(fine_half_width, width / 2, coarse + 1)[1:]
    right = np.concatenate([inner, outer])
    with np.errstate(all="ignore"):  # heights that overflow are no sides of elements
        heights = float(growth) ** np.arange(layers)
        depth = np.concatenate([[0.0], np.cumsum(heights)])
        y = -float(height) * (depth / depth[-1])[::-1]
        _check_sides(np.diff(right), np.diff(y))
    mesh = skfem.MeshQuad.init_tensor(np.concatenate([-right[::-1], right[1:]]), y)
    middle = mesh.p[1, mesh.facets].mean(axis=0)
    # The first and the last value of y are exact, so they can be compared by equality.
    return mesh.with_boundaries(
        {"contact": np.flatnonzero(middle == 0.0), "clamped": np.flatnonzero(middle == y[0])}
    )


def _check_sides(columns: np.ndarray, layers: np.ndarray) -> None:
    """Raise an `InputError` if elements are so flat that roundoff dominates their area."""
    wrong = Problems(
        InputProblem(
            f"dvax.models.ElasticBody({', '.join(f'mesh[{key!r}]' for key in keys)})",
            f"elements {thin:.1e} by {long:.1e}", "the ratio of the sides must be below 10⁹, or "
            "roundoff dominates the area", fix,
        )
        for keys, thin, long, fix in (
            (("layers", "growth"), layers.min(), columns.max(),
             "Use fewer layers or a growth closer to 1"),
            (("fine_half_width", "fine"), columns.min(), layers.max(), "Make the fine zone wider"),
        )
        if not thin > _MIN_ASPECT_RATIO * long
    )  # fmt: skip
    wrong.raise_any()


def _problem(name: str, value: Any, rule: str, fix: str) -> InputProblem:
    return InputProblem(f"dvax.models.ElasticBody(mesh[{name!r}])", repr(value), rule, fix)
