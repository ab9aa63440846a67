"""Checks of a mesh before assembly."""

from typing import Any

import numpy as np

from ...errors import InputProblem, Problems

_MIN_RELATIVE_AREA = 1e-10
"""Smallest area of a corner's parallelogram, relative to the square of the element's longest side."""


def mesh_problems(mesh: Any, place: str) -> list[InputProblem]:
    """Return all problems of a mesh of triangles or quadrilaterals.

    The mesh must have the boundaries "contact" and "clamped"."""
    elements = _element_problems(mesh, place)
    if elements:
        # The other checks require valid elements.
        return elements
    return [*_overlap_problems(mesh, place), *_boundary_problems(mesh, place)]


def _element_problems(mesh: Any, place: str) -> list[InputProblem]:
    corners = mesh.p[:, mesh.t]  # 2 × corners × elements
    forward = np.roll(corners, -1, axis=1) - corners
    back = np.roll(corners, 1, axis=1) - corners
    cross = forward[0] * back[1] - forward[1] * back[0]
    longest = np.max(np.sum(forward**2, axis=0), axis=0)
    flat = np.any(np.abs(cross) <= _MIN_RELATIVE_AREA * longest, axis=0)
    # The cross products at all corners of a convex element have the same sign.
    inverted = ~flat & (np.abs(np.sum(np.sign(cross), axis=0)) < cross.shape[0])
    rule = "every element must be convex, with a positive area"
    return [
        InputProblem(place, f"{np.sum(bad)} {what}, the first of them {_element(mesh, bad)}", rule, fix)
        for bad, what, fix in (
            (flat, "elements that are degenerate (flat)",
             "Generate the mesh again, or merge coincident nodes"),
            (inverted, "elements that are inverted (self-intersecting or not convex)",
             "List their corners in order, or generate a mesh with less distortion"),
        )
        if bad.any()
    ]  # fmt: skip


def _overlap_problems(mesh: Any, place: str) -> list[InputProblem]:
    """Return the edges with two elements on the same side, or with more than two elements."""
    rule = "an edge must have at most one element on each side"
    overfull = np.bincount(mesh.t2f.ravel(), minlength=mesh.nfacets) > 2
    if overfull.any():
        where = _point(mesh.p[:, mesh.facets[:, np.argmax(overfull)]].mean(axis=1))
        return [
            InputProblem(
                place, f"{np.sum(overfull)} edges with more than two elements, the first at {where}",
                rule, "Remove duplicate elements",
            )
        ]  # fmt: skip
    inner = np.flatnonzero(mesh.f2t[1] >= 0)
    start, end = mesh.p[:, mesh.facets[0, inner]], mesh.p[:, mesh.facets[1, inner]]
    centroids = mesh.p[:, mesh.t].mean(axis=1)
    edge = end - start
    sides = []
    for k in (0, 1):
        offset = centroids[:, mesh.f2t[k, inner]] - start
        sides.append(np.sign(edge[0] * offset[1] - edge[1] * offset[0]))
    overlapping = sides[0] == sides[1]
    if not overlapping.any():
        return []
    bad = np.zeros(mesh.nelements, bool)
    bad[mesh.f2t[:, inner[overlapping]].ravel()] = True
    return [
        InputProblem(
            place,
            f"{np.sum(overlapping)} edges with both elements on one side (inverted or duplicate), the "
            f"first of these elements {_element(mesh, bad)}",
            rule,
            "Generate the mesh again where elements overlap",
        )
    ]


def _boundary_problems(mesh: Any, place: str) -> list[InputProblem]:
    named = {role: np.asarray((mesh.boundaries or {}).get(role, ())) for role in _ROLES}
    wrong = Problems(
        InputProblem(
            place,
            f"no {role} boundary" if facets.size == 0 else
            f"{np.sum(mesh.f2t[1, facets] >= 0)} facets of the {role} boundary inside the body",
            _ROLES[role],
            f"Name edges of the outer boundary {role!r}",
        )
        for role, facets in named.items()
        if facets.size == 0 or np.any(mesh.f2t[1, facets] >= 0)
    )  # fmt: skip
    both = np.intersect1d(named["contact"], named["clamped"]).size
    if both:
        wrong.add(
            place, f"{both} facets that are both contact and clamped",
            "a facet cannot be clamped and in contact", "Remove them from one of the two",
        )  # fmt: skip
    return wrong or _floating_parts(mesh, named["clamped"], place)


_ROLES = {
    "contact": "the punch meets the body on part of its boundary",
    "clamped": "the body must be clamped, or the elastic energy is not positive definite",
}


def _floating_parts(mesh: Any, clamped: np.ndarray, place: str) -> list[InputProblem]:
    """Return the parts of the body that are not connected to a clamped edge."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    one, two = mesh.f2t[:, mesh.f2t[1] >= 0]
    graph = coo_array((np.ones(one.size), (one, two)), shape=(mesh.nelements, mesh.nelements))
    count, part = connected_components(graph, directed=False)
    floating = np.setdiff1d(np.arange(count), part[mesh.f2t[0, clamped]])
    if not floating.size:
        return []
    bad = part == floating[0]
    return [
        InputProblem(
            place,
            f"{floating.size} of {count} parts of the body without a clamped edge, the first of "
            f"{np.sum(bad)} elements, among them {_element(mesh, bad)}",
            _ROLES["clamped"],
            "Clamp an edge of it, connect it to the others by merging nodes, or remove it",
        )
    ]


def _element(mesh: Any, which: np.ndarray) -> str:
    """Return the number and the corners of the first of these elements."""
    k = int(np.argmax(which))
    corners = ", ".join(_point(mesh.p[:, node]) for node in mesh.t[:, k])
    return f"number {k + 1}, with corners {corners}"


def _point(p: Any) -> str:
    return f"({p[0]:.6g}, {p[1]:.6g})"
