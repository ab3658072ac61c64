"""Springs of a sheet: its stiffness does not depend on how finely it is divided; colours share no node."""

import numpy as np
import pytest
from cloth_scenes import cloth

from sim.cloth.parameters import RectangleSheet
from sim.cloth.sheet import RestSheet, build_sheet, edges_of, sheet_of_triangles
from sim.cloth.springs import TRIANGLE, cells_of, greedy_colours, joined, springs_of
from sim.shapes.solid import ShapeError
from validation.sheet_energy import cell_energies

STIFFNESS = {"stretch_stiffness": 300.0, "shear_stiffness": 70.0, "bend_stiffness": 2.0e-3}


def grid(counts, size=(0.6, 0.4)) -> RestSheet:
    return build_sheet(RectangleSheet(type="rectangle", size=size, counts=counts))


def equal_triangles(columns=24, rows=28, edge=0.02) -> RestSheet:
    """A sheet of equilateral triangles, as a mesh."""
    j, i = (each.ravel() for each in np.mgrid[0:rows, 0:columns])
    vertices = np.stack([(i + 0.5 * (j % 2)) * edge, j * edge * np.sqrt(0.75), 0.0 * i], axis=1)
    triangles = []
    for row in range(rows - 1):
        for column in range(columns - 1):
            a, b = row * columns + column, (row + 1) * columns + column
            odd = row % 2
            triangles += [(a, a + 1, b + odd), (b, b + 1, a + 1 - odd)]
    return sheet_of_triangles(vertices, np.array(triangles), label="lattice")


def elastic_energy(sheet: RestSheet, deform, **keys) -> float:
    """Energy [J] of a sheet whose nodes are moved to where `deform` says."""
    parameters = cloth(
        **{**STIFFNESS, "shear_stiffness": 0.0, "bend_stiffness": 0.0, "stretch_stiffness": 1e-9, **keys}
    )
    positions = deform(sheet.vertices)
    total = 0.0
    for springs in springs_of(sheet):
        lever = np.einsum("ma,mai->mi", springs.coefficients, positions[springs.nodes])
        stretch = np.linalg.norm(lever, axis=1) - springs.rest
        total += float((0.5 * springs.stiffness(parameters) * stretch**2).sum())
    cells = cells_of(sheet)
    return total + float(cell_energies(cells, positions, cells.law(parameters)).sum())


def rolled(curvature, angle=0.0):
    """Onto a cylinder, lengths along it kept."""

    def roll(x):
        turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        y = x @ turn.T
        arc = curvature * y[:, 0]
        return np.stack([np.sin(arc) / curvature, y[:, 1], (1.0 - np.cos(arc)) / curvature], axis=1)

    return roll


@pytest.mark.parametrize("counts", [(9, 7), (61, 41)])
def test_bending_of_a_rectangle_takes_its_rigidity(counts):
    """Only inner nodes bend along a thread: of n springs n - 1 count, as the border has no moment."""
    energy = elastic_energy(grid(counts), rolled(0.5), bend_stiffness=2e-3)
    share = (counts[0] - 2) / (counts[0] - 1)
    # The chord of an arc a is shorter than it by a²/24, 3e-5 here; and that enters the curvature twice.
    assert energy == pytest.approx(0.5 * 2e-3 * 0.25 * 0.24 * share, rel=1e-3)


@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 2])
def test_equal_triangles_bend_alike_in_all_directions(angle):
    sheet = equal_triangles()
    energy = elastic_energy(sheet, rolled(0.5, angle), bend_stiffness=2e-3)
    # Edges on the border do not bend: those are 4 % of the edges here, and on average stand for as much of the energy.
    assert energy == pytest.approx(0.5 * 2e-3 * 0.25 * sheet.node_area.sum(), rel=0.08)


def test_a_curved_mesh_is_at_rest_as_it_is():
    flat = equal_triangles()
    curved = sheet_of_triangles(rolled(5.0)(flat.vertices), flat.triangles, label="roof")
    assert elastic_energy(curved, lambda x: x, **STIFFNESS) < 1e-20
    assert elastic_energy(curved, lambda x: x * 1.01, stretch_stiffness=300.0) > 0.0


def test_node_areas_sum_to_the_sheet():
    assert grid((4, 7)).node_area.sum() == pytest.approx(0.24, rel=1e-12)
    assert grid((4, 7)).node_area[0] == pytest.approx(0.25 * 0.2 * 0.4 / 6, rel=1e-12)


@pytest.mark.parametrize("sheet", [grid((9, 140)), equal_triangles()], ids=["rectangle", "mesh"])
def test_springs_of_one_colour_share_no_node_unless_they_are_of_one_piece_of_thread(sheet):
    families = joined([springs_of(sheet), springs_of(sheet)], [0, len(sheet.vertices)])
    assert sum(len(springs) for springs, _ in families) == 2 * sum(len(springs) for springs in springs_of(sheet))
    for springs, cloth_of in families:
        assert set(cloth_of) == {0, 1}
        block = springs.segment if springs.in_segments else np.arange(len(springs))
        for colour in range(springs.colour.max() + 1):
            own = springs.colour == colour
            pairs = np.unique(np.stack([springs.nodes[own].ravel(), np.repeat(block[own], springs.arity)]), axis=1)
            assert len(np.unique(pairs[0])) == pairs.shape[1]
    for cells, _ in joined([[cells_of(sheet)], [cells_of(sheet)]], [0, len(sheet.vertices)]):
        assert len(cells) == 2 * len(cells_of(sheet))
        for colour in () if cells.arity == TRIANGLE else range(cells.colour.max() + 1):
            nodes = cells.nodes[cells.colour == colour].ravel()
            assert len(np.unique(nodes)) == len(nodes)


def test_springs_of_a_piece_of_thread_follow_one_another():
    for springs, _ in joined([springs_of(grid((9, 140)))], [0]):
        if springs.in_segments:
            same = springs.segment[1:] == springs.segment[:-1]
            np.testing.assert_array_equal(springs.nodes[1:][same, 0], springs.nodes[:-1][same, 1])


def test_colours_are_few_and_the_same_every_time():
    sheet = equal_triangles()
    nodes = edges_of(sheet.triangles).nodes
    colours = greedy_colours(nodes, len(sheet.vertices))
    np.testing.assert_array_equal(colours, greedy_colours(nodes, len(sheet.vertices)))
    assert colours.max() + 1 <= 11  # six edges at a node: ten others share one with an edge


def test_a_mesh_with_split_vertices_is_sewn_and_pins_find_its_vertices():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 0], [1, 1, 0], [0, 1, 0], [9, 9, 9]], dtype=float)
    sheet = sheet_of_triangles(square, np.array([[0, 1, 2], [3, 4, 5]]), label="split")
    assert len(sheet.vertices) == 4
    assert any("merged 3 split or unused vertices" in warning for warning in sheet.warnings)
    np.testing.assert_allclose(sheet.vertices[sheet.node_of_vertex[:6]], square[:6], atol=1e-6)
    assert sheet.node_of_vertex[6] == -1


def test_triangles_that_face_away_are_turned():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    sheet = sheet_of_triangles(square, np.array([[0, 1, 2], [0, 3, 2]]), label="twisted")
    a, b, c = np.moveaxis(sheet.vertices[sheet.triangles], 1, 0)
    assert len(set(np.sign(np.cross(b - a, c - a)[:, 2]))) == 1
    assert any("turned 1 of 2 triangles" in warning for warning in sheet.warnings)


@pytest.mark.parametrize(
    ("vertices", "triangles", "message"),
    [
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.zeros((0, 3)), "has no triangles"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], [[0, 1, 2], [0, 1, 3]], "1 triangles .* have no area"),
        (
            [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0]],
            [[0, 1, 2], [1, 0, 3], [0, 1, 4]],
            r"1 edges .* three triangles or more, the first at \(0.5, 0, 0\) m",
        ),
        ([[0, 0, 0], [1, 0, np.inf], [0, 1, 0]], [[0, 1, 2]], "vertex 1 .* is not finite"),
    ],
)
def test_meshes_that_are_no_sheet_are_refused_and_it_is_said_where(vertices, triangles, message):
    with pytest.raises(ShapeError, match=message):
        sheet_of_triangles(np.array(vertices, dtype=float), np.array(triangles, dtype=int), label="bad")


def test_a_moebius_strip_is_refused():
    count = 12
    angle = 2 * np.pi * np.arange(count) / count
    across = np.stack([np.cos(angle / 2) * np.cos(angle), np.cos(angle / 2) * np.sin(angle), np.sin(angle / 2)], axis=1)
    middle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    vertices = np.concatenate([middle + 0.3 * across, middle - 0.3 * across])
    triangles = []
    for k in range(count):
        a, b = k, k + count
        c, d = (k + 1, k + 1 + count) if k < count - 1 else (count, 0)
        triangles += [(a, b, c), (b, d, c)]
    with pytest.raises(ShapeError, match="has one side only"):
        sheet_of_triangles(vertices, np.array(triangles), label="strip")
