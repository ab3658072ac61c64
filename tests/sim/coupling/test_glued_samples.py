"""Samples of glued pieces: a body that holds displaces as one that cannot break, and its pieces as bodies alone."""

import numpy as np
import pytest
from coupled_tanks import SPACING, Tank

from sim.core.domain import DomainParameters

CUBE = {"kind": "dynamic", "density": 3000.0, "shape": {"type": "box", "size": (5.0 * SPACING,) * 3}}
DOMAIN = DomainParameters(min=(-0.11, -0.11, 0.0), max=(0.11, 0.11, 0.32))


def sinking(breaks: dict | None) -> Tank:
    """A cube of five spacings in the middle of water at rest."""
    body = {**CUBE, "position": (0.0, 0.0, 0.2), **({} if breaks is None else {"breaks": breaks})}
    water = ((-0.11, -0.11, 0.0), (0.11, 0.11, 0.3))
    return Tank([body], domain=DOMAIN, water=water, solver="dfsph", particle_radius=0.5 * SPACING)


def samples_of(tank: Tank) -> tuple[np.ndarray, np.ndarray]:
    """Places [m] and volumes [m³] of the samples of bodies that count, in an order of their own."""
    boundary = tank.fluid.tank.boundary
    rows = slice(boundary.fixed_count, boundary.fixed_count + boundary.body_sample_count)
    place, volume = boundary.samples.position.to_numpy()[rows], boundary.samples.volume.to_numpy()[rows]
    place, volume = place[volume > 0.0], volume[volume > 0.0]
    order = np.lexsort(np.round(place, 6).T)
    return place[order], volume[order]


def test_a_glued_cube_sinks_as_the_same_cube_in_one_piece(taichi_cpu):
    """Its pieces are half as wide as the samples should be deep: with samples of their own it displaced too much."""
    whole, glued = sinking(None), sinking({"strength": 1.0e9, "pieces": 12})
    for tank in (whole, glued):
        tank.run(0.1)
    mover, body = glued.rigid.glue.movers, whole.rigid.bodies
    assert body.velocity[0, 2] < -0.25
    # Its samples are the same, to rounding.
    speed = np.linalg.norm(body.velocity[0])
    np.testing.assert_allclose(mover.velocity[0], body.velocity[0], atol=1.0e-3 * speed)
    np.testing.assert_allclose(mover.angular_velocity[0], body.angular_velocity[0], atol=1.0e-3 * speed / SPACING)


@pytest.mark.parametrize(
    ("shape", "support"),
    [
        ({"type": "cylinder", "radius": 0.06, "height": 0.2}, 2.0),
        ({"type": "cylinder", "radius": 0.06, "height": 0.2}, 3.0),
        ({"type": "sphere", "radius": 0.1}, 2.0),
    ],
)
def test_what_holds_has_the_samples_of_the_whole(taichi_cpu, shape, support):
    body = {"kind": "dynamic", "density": 1000.0, "shape": shape}
    body |= {"position": (0.01, 0.0, 0.16), "rotation_deg": (30.0, 10.0, 0.0)}
    water = ((-0.11, -0.11, 0.0), (0.11, 0.11, 0.02))
    wholes = [body, {**body, "breaks": {"strength": 1.0e9, "pieces": 5}}]
    (place, volume), (glued_place, glued_volume) = (
        samples_of(Tank([each], domain=DOMAIN, water=water, particle_radius=0.01, support_in_spacings=support))
        for each in wholes
    )
    np.testing.assert_allclose(glued_place, place, atol=1.0e-6)
    np.testing.assert_allclose(glued_volume, volume, rtol=1.0e-4)


def test_faces_count_where_they_are_broken_and_nowhere_else(taichi_cpu):
    """Of three glued boxes in a row one breaks off: the samples at the other seam still count for nothing."""
    edge = 6.0 * SPACING
    box = {"type": "box", "size": (edge,) * 3}
    parts = tuple({"shape": box, "position": ((number - 1) * edge, 0.0, 0.0)} for number in range(3))
    body = {"kind": "dynamic", "density": 1000.0, "shape": {"type": "compound", "part": parts}}
    body["breaks"] = {"strength": 1.0e9}
    room = DomainParameters(min=(-0.5, -0.2, -0.2), max=(0.5, 0.2, 0.2))
    water = ((-0.5, -0.2, -0.2), (-0.4, 0.2, -0.1))
    tank = Tank([body], domain=room, water=water, particle_radius=0.5 * SPACING)
    boundary, glue = tank.fluid.tank.boundary, tank.rigid.glue
    surface = boundary.moving.positions + glue.centre[boundary.moving.body]

    def at_seams() -> list[int]:
        rows = slice(boundary.fixed_count, boundary.fixed_count + boundary.body_sample_count)
        counts = boundary.samples.volume.to_numpy()[rows] > 0.0
        inside = np.abs(surface[:, 1:]).max(axis=1) < 0.49 * edge
        return [np.count_nonzero(counts & inside & (np.abs(surface[:, 0] - x) < 1e-6)) for x in (-edge / 2, edge / 2)]

    assert at_seams() == [0, 0]
    (face,) = np.flatnonzero((glue.faces.first == 1) & (glue.faces.second == 2))
    glue.split(np.array([face]))
    tank.coupling.follow(0.0)
    held, broken = at_seams()
    assert held == 0
    # Each side has about one sample per spacing squared.
    assert broken == pytest.approx(2.0 * (edge / SPACING) ** 2, rel=0.25)
