"""Where cloths start, and whether they cross, held against an independent count of crossing triangles."""

import tracemalloc

import numpy as np
import pytest

from sim.build import build_world
from sim.cloth.continuous_contacts import RECOVERY_TIME_S
from sim.cloth.parameters import ClothParameters
from sim.cloth.sheet import build_sheet, edges_of
from sim.cloth.start import TOUCHING, first_crossing, start_positions
from sim.scene import SceneParameters
from validation.crossing_triangles import crossings


def soup(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Twelve loose triangles in a box so large that about half of the soups have a crossing."""
    random = np.random.default_rng(seed)
    corners = random.uniform(0.0, 2.5, (12, 1, 3)) + random.uniform(-0.6, 0.6, (12, 3, 3))
    return corners.reshape(-1, 3), np.arange(36, dtype=np.int32).reshape(-1, 3)


def test_loose_triangles_cross_exactly_where_the_independent_count_says_so():
    answers = []
    for seed in range(60):
        position, triangles = soup(seed)
        point = first_crossing(position, edges_of(triangles).nodes, triangles)
        answers.append(point is not None)
        assert answers[-1] == (len(crossings(position, triangles)) > 0), seed
        if point is not None:
            # On a triangle, up to round-off of coordinates of some metres.
            normals = np.cross(*(position[triangles[:, k]] - position[triangles[:, 0]] for k in (1, 2)))
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            heights = np.einsum("ij,ij->i", normals, point - position[triangles[:, 0]])
            assert np.abs(heights).min() < 1e-12
    assert 10 < sum(answers) < 50  # both kinds were seen


def test_how_many_are_looked_at_together_does_not_change_the_answer(monkeypatch):
    scenes = [soup(seed) for seed in range(20)]
    at_once = [first_crossing(position, edges_of(triangles).nodes, triangles) for position, triangles in scenes]
    monkeypatch.setattr("sim.cloth.start.PAIRS_AT_ONCE", 1)
    one_by_one = [first_crossing(position, edges_of(triangles).nodes, triangles) for position, triangles in scenes]
    assert any(point is not None for point in at_once)
    assert [point is None for point in at_once] == [point is None for point in one_by_one]


def beside_a_giant(height: float) -> tuple[np.ndarray, np.ndarray]:
    """A sheet of 1,250 triangles of a few centimetres, and one of 20 m that stands so high above its middle."""
    sheet = build_sheet(
        ClothParameters(name="s", shape={"type": "rectangle", "size": (1, 1), "counts": (26, 26)}).shape
    )
    giant = np.array([[0.013, 0.0, height], [10.0, 0.0, 20.0 + height], [-10.0, 0.0, 20.0 + height]])
    corners = len(sheet.vertices) + np.arange(3)
    return np.concatenate([sheet.vertices, giant]), np.concatenate([sheet.triangles, [corners]])


def test_one_giant_triangle_does_not_make_every_triangle_a_neighbour_of_every_edge():
    position, triangles = beside_a_giant(0.01)
    tracemalloc.start()
    assert first_crossing(position, edges_of(triangles).nodes, triangles) is None
    _, most_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # 1,928 edges, each with the triangles near it, take 3 MB; each with all 1,251 triangles 900 MB.
    assert most_bytes < 40e6


def test_a_giant_triangle_that_passes_through_small_ones_is_found():
    position, triangles = beside_a_giant(-0.01)
    point = first_crossing(position, edges_of(triangles).nodes, triangles)
    # The giant is 0.02 m wide where it meets the sheet, about its lowest corner.
    np.testing.assert_allclose(point, [0.013, 0.0, 0.0], atol=0.011)


NEAR = 0.9 * TOUCHING
FAR = 1.1 * TOUCHING
BELOW = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


@pytest.mark.parametrize(
    ("triangle", "meets"),
    [
        pytest.param([[0.2, 0.2, 0], [0.9, 0.2, 0.5], [0.2, 0.9, 0.5]], True, id="a corner stands on it"),
        pytest.param([[0.2, 0.2, NEAR], [0.9, 0.2, 0.5], [0.2, 0.9, 0.5]], True, id="a corner is just above it"),
        pytest.param([[0.2, 0.2, -FAR], [0.9, 0.2, -0.5], [0.2, 0.9, -0.5]], False, id="a corner is farther below it"),
        pytest.param([[0.2, 0.2, 0], [0.9, 0.2, 0], [0.2, 0.9, 0]], True, id="in its plane, a corner in it"),
        pytest.param([[-1, -1, 0], [3, -1, 0], [-1, 3, 0]], True, id="in its plane, all around it"),
        pytest.param([[0.7, 0.7, 0], [-0.3, 0.7, 0], [0.7, -0.3, 0]], True, id="in its plane, only sides cross"),
        pytest.param([[1, 1, 0], [2, 1, 0], [1, 2, 0]], False, id="in its plane, beside it"),
        pytest.param([[0, -NEAR, 0], [0.8, -NEAR, 0], [0, -1, 0]], True, id="in its plane, a side along one of its"),
        pytest.param([[0, -FAR, 0], [0.8, -FAR, 0], [0, -1, 0]], False, id="in its plane, a side farther off"),
        pytest.param(
            [[0.5, -NEAR, -1], [0.5, -NEAR, 1], [0.5, -1, 0]], True, id="a side crosses just beside one of its"
        ),
        pytest.param([[0.5, -FAR, -1], [0.5, -FAR, 1], [0.5, -1, 0]], False, id="a side crosses farther off"),
    ],
)
def test_triangles_meet_where_they_come_within_what_rounding_tells_apart(triangle, meets):
    position = np.array([*BELOW, *triangle], dtype=float)
    triangles = np.array([[0, 1, 2], [3, 4, 5]], dtype=np.int32)
    point = first_crossing(position, edges_of(triangles).nodes, triangles)
    assert (point is not None) == meets


def test_flat_sheets_do_not_meet_themselves():
    sheet = build_sheet(
        ClothParameters(name="s", shape={"type": "rectangle", "size": (1, 1), "counts": (26, 26)}).shape
    )
    assert first_crossing(sheet.vertices, edges_of(sheet.triangles).nodes, sheet.triangles) is None


def test_a_cloth_starts_turned_about_its_middle_and_moved():
    cloth = ClothParameters(
        name="sheet",
        shape={"type": "rectangle", "size": (2.0, 1.0), "counts": (3, 2)},
        position=(5.0, 0.0, 1.0),
        rotation_deg=(90.0, 0.0, 0.0),
    )
    corner = start_positions(cloth, build_sheet(cloth.shape))[0]
    np.testing.assert_allclose(corner, [4.0, 0.0, 0.5], atol=1e-15)


def scene(*, pinned: bool) -> SceneParameters:
    """A sheet whose edge is in the middle of a post."""
    sheet = {
        "name": "flag",
        "shape": {"type": "rectangle", "size": (0.4, 0.3), "counts": (5, 4)},
        "position": (0.2, 0, 0.5),
    }
    post = {"name": "post", "shape": {"type": "box", "size": (0.04, 0.4, 0.2)}, "position": (0.0, 0.0, 0.5)}
    return SceneParameters.model_validate(
        {"cloth": (sheet | ({"pin": ({"edge": "x-"},)} if pinned else {}),), "rigid": (post,)}
    )


@pytest.mark.usefixtures("taichi_cpu")
def test_an_edge_may_be_pinned_inside_a_post_but_not_start_there_free():
    with pytest.raises(ValueError, match=r'cloth "flag" starts inside "post" with 4 of its nodes, deepest at \(0, '):
        build_world(scene(pinned=False), frames_per_second=60)
    world = build_world(scene(pinned=True), frames_per_second=60)
    before = world.snapshots()["flag"].arrays["position"]
    world.advance_frame()
    after = world.snapshots()["flag"].arrays["position"]
    held = before[:, 0] < 0.01
    np.testing.assert_array_equal(after[held], before[held])
    assert (after[~held, 2] < before[~held, 2]).any()


def test_a_scene_whose_positions_are_too_coarse_for_the_cloth_is_refused():
    """In a domain of 100 km they were rounded to 4 mm, and layers 0.5 mm apart crossed; far off float32 does it."""
    sheet = {"name": "flag", "shape": {"type": "rectangle", "size": (0.4, 0.3), "counts": (5, 4)}}
    far = {**sheet, "position": (1.0e4, 0.0, 0.5)}
    near_far = {"min": (9999.0, -1.0, 0.0), "max": (1.0e4 + 1.0, 1.0, 1.0)}
    for cloth, domain, unit in ((sheet, {"min": (-1.0e5, -1.0, 0.0)}, "0.002"), (far, near_far, "0.00098")):
        scene = SceneParameters.model_validate({"cloth": (cloth,), "domain": domain})
        with pytest.raises(ValueError, match=rf'cloth "flag": its positions are rounded to {unit} m, and its layers'):
            build_world(scene, frames_per_second=60)


@pytest.mark.usefixtures("taichi_cpu")
@pytest.mark.parametrize("thickness", [0.5e-3, 5.0e-3])
def test_layers_that_start_nearer_than_their_thickness_are_pushed_apart_gently(thickness):
    """Weightless sheets a hundredth of a thickness apart, one over the other and on a floor."""
    sheet = {"shape": {"type": "rectangle", "size": (0.2, 0.2), "counts": (11, 11)}, "thickness": thickness}
    cloths = [
        {
            **sheet,
            "name": f"layer{k}",
            "position": (0.0, 0.0, 0.01 * k * thickness),
            "rotation_deg": (0.0, 0.0, 7.0 * k),
        }
        for k in range(4)
    ]
    scene = {"cloth": cloths, "gravity": (0.0, 0.0, 0.0), "domain": {"max": (0.5, 0.5, 10.0)}}
    world, speeds = build_world(SceneParameters.model_validate(scene), frames_per_second=60), []
    solver = world.solvers["cloth"]
    world.watch = lambda: speeds.append(float(np.abs(solver.state.velocity.to_numpy()).max()))
    for _ in range(6):
        numbers = world.advance_frame().diagnostics["cloth"]
        assert numbers["crossings_left"] == 0.0
    assert 0.0 < max(speeds) < 4 * thickness / RECOVERY_TIME_S
    heights = solver.state.positions()[:, 2].reshape(4, -1)
    assert len(crossings(solver.state.positions(), solver.state.host.triangles)) == 0
    assert (np.diff(heights.mean(axis=1)) > 0.9 * thickness).all()
