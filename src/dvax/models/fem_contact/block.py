"""A rectangle with a mesh that is fine where a punch meets it."""

import math
from typing import Any

import numpy as np

from ...errors import InputProblem, Problems
from ...formats.optional import needed

_FLAT = 1e-9


def block(
    width: Any = 8.0,
    height: Any = 4.0,
    fine_half_width: Any = 0.5,
    fine: Any = 20,
    coarse: Any = 9,
    layers: Any = 21,
    growth: Any = 1.18,
) -> Any:
    """The rectangle |x| ≤ width/2, −height ≤ y ≤ 0 of quadrilaterals, symmetric about x = 0, the top
    named "contact" and the bottom "clamped".

    On each side `fine` columns of one width reach out to `fine_half_width`, and `coarse` ones from
    there to the edge, whose ends are in geometric progression. The `layers` grow downward, each
    `growth` times as high as the one above. The reference meshes are (fine, coarse, layers) =
    (10, 4, 17), (20, 9, 21), (40, 19, 25).

    **Raises:** `dvax.InputError` for every size that breaks its rule.

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
                f"it must be less than half of the width, {width / 2:g}: the coarse columns lie "
                "between the two", "Make the block wider or the fine zone narrower",
            )
        )  # fmt: skip
    wrong.raise_any()
    skfem = needed("skfem")
    inner = np.linspace(0.0, fine_half_width, fine + 1)
    outer = np.geomspace(fine_half_width, width / 2, coarse + 1)[1:]
    right = np.concatenate([inner, outer])
    heights = float(growth) ** np.arange(layers)
    depth = np.concatenate([[0.0], np.cumsum(heights)])
    y = -float(height) * (depth / depth[-1])[::-1]
    _check_sides(np.diff(right), np.diff(y))
    mesh = skfem.MeshQuad.init_tensor(np.concatenate([-right[::-1], right[1:]]), y)
    middle = mesh.p[1, mesh.facets].mean(axis=0)
    # The ends of y are exact, and a facet in between is not near them.
    return mesh.with_boundaries(
        {"contact": np.flatnonzero(middle == 0.0), "clamped": np.flatnonzero(middle == y[0])}
    )


def _check_sides(columns: np.ndarray, layers: np.ndarray) -> None:
    """Refuse sizes that make elements so flat that they have no area to rounding."""
    wrong = Problems(
        InputProblem(
            f"dvax.models.ElasticBody({', '.join(f'mesh[{key!r}]' for key in keys)})",
            f"elements {thin:.1e} by {long:.1e}", "no side is 10⁹ times the other: there is no area to "
            "rounding", fix,
        )
        for keys, thin, long, fix in (
            (("layers", "growth"), layers.min(), columns.max(), "Take fewer layers or a growth near 1"),
            (("fine_half_width", "fine"), columns.min(), layers.max(), "Make the fine zone wider"),
        )
        if not thin > _FLAT * long
    )  # fmt: skip
    wrong.raise_any()


def _problem(name: str, value: Any, rule: str, fix: str) -> InputProblem:
    return InputProblem(f"dvax.models.ElasticBody(mesh[{name!r}])", repr(value), rule, fix)
