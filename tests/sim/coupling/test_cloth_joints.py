"""Joints to points of cloth: both sides feel the same, whatever hangs there."""

import math

import numpy as np
import pytest
from thread_counts import digest_of, result_on_any_threads

from sim.build import build_world
from sim.cloth.solver import ClothSolver
from sim.core.world import World
from sim.rigid.solver import RigidSolver
from sim.scene import SceneParameters

pytestmark = pytest.mark.usefixtures("taichi_cpu")

GRAVITY, TOP, FRAMES_PER_SECOND = 9.81, 2.0, 60.0
RADIUS, HEIGHT = 0.012, 0.06  # of a link [m]
PITCH = HEIGHT + 2.0 * RADIUS
LINK_VOLUME = math.pi * RADIUS**2 * HEIGHT + 4.0 / 3.0 * math.pi * RADIUS**3
CORNERS = tuple({"corner": corner} for corner in ("x-y-", "x+y-", "x-y+", "x+y+"))
LINES = {"rope": {}, "distance": {}, "spring": {"stiffness": 400.0}}
EVERY_FACE = ("x-", "x+", "y-", "y+", "z-", "z+")


def sheet(**keys):
    """0.3 m of cloth at 0.2 kg/m², level, in a vacuum."""
    shape = {"type": "rectangle", "size": (0.3, 0.3), "counts": (11, 11)}
    own = {"name": "sheet", "shape": shape, "position": (0.0, 0.0, TOP), "mass_per_area": 0.2, "air_density": 0.0}
    return {**own, **keys}


def chain(links, mass, at=(0.0, 0.0, TOP)):
    """Links of a mass [kg] that hang from a place, and the balls between them."""
    x, y, top = at
    bodies = [
        {
            "name": f"link{k}",
            "kind": "dynamic",
            "density": mass / LINK_VOLUME,
            "shape": {"type": "capsule", "radius": RADIUS, "height": HEIGHT},
            "position": (x, y, top - (k + 0.5) * PITCH),
        }
        for k in range(links)
    ]
    balls = [
        {"name": f"ball{k}", "kind": "ball", "between": (f"link{k - 1}", f"link{k}"), "anchor": (x, y, top - k * PITCH)}
        for k in range(1, links)
    ]
    return bodies, balls


def hook(kind="ball", at=(0.0, 0.0, TOP), **keys):
    place = {"anchor": at} if kind == "ball" else {"anchors": ((at[0], at[1], at[2] - 0.5 * PITCH), at)}
    return {"name": "hook", "kind": kind, "between": ("link0", "sheet"), **place, **LINES.get(kind, {}), **keys}


def world_of(bodies, joints, cloth, gravity=(0.0, 0.0, -GRAVITY)) -> World:
    domain = {"min": (-1.0, -1.0, 0.0), "max": (1.0, 1.0, 4.0), "open_faces": EVERY_FACE}
    scene = {"gravity": gravity, "domain": domain, "rigid": bodies, "joint": joints, "cloth": [cloth]}
    return build_world(SceneParameters.model_validate(scene), frames_per_second=FRAMES_PER_SECOND)


def hanging(links=10, mass=0.2, kind="ball", at=(0.0, 0.0, TOP), cloth=None, gravity=(0.0, 0.0, -GRAVITY), **keys):
    bodies, balls = chain(links, mass, at)
    return world_of(bodies, [*balls, hook(kind, at, **keys)], cloth or sheet(pin=CORNERS), gravity)


def cloth_of(world) -> ClothSolver:
    return world.solvers["cloth"]


def rigid_of(world) -> RigidSolver:
    return world.solvers["rigid"]


def node_at(world, place) -> int:
    return int(np.argmin(np.linalg.norm(cloth_of(world).state.host.position - place, axis=1)))


def heights(world, node, frames):
    found = []
    for _ in range(frames):
        world.advance_frame()
        found.append(cloth_of(world).state.positions()[node, 2])
    return np.array(found)


def totals(world):
    """Linear and angular momentum, and kinetic energy, of cloth and bodies."""
    state, bodies = cloth_of(world).state, rigid_of(world).bodies
    mass, velocity, position = state.mass.to_numpy(), state.velocity.to_numpy().astype(float), state.positions()
    of_nodes, of_bodies = mass[:, None] * velocity, bodies.mass[:, None] * bodies.velocity
    angular = np.cross(position, of_nodes).sum(axis=0) + np.cross(bodies.position, of_bodies).sum(axis=0)
    energy = sum(world.solvers[name].diagnostics()["kinetic_energy"] for name in ("cloth", "rigid"))
    return of_nodes.sum(axis=0) + of_bodies.sum(axis=0), angular + bodies.angular_momentum().sum(axis=0), energy


def energy_of(world):
    """Kinetic and potential energy of all, without that of springs."""
    numbers = world.diagnostics()
    return sum(numbers[name][f"{kind}_energy"] for name in ("cloth", "rigid") for kind in ("kinetic", "potential"))


def test_a_chain_pulls_at_cloth_as_its_weight_at_a_node_would():
    """Ten links of 0.2 kg, held at one point, fall into the sheet as 2 kg at that node do, and are thrown up alike."""
    world = hanging()
    node = node_at(world, (0.0, 0.0, TOP))
    eyelet = float(cloth_of(world).state.eyelets[node])
    assert 0.0 < eyelet < 2.0e-3 * 2.0
    lumped = world_of([], [], sheet(pin=CORNERS))
    cloth_of(lumped).put_eyelets(np.array([node]), np.array([2.0 + eyelet]))
    found, exact = heights(world, node, 24), heights(lumped, node, 24)
    sag = TOP - exact.min()
    assert 0.1 < sag < 0.3
    assert np.abs(found - exact).max() < 0.01 * sag
    numbers = rigid_of(world).diagnostics()
    assert numbers["joint_gap"] < 1e-9
    assert numbers["joints_apart"] == 0.0
    assert np.linalg.norm(cloth_of(world).state.positions()[node] - rigid_of(world).joints.points.position[0]) < 1e-4


def test_heavy_links_on_light_cloth_gain_no_energy():
    """Hung at two corners: 2 kg of chain on 18 g of cloth, which throws it up again.

    Within 3.5 % of what the sheet stores, 1 to 3 % as the end swings: it alone, with that mass at a node, is as far off
    at 60 substeps a frame.
    """
    banner = sheet(rotation_deg=(90.0, 0.0, 0.0), pin=CORNERS[2:])
    world = hanging(at=(0.0, 0.0, TOP - 0.15), cloth=banner)
    rigid_of(world).bodies.velocity[-1] = (0.5, 0.5, 0.0)  # the end swings
    start, energies = energy_of(world), []
    for _ in range(30):
        world.advance_frame()
        energies.append(energy_of(world))
    assert start - min(energies) > 2.0
    assert max(energies) < start + 0.035 * (start - min(energies))
    assert rigid_of(world).diagnostics()["joint_gap"] < 1e-9
    assert cloth_of(world).diagnostics()["max_strain"] < 0.5


@pytest.mark.parametrize(("kind", "links", "mass"), [("ball", 3, 0.2), *((kind, 1, 0.2) for kind in LINES)])
def test_cloth_and_bodies_keep_their_momentum(kind, links, mass):
    world = hanging(links, mass, kind, cloth=sheet(), gravity=(0.0, 0.0, 0.0))
    bodies = rigid_of(world).bodies
    bodies.velocity[:] = (0.5, 0.3, -1.5)
    linear, angular, energy = totals(world)
    scale = float(np.linalg.norm(bodies.mass.sum() * bodies.velocity[0]))
    for _ in range(15):
        world.advance_frame()
        linear_now, angular_now, energy_now = totals(world)
        assert np.abs(linear_now - linear).max() < 1e-4 * scale
        # About the origin, as far off as TOP; cloth alone, with that mass at a node, is as far off.
        assert np.abs(angular_now - angular).max() < 5e-4 * scale * TOP
        assert energy_now < energy * (1.0 + 1e-4)
    assert cloth_of(world).diagnostics()["kinetic_energy"] > 0.005 * energy  # it was taken along


@pytest.mark.parametrize("kind", ["ball", "spring"])
def test_what_is_lighter_than_the_eyelet_is_stable(kind):
    """A link of half a gram, thrown up against the sheet's pull."""
    world = hanging(1, 5e-4, kind)
    rigid_of(world).bodies.velocity[:] = (0.5, 0.0, -1.0)
    start, weight = energy_of(world), energy_of(world) / TOP
    for _ in range(20):
        world.advance_frame()
        assert energy_of(world) < start + 1e-3 * weight
    assert rigid_of(world).diagnostics()["joint_gap"] < 1e-9


def test_a_pin_leads_what_is_joined_to_it_and_lets_it_go():
    path = [{"time_s": 0.0}, {"time_s": 0.2, "offset": (0.0, 0.0, 0.2)}]
    lead = {"corner": "x-y-", "keyframe": path, "release_s": 0.25}
    at = (-0.15, -0.15, TOP)
    world = hanging(2, 0.2, at=at, cloth=sheet(pin=(lead, *CORNERS[1:])))
    node = node_at(world, at)
    for _ in range(12):
        world.advance_frame()
        anchor = rigid_of(world).joints.points.position[0]
        np.testing.assert_allclose(anchor, cloth_of(world).state.positions()[node], atol=1e-9)
        assert rigid_of(world).diagnostics()["joint_gap"] < 1e-9
    assert cloth_of(world).state.positions()[node, 2] == pytest.approx(TOP + 0.2, abs=1e-6)
    for _ in range(8):
        world.advance_frame()
    assert cloth_of(world).state.positions()[node, 2] < TOP + 0.15  # the chain pulls it down
    assert rigid_of(world).diagnostics()["joint_gap"] < 1e-9


def test_a_joint_breaks_and_both_sides_are_free():
    """Two kilograms that fall into the sheet pull more than their weight."""
    world = hanging(breaks_at=20.0)
    for _ in range(40):
        world.advance_frame()
        if rigid_of(world).joints.is_broken[-1]:
            break
    assert rigid_of(world).joints.is_broken[-1]
    assert not rigid_of(world).joints.is_broken[:-1].any()
    speed = rigid_of(world).bodies.velocity[:, 2].mean()
    upward = 0.0
    for _ in range(6):
        world.advance_frame()
        upward = max(upward, float(cloth_of(world).state.velocity.to_numpy()[:, 2].max()))
    assert rigid_of(world).bodies.velocity[:, 2].mean() == pytest.approx(speed - GRAVITY * 0.1, abs=0.02)
    assert upward > 0.5  # it springs back


def test_a_body_that_is_joined_to_cloth_goes_through_it_until_the_joint_breaks():
    bodies, _ = chain(1, 0.2)
    through = {**bodies[0], "position": (0.0, 0.0, TOP), "shape": {**bodies[0]["shape"], "radius": 0.02}}
    with pytest.raises(ValueError, match='starts inside "link0"'):
        world_of([through], [], sheet(pin=CORNERS))
    with pytest.raises(ValueError, match='starts inside "link0"'):
        world_of([through], [hook(contacts=True)], sheet(pin=CORNERS))
    world = world_of([through], [hook()], sheet(pin=CORNERS), gravity=(0.0, 0.0, 0.0))
    world.advance_frame()
    assert np.abs(rigid_of(world).bodies.velocity).max() < 1e-6
    rigid_of(world).joints.is_broken[:] = True
    world.advance_frame()
    world.advance_frame()
    positions = cloth_of(world).state.positions()
    assert np.abs(positions - cloth_of(world).state.host.position).max() > 1e-3  # it is pushed out


def test_a_run_goes_on_bit_for_bit():
    def make():
        lead = {"corner": "x-y-", "release_s": 0.06}
        world = hanging(2, 0.2, cloth=sheet(pin=(lead, *CORNERS[1:])))
        rigid_of(world).bodies.velocity[:] = (0.3, 0.0, 0.0)
        return world

    world, again = make(), make()
    for _ in range(6):
        world.advance_frame()
    kept = world.checkpoint()
    again.restore(6, kept)
    for each in (world, again):
        for _ in range(6):
            each.advance_frame()
    assert digest_of(world.checkpoint()) == digest_of(again.checkpoint())


def swinging() -> tuple[str, float]:
    world = hanging(3, 0.2, "rope")
    rigid_of(world).bodies.velocity[:] = (0.3, 0.2, 0.0)
    for _ in range(6):
        world.advance_frame()
    return digest_of(world.checkpoint()), float(np.abs(rigid_of(world).bodies.velocity).max())


def test_the_same_bits_on_any_number_of_threads():
    _, speed = result_on_any_threads(swinging)
    assert speed > 0.1


def test_a_joint_off_its_cloth_is_refused():
    message = r'joint "hook": anchor is 0\.1 m off the cloth "sheet".*nearest one, at \[0, 0, 2\]'
    with pytest.raises(ValueError, match=message):
        hanging(1, 0.2, at=(0.0, 0.0, TOP + 0.1))
