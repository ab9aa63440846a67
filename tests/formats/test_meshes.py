"""Meshes for the finite-element contact: several file formats, and invalid meshes."""

import sys

import meshio
import numpy as np
import pytest
import skfem
from tests.fuzz.seeds import GMSH_2, GMSH_4, MEDIT

import dvax
from dvax.models.fem_contact import ElasticBody

SIZES = {"width": 3.0, "height": 1.0, "fine": 4, "coarse": 3, "layers": 4}
NAMES = {"contact": [7, 1], "clamped": [4, 1], "block": [1, 2]}


@pytest.fixture(scope="module")
def block():
    """A block, and the content of its file: nodes, elements, and lines with their group."""
    body = ElasticBody(SIZES)
    mesh = body.mesh
    lines = np.concatenate([mesh.facets[:, mesh.boundaries[k]].T for k in ("contact", "clamped")])
    groups = np.repeat([7, 4], [len(mesh.boundaries[k]) for k in ("contact", "clamped")])
    return body, np.c_[mesh.p.T, np.zeros(mesh.nvertices)], mesh.t.T, lines, groups


def file_of(points, elements, lines, groups, kind="quad"):
    return meshio.Mesh(
        points, [(kind, elements), ("line", lines)],
        cell_data={
            "gmsh:physical": [np.ones(len(elements), int), groups],
            "gmsh:geometrical": [np.ones(len(elements), int), groups],
        },
        field_data={name: np.array(value) for name, value in NAMES.items()},
    )  # fmt: skip


def gmsh4(points, elements, lines, groups):
    """The text of a file of format 4.1, as Gmsh writes it today, with a node of no element."""
    points = np.vstack([[50.0, 50.0, 0.0], points])
    parts = [lines[groups == 7], lines[groups == 4]]
    box = "-2 -2 0 2 2 0"
    rows = [
        "$MeshFormat", "4.1 0 8", "$EndMeshFormat", "$PhysicalNames", "3",
        '1 7 "contact"', '1 4 "clamped"', '2 1 "block"', "$EndPhysicalNames",
        "$Entities", "0 2 1 0", f"1 {box} 1 7 0", f"2 {box} 1 4 0", f"1 {box} 1 1 0",
        "$EndEntities", "$Nodes", f"1 {len(points)} 1 {len(points)}", f"2 1 0 {len(points)}",
        *(str(i + 1) for i in range(len(points))), *(" ".join(map(repr, p.tolist())) for p in points),
        "$EndNodes", "$Elements", f"3 {len(elements) + len(lines)} 1 9999",
    ]  # fmt: skip
    tag = 0
    for dim, entity, code, cells in ((1, 1, 1, parts[0]), (1, 2, 1, parts[1]), (2, 1, 3, elements)):
        rows.append(f"{dim} {entity} {code} {len(cells)}")
        for cell in cells:
            tag += 1
            rows.append(" ".join(map(str, [tag, *(cell + 2)])))
    return "\n".join([*rows, "$EndElements", ""])


def same(found, body):
    assert found.unknowns == body.unknowns
    np.testing.assert_allclose(found.compliance, body.compliance, rtol=1e-10)
    np.testing.assert_allclose(np.sort(found.points[:, 0]), np.sort(body.points[:, 0]), atol=1e-14)


def test_mesh_files_of_every_format_round_trip(block, tmp_path):
    body, *parts = block
    mesh = file_of(*parts)
    path = tmp_path / "new.msh"
    path.write_text(gmsh4(*parts))
    same(ElasticBody(path), body)
    path = tmp_path / "old.msh"
    mesh.write(path, file_format="gmsh22", binary=False)
    same(ElasticBody(str(path)), body)
    # Without names the numbers are the names.
    mesh.field_data = {}
    mesh.write(path, file_format="gmsh22")
    same(ElasticBody(path, contact="7", clamped="4"), body)
    mesh.cell_data = {"medit:ref": mesh.cell_data["gmsh:physical"]}
    mesh.write(tmp_path / "block.mesh")
    same(ElasticBody(tmp_path / "block.mesh", contact="7", clamped="4"), body)


def test_mesh_of_triangles_converges_to_the_compliance_of_quadrilaterals(tmp_path):
    """Two discretisations of one body agree better the finer they are."""
    apart = []
    for fine, coarse, growth in ((4, 3, 1.1), (8, 6, 1.1**0.5)):
        sizes = {**SIZES, "fine": fine, "coarse": coarse, "layers": 2 * fine, "growth": growth}
        quads = ElasticBody(sizes)
        triangles = quads.mesh.to_meshtri()
        parts = [triangles.facets[:, triangles.boundaries[k]].T for k in ("contact", "clamped")]
        path = tmp_path / f"{fine}.msh"
        file_of(
            np.c_[triangles.p.T, np.full(triangles.nvertices, 0.7)], triangles.t.T,
            np.concatenate(parts), np.repeat([7, 4], list(map(len, parts))), "triangle",
        ).write(path, file_format="gmsh22")  # fmt: skip
        body = ElasticBody(path)
        apart.append(abs(body.compliance[0] / quads.compliance[0] - 1))
    assert apart[1] < 0.7 * apart[0] < 2e-3


def test_vtk_output_has_cell_nodes_in_the_order_of_vtk(block):
    quads = block[0]
    triangles = ElasticBody(quads.mesh.to_meshtri())
    for body, sides in ((quads, 4), (triangles, 3)):
        nodes = body.nodes[body.cells()]
        # Corners around, then the middle of each side, last that from the last corner to the first.
        corners = nodes[:, :sides]
        middles = (corners + np.roll(corners, -1, axis=1)) / 2
        np.testing.assert_allclose(nodes[:, sides : 2 * sides], middles, atol=1e-14)
    np.testing.assert_allclose(quads.areas().sum(), triangles.areas().sum(), rtol=1e-12)


def test_elastic_body_accepts_a_scikit_fem_mesh_and_a_mapping(block):
    body = block[0]
    same(ElasticBody(body.mesh), body)
    stiff = ElasticBody(SIZES, youngs_modulus=4.0)
    np.testing.assert_allclose(4.0 * stiff.compliance, body.compliance, rtol=1e-9)


def refusal(path, **settings):
    with pytest.raises(dvax.InputError) as caught:
        ElasticBody(path, **settings)
    assert all(problem.fix for problem in caught.value.problems)
    return str(caught.value)


def test_mesh_without_a_named_boundary_lists_the_existing_names(block, tmp_path):
    path = tmp_path / "block.msh"
    file_of(*block[1:]).write(path, file_format="gmsh22")
    said = refusal(path, contact="top")
    assert "groups of lines are: 'clamped', 'contact'" in said and "block.msh" in said
    assert 'Physical Curve("top")' in said
    points, elements = block[1:3]
    meshio.Mesh(points, [("quad", elements)]).write(path, file_format="gmsh22")
    said = refusal(path)
    # Both are missing, and both are told.
    assert said.count("groups of lines are: none") == 2


@pytest.mark.parametrize(
    ("kind", "width", "fix"),
    [("tetra", 4, "cross-section"), ("triangle6", 6, "order 1"), ("quad8", 8, "order 1")],
)
def test_mesh_with_unsupported_elements_is_rejected(tmp_path, kind, width, fix):
    rng = np.random.default_rng(0)
    path = tmp_path / "other.vtu"
    meshio.Mesh(rng.normal(size=(width, 3)), [(kind, np.arange(width)[None])]).write(path)
    said = refusal(path)
    assert f"cells of type {kind}" in said and fix in said


def test_mesh_with_two_kinds_of_elements_or_none_is_rejected(block, tmp_path):
    _, points, elements, lines, _ = block
    path = tmp_path / "mixed.vtu"
    meshio.Mesh(points, [("quad", elements[1:]), ("triangle", elements[:1, :3])]).write(path)
    assert "triangles and quadrilaterals" in refusal(path)
    meshio.Mesh(points, [("line", lines)]).write(path)
    assert "['line']" in refusal(path)


def test_mesh_outside_a_plane_is_rejected(block, tmp_path):
    _, points, *rest = block
    lifted = points.copy()
    lifted[5, 2] = 0.25
    path = tmp_path / "shell.msh"
    file_of(lifted, *rest).write(path, file_format="gmsh22")
    assert "z differs by 0.25" in refusal(path)


def spoiled(block, change):
    """The mesh of the block after `change(points, elements)`."""
    mesh = block[0].mesh
    points, elements = mesh.p.copy(), mesh.t.copy()
    points, elements = change(points, elements) or (points, elements)
    return skfem.MeshQuad(points, elements).with_boundaries(
        {
            "contact": lambda x: np.abs(x[1]) < 1e-9,
            "clamped": lambda x: np.abs(x[1] + 1.0) < 1e-9,
        }
    )


def test_mesh_with_flat_or_crossed_elements_is_rejected(block):
    def flat(points, elements):
        points[:, elements[3, 10]] = points[:, elements[0, 10]]

    said = refusal(spoiled(block, flat))
    assert "degenerate (flat), the first of them number" in said

    def crossed(points, elements):
        elements[[0, 1], 10] = elements[[1, 0], 10]

    assert (
        "1 elements that are inverted (self-intersecting or not convex), the first of them number 11"
        in refusal(spoiled(block, crossed))
    )

    def far(points, elements):
        inner = np.flatnonzero((np.abs(points[0]) < 0.05) & (np.abs(points[1] + 0.5) < 0.2))
        points[0, inner[0]] += 0.7

    assert "inverted" in refusal(spoiled(block, far))


def test_mesh_with_folded_or_duplicate_elements_is_rejected(block):
    def twice(points, elements):
        return points, np.c_[elements, elements[:, 10]]

    assert "more than two elements" in refusal(spoiled(block, twice))
    # Two triangles folded onto each other: both have area, and neither is crossed.
    points = np.array([[0.0, 2.0, 1.0, 1.0], [-1.0, -1.0, 0.0, -0.4]])
    mesh = skfem.MeshTri(points, np.array([[0, 0], [1, 1], [2, 3]]))
    said = refusal(mesh.with_boundaries({"contact": np.array([0]), "clamped": np.array([1])}))
    assert "1 edges with both elements on one side" in said and "(1, 0)" in said


def test_mesh_with_missing_inner_or_shared_boundaries_is_rejected(block, tmp_path):
    body, points, elements, lines, groups = block
    mesh = body.mesh
    inner = np.flatnonzero(mesh.f2t[1] >= 0)[:3]
    named = lambda **other: mesh.with_boundaries(other)  # noqa: E731
    assert "no contact boundary" in refusal(named(contact=np.zeros(0, int)))
    assert "no clamped boundary" in refusal(named(clamped=np.zeros(0, int)))
    assert "3 facets of the clamped boundary inside" in refusal(named(clamped=inner))
    both = mesh.boundaries["contact"]
    assert "both contact and clamped" in refusal(named(clamped=both))
    assert "face away" in refusal(
        named(contact=mesh.boundaries["clamped"], clamped=mesh.boundaries["contact"])
    )
    strayed = lines.copy()
    strayed[0] = lines[0, 0], lines[5, 1]
    path = tmp_path / "strayed.msh"
    file_of(points, elements, strayed, groups).write(path, file_format="gmsh22")
    assert "1 of 14 lines of 'contact' that are no edges" in refusal(path)


def test_mesh_with_an_unclamped_part_is_rejected(block):
    mesh = block[0].mesh
    beside = skfem.MeshQuad(np.c_[mesh.p, mesh.p + [[5.0], [0.5]]],
                            np.c_[mesh.t, mesh.t + mesh.nvertices])  # fmt: skip
    said = refusal(
        beside.with_boundaries(
            {
                "contact": lambda x: (np.abs(x[1]) < 1e-9) & (x[0] < 2.0),
                "clamped": lambda x: np.abs(x[1] + 1.0) < 1e-9,
            }
        )
    )
    assert "1 of 2 parts of the body without a clamped edge" in said and "56 elements" in said


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("cut.msh", "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n1 9 1 9\n2 1 0 9\n1\n2\n"),
        ("words.msh", "a mesh of a block"), ("data.inp", "*NODE\n1, a, b\n"),
        ("half.vtu", "<VTKFile><Unstruct"), ("empty.msh", ""), ("packed.vtu", "<VTKFile"),
        ("word.inp", "*ELEMENT, ELSET=a\n1, 1, 2\n"), ("nan.mesh", "MeshVersionFormatted 1\n"
         "Dimension 2\nVertices\n1\n0 0 nan\n"),
    ],
)  # fmt: skip
def test_unreadable_mesh_file_is_rejected(tmp_path, capsys, name, text):
    path = tmp_path / name
    path.write_text(text)
    said = refusal(path)
    assert "meshio cannot read" in said and name in said
    assert capsys.readouterr() == ("", "")


def test_mesh_that_may_name_another_file_is_rejected(block, tmp_path):
    for name in (
        "block.xdmf",
        "block.med",
        "block.e",
        "block.node",
        "block.xml",
        "block.xyz1",
        "block",
    ):
        (tmp_path / name).write_text("1 2 3")
        assert "a mesh is one file" in refusal(tmp_path / name)
    path = tmp_path / "block.inp"
    for line in (
        "*INCLUDE, INPUT=/etc/passwd",
        " *include,input=block.inp",
        "**\n*Include,INPUT=a",
    ):
        path.write_text(f"*NODE\n1, 0., 0., 0.\n{line}\n")
        assert "includes no other one" in refusal(path)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("\n5 0 0 0", "\n99999999 0 0 0", "99999999; numbers of nodes"),
        ("\n5 0 0 0", "\n1e9 0 0 0", "1e9; numbers of nodes"),
        ("4.1 0 8", "4.1 1 8", "a binary file of Gmsh 4"),
        ("-1 -1 0\n0", "-1e200 -1 0\n0", "at most 1e+100"),
        ("1 2 5 4 1\n", "1 2 5 55 1\n", "node 55 of an element; there are the nodes 1 to 6"),
        ("4 5 7\n", "4 -5 7\n", "node -5 of an element"),
    ],
)
def test_mesh_with_impossible_numbers_is_rejected(old, new, said, tmp_path):
    """meshio allocates arrays as long as the largest number of a node."""
    text = next(text for text in (GMSH_2, GMSH_4, MEDIT) if old in text)
    path = tmp_path / ("block.mesh" if text == MEDIT else "block.msh")
    names = {"contact": "7", "clamped": "4"} if text == MEDIT else {}
    path.write_text(text)
    assert ElasticBody(path, **names)
    path.write_text(text.replace(old, new))
    assert said in refusal(path, **names)


def test_compressed_vtu_mesh_is_small(tmp_path):
    """zlib expands a thousandfold."""
    path = tmp_path / "large.vtu"
    rng = np.random.default_rng(0)
    points = np.c_[rng.normal(size=(9000, 2)), np.zeros(9000)]
    mesh = meshio.Mesh(points, [("triangle", np.arange(9000).reshape(-1, 3))])
    mesh.write(path)
    assert "Save it without compression" in refusal(path)
    mesh.write(path, compression=None)
    assert "groups of lines are: none" in refusal(path)
    mesh.write(path, compression="lzma")
    assert "Save it without compression" in refusal(path)


def test_missing_mesh_file_is_rejected(tmp_path):
    assert "no such file" in refusal(tmp_path / "none.msh")


@pytest.mark.parametrize(
    ("sizes", "name"),
    [
        ({"width": 0.0}, "width"), ({"height": np.inf}, "height"), ({"fine": 2.5}, "fine"),
        ({"layers": 0}, "layers"), ({"coarse": True}, "coarse"), ({"growth": -1.0}, "growth"),
        ({"fine_half_width": 4.0}, "fine_half_width"), ({"depth": 3.0}, "depth"),
    ],
)  # fmt: skip
def test_block_sizes_out_of_range_are_rejected_by_name(sizes, name):
    assert repr(name) in refusal(sizes)


def test_elastic_body_rejects_invalid_moduli_and_meshes():
    with pytest.raises(dvax.InputError) as caught:
        ElasticBody(SIZES, youngs_modulus=0.0, poisson_ratio=0.5)
    assert len(caught.value.problems) == 2
    assert "a list" in refusal([1, 2, 3])


def test_elastic_body_without_the_fem_extra_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "skfem", None)
    assert 'pip install "dvax[fem]"' in refusal(SIZES)
