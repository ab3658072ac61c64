"""Meshes that files animate: read once, as they are, and refused where they cannot be used."""

import numpy as np
import pytest
from animated_files import BOX_FACES, ball, box, write_alembic, write_usd

from sim.core.motion import rotation
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.paths import path_of
from sim.shapes import animation
from sim.shapes.animation import load_animation
from sim.shapes.deformation import Deformation
from sim.shapes.mesh_solid import MeshSolid
from sim.shapes.parameters import AnimationShape
from sim.shapes.placement import build_solid
from sim.shapes.solid import ShapeError, TriangleMesh

TURNS_DEG = np.linspace(0.0, 80.0, 9)
PLACES = np.stack([np.linspace(0.3, 0.7, 9), np.linspace(0.1, 0.0, 9) ** 2, np.full(9, 0.2)], axis=1)


def paddle() -> np.ndarray:
    """A box that moves and turns about z without deforming, (9, 8, 3)."""
    corners = box((0.1, 0.3, 0.2))
    return np.stack(
        [
            rotation.rotated(rotation.from_degrees((0.0, 0.0, turn)), corners) + place
            for turn, place in zip(TURNS_DEG, PLACES, strict=True)
        ]
    )


def breathing(radius: float, factors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = ball(radius)
    return factors[:, None, None] * vertices, faces


def shape_of(path: object, **more: object) -> AnimationShape:
    return AnimationShape.model_validate({"type": "animation", "file": str(path), **more})


def body_of(path: object, *, shape: dict | None = None, **more: object) -> RigidBodyParameters:
    own = {"type": "animation", "file": str(path), **(shape or {})}
    return RigidBodyParameters.model_validate({"name": "thing", "kind": "kinematic", "shape": own, **more})


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    """A folder of read animations of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "physics-pipeline" / "animations"


def test_alembic_and_usd_give_the_same_points_whatever_their_axes_and_units(tmp_path):
    points = paddle()
    y_up = points[:, :, [0, 2, 1]] * np.array([1.0, 1.0, -1.0])
    files = [
        write_usd(tmp_path / "z.usdc", points, BOX_FACES),
        write_usd(tmp_path / "y.usda", 100.0 * y_up, BOX_FACES, up="y", unit_m=0.01),
        write_alembic(tmp_path / "a.abc", points, BOX_FACES),
    ]
    for file in files:
        solid = load_animation(shape_of(file))
        np.testing.assert_allclose(solid.times, np.arange(9) / 24.0, atol=1e-9)
        # Files have float32, those of Blender shape keys that add up.
        for number in (0, 4, 8):
            np.testing.assert_allclose(solid.points(number), points[number], atol=2e-6)


def test_a_file_says_how_fast_it_is_and_alembic_is_told(tmp_path):
    points = paddle()
    usd = write_usd(tmp_path / "slow.usdc", points, BOX_FACES, fps=12.0)
    abc = write_alembic(tmp_path / "fast.abc", points, BOX_FACES, fps=30)
    assert load_animation(shape_of(usd)).duration_s == pytest.approx(8 / 12)
    assert load_animation(shape_of(abc, fps=30)).duration_s == pytest.approx(8 / 30)


def test_a_rigid_animation_is_a_path(tmp_path):
    body = body_of(write_usd(tmp_path / "paddle.usdc", paddle(), BOX_FACES), position=(0.0, 0.0, 1.0))
    solid, path = build_solid(body), path_of(body)
    assert solid.shape.deformed is None
    np.testing.assert_allclose(solid.bounds.mean(axis=0), PLACES[0] + [0.0, 0.0, 1.0], atol=1e-6)
    for number in range(9):
        motion = path.at(number / 24.0 if number < 8 else 1.0)  # and it stays after the last
        np.testing.assert_allclose(motion.position, PLACES[number] + [0.0, 0.0, 1.0], atol=1e-6)
        np.testing.assert_allclose(rotation.to_degrees(motion.orientation), (0.0, 0.0, TURNS_DEG[number]), atol=1e-3)


def test_it_is_scaled_turned_and_moved_and_begins_when_it_should(tmp_path):
    file = write_usd(tmp_path / "paddle.usdc", paddle(), BOX_FACES)
    placed = {"scale": 2.0, "rotation_deg": (0.0, 0.0, 90.0), "position": (1.0, 0.0, 0.0)}
    body = body_of(file, shape={"start_s": 0.5}, **placed)
    solid, path = build_solid(body), path_of(body)
    expected = 2.0 * rotation.rotated(rotation.from_degrees((0.0, 0.0, 90.0)), PLACES) + [1.0, 0.0, 0.0]
    np.testing.assert_allclose(path.at(0.0).position, expected[0], atol=1e-6)
    assert not path.at(0.4).velocity.any()
    np.testing.assert_allclose(path.at(0.5 + 4 / 24).position, expected[4], atol=1e-6)
    np.testing.assert_allclose(np.ptp(solid.bounds, axis=0), (0.6, 0.2, 0.4), atol=1e-6)


def test_points_that_deform_go_through_the_samples_with_velocities_that_are_their_derivatives(tmp_path):
    factors = 1.0 + 0.3 * np.sin(np.linspace(0.0, 2.0 * np.pi, 13)) ** 2
    points, faces = breathing(0.1, factors)
    shape = shape_of(write_usd(tmp_path / "lung.usdc", points, faces))
    deformation = Deformation(load_animation(shape), shape, 1.0)
    for number in range(12):
        np.testing.assert_allclose(deformation.vertices(number / 24.0)[0], points[number], atol=1e-6)
    step = 1.0e-6
    for time_s in (0.0203, 0.2, 0.31):
        ahead, behind = (deformation.vertices(time_s + sign * step)[0] for sign in (1.0, -1.0))
        _, velocity = deformation.vertices(time_s)
        np.testing.assert_allclose((ahead - behind) / (2.0 * step), velocity, atol=1e-6)
        assert np.linalg.norm(velocity, axis=1).max() <= 1.02 * deformation.speed(time_s)
    for time_s in (-1.0, 0.5, 2.0):
        assert not deformation.vertices(time_s)[1].any()


def test_distances_and_velocities_are_those_of_the_surface_at_the_time(tmp_path):
    factors = 1.0 + np.linspace(0.0, 0.5, 13)
    points, faces = breathing(0.1, factors)
    shape = shape_of(write_usd(tmp_path / "grows.usdc", points, faces), interpolation="linear")
    deformation = Deformation(load_animation(shape), shape, 1.0)
    directions = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [-0.48, 0.6, -0.64]])
    for time_s in (0.03, 0.26):
        vertices, _ = deformation.vertices(time_s)
        exact = MeshSolid(TriangleMesh(vertices, faces.astype(np.int32)))
        near = np.concatenate([0.1 * directions, 0.11 * directions]) * (1.0 + time_s)
        found = deformation.level_set(time_s).signed_distance(near)
        # Trilinear on a grid of 48 cells, of a ball of 0.1 m or more: h² / 4 R is 1e-4.
        np.testing.assert_allclose(found, exact.signed_distance(near), atol=2e-4)
        radius = 0.1 * (1.0 + time_s)
        velocity = deformation.velocities(radius * directions, time_s)
        # Every point of the surface moves outwards by 0.1 m/s.
        np.testing.assert_allclose(velocity, 0.1 * directions, atol=2e-3)


def test_points_are_kept_under_their_triangles(tmp_path):
    points, faces = breathing(0.1, 1.0 + np.linspace(0.0, 0.5, 5))
    shape = shape_of(write_usd(tmp_path / "grows.usdc", points, faces))
    deformation = Deformation(load_animation(shape), shape, 1.0)
    under = 0.9 * points[0][:20]
    attached = deformation.attach(under)
    np.testing.assert_allclose(attached.at(points[0]), under, atol=1e-6)
    grown = attached.at(points[4])
    # They stay 1 cm under the surface, which is 1.5 times as far out.
    np.testing.assert_allclose(np.linalg.norm(grown, axis=1), 0.15 - 0.01, atol=5e-4)


def test_a_file_is_read_once(tmp_path, own_cache, monkeypatch):
    file = write_usd(tmp_path / "paddle.usdc", paddle(), BOX_FACES)
    first = load_animation(shape_of(file))
    assert len(list(own_cache.glob("*.npz"))) == 1
    animation._load.cache_clear()
    monkeypatch.setattr(animation, "READER", tmp_path / "no reader")
    again = load_animation(shape_of(file))
    np.testing.assert_array_equal(again.positions, first.positions)


def test_what_was_cut_off_as_it_was_kept_is_read_again(tmp_path, own_cache):
    file = write_usd(tmp_path / "paddle.usdc", paddle(), BOX_FACES)
    first = load_animation(shape_of(file))
    (kept,) = own_cache.glob("*.npz")
    kept.write_bytes(kept.read_bytes()[:100])
    animation._load.cache_clear()
    np.testing.assert_array_equal(load_animation(shape_of(file)).positions, first.positions)


def changing_faces(path):
    from pxr import Usd, UsdGeom, Vt

    write_usd(path, paddle(), BOX_FACES)
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/thing"))
    for counts, indices, frame in ((12, BOX_FACES, 1), (11, BOX_FACES[:11], 5)):
        mesh.GetFaceVertexCountsAttr().Set(Vt.IntArray([3] * counts), frame)
        mesh.GetFaceVertexIndicesAttr().Set(Vt.IntArray(indices.ravel().tolist()), frame)
    stage.Save()


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (lambda _path: None, "does not exist"),
        (lambda path: path.write_bytes(b"nothing of use"), "not a readable USD file"),
        (lambda path: write_usd(path, paddle()[:1], BOX_FACES), "has one sample alone"),
        (lambda path: write_usd(path, paddle(), BOX_FACES[:11]), "is open: 3 edges"),
        (changing_faces, "changes its mesh at sample 4, 0.1667 s after its first"),
        (lambda path: write_usd(path, paddle() * np.array([1.0, 1.0, 0.0]), BOX_FACES), "encloses no volume"),
        (
            lambda path: write_usd(path, paddle() * np.linspace(1.0, -1.0, 9)[:, None, None], BOX_FACES),
            "encloses no volume at sample 4, 0.1667 s",
        ),
    ],
    ids=["missing", "unreadable", "still", "open", "other faces", "flat", "inside out"],
)
def test_files_that_cannot_be_used_are_refused_with_the_reason(tmp_path, write, said):
    path = tmp_path / "thing.usdc"
    write(path)
    with pytest.raises(ShapeError, match=said):
        load_animation(shape_of(path))


def test_an_object_that_is_not_there_is_refused_with_those_that_are(tmp_path):
    file = write_usd(tmp_path / "paddle.usdc", paddle(), BOX_FACES)
    with pytest.raises(ShapeError, match='has no mesh named "oar"; its meshes: "thing"'):
        load_animation(shape_of(file, object="oar"))


def test_a_mesh_that_is_inside_out_is_turned(tmp_path):
    file = write_usd(tmp_path / "paddle.usdc", paddle(), BOX_FACES[:, ::-1])
    solid = load_animation(shape_of(file))
    assert solid.mesh.signed_volume > 0.0
    assert "was inside out" in solid.warnings[0]


def test_seams_are_closed(tmp_path):
    corners = BOX_FACES.ravel()
    file = write_usd(tmp_path / "seams.usdc", paddle()[:, corners], np.arange(len(corners)).reshape(-1, 3))
    assert len(load_animation(shape_of(file)).mesh.vertices) == 8


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"kind": "static"}, 'is "kinematic"'),
        ({"velocity": (1.0, 0.0, 0.0)}, "comes from there"),
        ({"keyframe": [{"time_s": 0.0, "position": (0.0, 0.0, 0.0)}]}, "cannot lead a body that a file animates"),
        ({"count": 3, "spacing": 0.1}, "cannot be of a body that a file animates"),
        ({"shape": {"fps": 25.0}}, "says so itself"),
        ({"shape": {"file": "walk.fbx"}}, "must be an Alembic"),
    ],
)
def test_keys_that_mean_nothing_are_refused(more, said):
    with pytest.raises(ValueError, match=said):
        body_of("walk.usdc", **more)
