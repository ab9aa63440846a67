"""What a mesh must be before anything is assembled on it."""

from typing import Any

import numpy as np

from ...errors import InputProblem, Problems

_FLAT = 1e-10
"""An element whose corners are flatter than this, relative to its longest side, has no area to
rounding."""


def faults(mesh: Any, place: str) -> list[InputProblem]:
    """Everything that is wrong with a mesh of triangles or quadrilaterals and its boundaries
    "contact" and "clamped"."""
    elements = _elements(mesh, place)
    if elements:
        # Where elements are no elements, which side of an edge they lie on means nothing.
        return elements
    return [*_folds(mesh, place), *_boundaries(mesh, place)]


def _elements(mesh: Any, place: str) -> list[InputProblem]:
    corners = mesh.p[:, mesh.t]  # 2 × corners × elements
    forward = np.roll(corners, -1, axis=1) - corners
    back = np.roll(corners, 1, axis=1) - corners
    turn = forward[0] * back[1] - forward[1] * back[0]
    longest = np.max(np.sum(forward**2, axis=0), axis=0)
    flat = np.any(np.abs(turn) <= _FLAT * longest, axis=0)
    # All corners of a convex element turn the same way; which one does not matter.
    crossed = ~flat & (np.abs(np.sum(np.sign(turn), axis=0)) < turn.shape[0])
    rule = "every element has an inside, and each of its corners is less than 180°"
    return [
        InputProblem(place, f"{np.sum(bad)} {what}, the first of them {_element(mesh, bad)}", rule, do)
        for bad, what, do in (
            (flat, "elements that are degenerate (flat)",
             "Mesh again, or merge the nodes that lie on each other"),
            (crossed, "elements that are inverted (crossed or dented)",
             "Order their corners around them, or mesh again with less distortion"),
        )
        if bad.any()
    ]  # fmt: skip


def _folds(mesh: Any, place: str) -> list[InputProblem]:
    """Elements that lie on the same side of an edge they share, and edges of more than two."""
    rule = "an edge has one element on each side, or one in all"
    crowd = np.bincount(mesh.t2f.ravel(), minlength=mesh.nfacets) > 2
    if crowd.any():
        where = _point(mesh.p[:, mesh.facets[:, np.argmax(crowd)]].mean(axis=1))
        return [
            InputProblem(
                place, f"{np.sum(crowd)} edges with more than two elements, the first at {where}",
                rule, "Remove elements that are there twice",
            )
        ]  # fmt: skip
    inner = np.flatnonzero(mesh.f2t[1] >= 0)
    start, end = mesh.p[:, mesh.facets[0, inner]], mesh.p[:, mesh.facets[1, inner]]
    middles = mesh.p[:, mesh.t].mean(axis=1)
    along = end - start
    sides = []
    for k in (0, 1):
        away = middles[:, mesh.f2t[k, inner]] - start
        sides.append(np.sign(along[0] * away[1] - along[1] * away[0]))
    folded = sides[0] == sides[1]
    if not folded.any():
        return []
    bad = np.zeros(mesh.nelements, bool)
    bad[mesh.f2t[:, inner[folded]].ravel()] = True
    return [
        InputProblem(
            place,
            f"{np.sum(folded)} edges with both elements on one side (inverted, or there twice), the "
            f"first of these elements {_element(mesh, bad)}",
            rule,
            "Mesh again where elements overlap",
        )
    ]


def _boundaries(mesh: Any, place: str) -> list[InputProblem]:
    named = {role: np.asarray((mesh.boundaries or {}).get(role, ())) for role in _ROLES}
    wrong = Problems(
        InputProblem(
            place,
            f"no {role} boundary" if facets.size == 0 else
            f"{np.sum(mesh.f2t[1, facets] >= 0)} facets of the {role} boundary inside the body",
            _ROLES[role],
            f"Name edges of the body's outline {role!r}",
        )
        for role, facets in named.items()
        if facets.size == 0 or np.any(mesh.f2t[1, facets] >= 0)
    )  # fmt: skip
    both = np.intersect1d(named["contact"], named["clamped"]).size
    if both:
        wrong.add(
            place, f"{both} facets that are both contact and clamped",
            "what is held does not give way to a punch", "Take them out of one of the two",
        )  # fmt: skip
    return wrong or _floating(mesh, named["clamped"], place)


_ROLES = {
    "contact": "the punch meets the body on a boundary of it",
    "clamped": "what nothing holds, a punch pushes away: the elastic energy is then no norm",
}


def _floating(mesh: Any, clamped: np.ndarray, place: str) -> list[InputProblem]:
    """Parts of the body that no edge joins to what is held."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    one, two = mesh.f2t[:, mesh.f2t[1] >= 0]
    joins = coo_array((np.ones(one.size), (one, two)), shape=(mesh.nelements, mesh.nelements))
    count, part = connected_components(joins, directed=False)
    loose = np.setdiff1d(np.arange(count), part[mesh.f2t[0, clamped]])
    if not loose.size:
        return []
    bad = part == loose[0]
    return [
        InputProblem(
            place,
            f"{loose.size} of {count} parts of the body without a clamped edge, the first of "
            f"{np.sum(bad)} elements, among them {_element(mesh, bad)}",
            _ROLES["clamped"],
            "Clamp an edge of it, join it to the rest by merging nodes, or leave it out",
        )
    ]


def _element(mesh: Any, which: np.ndarray) -> str:
    """The first of these elements, as a user finds it again."""
    k = int(np.argmax(which))
    corners = ", ".join(_point(mesh.p[:, node]) for node in mesh.t[:, k])
    return f"number {k + 1}, with corners {corners}"


def _point(p: Any) -> str:
    return f"({p[0]:.6g}, {p[1]:.6g})"
