"""Films of particles on walls close, and surfaces end flat on the walls that they wet."""

from __future__ import annotations

import numpy as np
import pytest
from test_sheets import D, parts_and_holes
from test_surface import RADIUS, ball, enclosed_volume, is_closed_manifold

from render.meshes import SurfaceMesh
from render.parameters import SurfaceParameters
from render.surface import reconstruct_surface
from render.walls import Walls, films, folded_onto, in_films

PANE = Walls(np.array([0.0, -np.inf, -np.inf]), np.full(3, np.inf))
FLOOR = Walls(np.array([-np.inf, -np.inf, 0.0]), np.full(3, np.inf))


def on_pane(stretch: float, count: int = 24, *, seed: int = 0) -> np.ndarray:
    """Particles (n, 3) of a film on the plane x = 0, some spacings apart, as far from it as half to 1.2 spacings."""
    generator = np.random.default_rng(seed)
    axis = stretch * D * np.arange(count)
    places = np.stack(np.meshgrid([0.0], axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    places += generator.normal(0, 0.2 * D, places.shape)
    places[:, 0] = generator.uniform(0.3, 1.2, len(places)) * D
    return places.astype(np.float32)


def mesh_of(positions: np.ndarray, walls: Walls, *, volume: float | None = None) -> SurfaceMesh:
    return reconstruct_surface(
        positions,
        np.zeros_like(positions),
        particle_radius=RADIUS,
        parameters=SurfaceParameters(),
        is_thin=np.ones(len(positions), bool),
        volume=volume,
        walls=walls,
    )


@pytest.mark.parametrize(("stretch", "least"), [(1.5, 2), (2.0, 50), (2.5, 50)])
def test_a_film_on_a_pane_is_one_closed_piece(stretch, least):
    """Without the pane it is in so many parts or has as many holes."""
    positions = on_pane(stretch)
    parts, holes = parts_and_holes(mesh_of(positions, Walls.nowhere()))
    assert parts + holes >= least
    assert in_films(positions, PANE, spacing=D).all()
    film = mesh_of(positions, PANE)
    assert parts_and_holes(film) == (1, 0)
    assert film.vertices[:, 0].min() == pytest.approx(0.1 * RADIUS, rel=1e-5)


def test_a_film_that_is_thick_enough_encloses_the_volume_of_its_particles():
    positions = on_pane(1.25)
    volume = len(positions) * D**3
    film = mesh_of(positions, PANE, volume=volume)
    assert enclosed_volume(film) == pytest.approx(volume, rel=1e-3)
    assert is_closed_manifold(film)
    assert film.vertices[:, 0].min() >= np.float32(0.1 * RADIUS)


def test_drops_on_a_pane_that_are_far_apart_are_no_film():
    two = np.array([[0.5 * D, 0.0, 0.0], [0.5 * D, 8.0 * D, 0.0]], np.float32)
    assert not in_films(two, PANE, spacing=D).any()
    assert parts_and_holes(mesh_of(two, PANE)) == (2, 0)


def test_what_is_off_the_pane_or_at_an_open_face_or_on_the_floor_is_no_film():
    film = on_pane(1.5)
    assert not in_films(film + np.array([3.0 * D, 0, 0], np.float32), PANE, spacing=D).any()
    assert not in_films(film, Walls.nowhere(), spacing=D).any()
    assert not in_films(np.ascontiguousarray(film[:, [1, 2, 0]]), FLOOR, spacing=D).any()


def test_still_water_in_a_tank_has_no_film_and_keeps_its_level():
    axis = D * (np.arange(12) + 0.5)
    block = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    tank = Walls(np.zeros(3), np.array([12.0 * D, 12.0 * D, np.inf]))
    assert not films(block, block, tank, spacing=D).replaces.any()
    assert not len(films(block, block, tank, spacing=D).position)
    assert not in_films(block, tank, spacing=D).any()
    free = reconstruct_surface(block, block, particle_radius=RADIUS, parameters=SurfaceParameters())
    water = reconstruct_surface(block, block, particle_radius=RADIUS, parameters=SurfaceParameters(), walls=tank)
    assert is_closed_manifold(water)
    # Flat up to the walls, where a block without walls has a round edge.
    assert water.vertices[:, 2].max() == pytest.approx(free.vertices[:, 2].max(), abs=0.05 * D)
    inset = np.float32(0.1 * RADIUS)
    assert water.vertices.min(axis=0) == pytest.approx([inset] * 3)
    assert water.vertices[:, :2].max(axis=0) == pytest.approx([12.0 * D - inset] * 2)
    at_wall = water.vertices[:, 0] == inset
    assert water.vertices[at_wall, 2].max() == pytest.approx(water.vertices[:, 2].max(), abs=0.1 * D)
    assert water.normals is not None
    inside = at_wall & (np.abs(water.vertices[:, 1:] - 6.0 * D) < 4.0 * D).all(axis=1)
    assert water.normals[inside] == pytest.approx(np.tile([-1.0, 0.0, 0.0], (np.count_nonzero(inside), 1)))
    assert enclosed_volume(water) == pytest.approx(len(block) * D**3, rel=0.05)
    assert abs(enclosed_volume(water) / (len(block) * D**3) - 1) < abs(enclosed_volume(free) / (len(block) * D**3) - 1)


def test_water_whose_uppermost_layer_has_gaps_climbs_no_wall():
    """As a block has that keeps its mass: what is left of the layer at the walls has few neighbours."""
    axes = [(np.arange(count) + 0.5) * D for count in (16, 16, 6)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    is_left = np.random.default_rng(0).uniform(size=len(places)) < 0.54
    water = places[(places[:, 2] < 5.0 * D) | is_left].astype(np.float32)
    tank = Walls(np.zeros(3), np.array([16.0 * D, 16.0 * D, np.inf]))
    surface = mesh_of(water, tank, volume=len(water) * D**3)
    assert surface.vertices[:, 2].max() < 6.5 * D


def test_what_is_behind_a_wall_as_a_whole_is_left_out_and_the_rest_folded_onto_it():
    sphere = mesh_of(ball(), Walls.nowhere())
    across, behind = sphere.vertices, sphere.vertices - np.array([1.0, 0.0, 0.0], np.float32)
    both = SurfaceMesh(
        np.concatenate([behind, across]),
        np.concatenate([sphere.faces, sphere.faces + len(behind)]),
        np.tile(sphere.normals, (2, 1)),
        np.tile(sphere.velocities, (2, 1)),
    )
    folded, kept = folded_onto(both, PANE)
    np.testing.assert_array_equal(kept, np.arange(len(behind), 2 * len(behind)))
    np.testing.assert_array_equal(folded.faces, sphere.faces)
    assert folded.vertices[:, 0].min() == 0.0
    assert enclosed_volume(folded) == pytest.approx(0.5 * enclosed_volume(sphere), rel=0.02)


def test_films_move_as_their_particles_do():
    positions = on_pane(2.0)
    velocities = np.tile(np.array([[0.0, 0.5, 3.0]], np.float32), (len(positions), 1))
    film = films(positions, velocities, PANE, spacing=D)
    assert film.replaces.all()
    assert film.velocity == pytest.approx(np.tile([[0.0, 0.5, 3.0]], (len(film.velocity), 1)), rel=1e-4)


def test_the_same_particles_give_the_same_film():
    one, other = (mesh_of(on_pane(2.0), PANE, volume=0.2 * D**3 * 24**2) for _ in range(2))
    for name in ("vertices", "faces", "normals", "velocities"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()
