"""What air does to cloth, and what it takes from the air: drag on every triangle."""

from collections.abc import Sequence

import numpy as np
import taichi as ti

from sim.cloth.bundles import Air, Nodes
from sim.cloth.parameters import ClothParameters, conflict_in_one_air
from sim.cloth.sheet import triangle_areas
from sim.cloth.state import ClothState
from sim.core.arrays import Floats, Integers, Vectors, on_device
from sim.core.bundles import with_room
from sim.core.launch import kernel
from sim.core.parameters import KeyRefusedError, Vector3
from sim.forces.field import ForcesOn, ForceTable, air_at, change_of_velocity

WIND = -1  # source of air that is nothing but the wind of a cloth's parameters


class ClothAir:
    """The air at every triangle, and its force.

    Air is the wind of the parameters, which nothing slows, unless a coupling puts air of its own there: that has a mass
    per area of cloth, feels the opposite impulse, and is never pushed beyond the cloth's velocity.

    Attributes:
        velocity, inverse_mass, force, impulse, share, triangle_start, triangle_list: see `bundles.Air`.
        source: number of what the air belongs to, (k,) int32; `WIND` for wind.
        density: of the air [kg/m³], (k,); 0 where it drags nothing.
        wind: of the parameters [m/s], (k,) vec3.
        acts: whether any cloth has air that drags.
        is_shared: whether a coupling puts air there, of which there is one for all cloths.
    """

    def __init__(self, state: ClothState) -> None:
        """Allocate it; `take_parameters` sets drag and wind.

        The share is the node's area over that of its triangles, so that a flat sheet is pushed alike everywhere: 1/3 in
        meshes; 1/2 or 1/4 in rectangles, whose nodes have four triangles or eight. A triangle's shares sum to 1.
        """
        host, count = state.host, state.triangle_count
        self._state = state
        self.source, self.density = on_device(np.full(count, WIND)), ti.ndarray(ti.f32, count)
        self.wind = ti.Vector.ndarray(3, ti.f32, count)
        self.acts = self.is_shared = False
        triangles = host.triangles
        order = np.argsort(triangles.ravel(), kind="stable")
        start = np.searchsorted(triangles.ravel()[order], np.arange(state.vertex_count + 1))
        around = np.bincount(triangles.ravel(), weights=np.repeat(triangle_areas(host.position, triangles), 3))
        of_nodes = [on_device(each) for each in (host.node_area / around, start, order // 3)]
        self.share, self.triangle_start, self.triangle_list = of_nodes
        of_nodes.append(state.triangles)
        self._on_device: Air = with_room(Air, count, **dict(zip(Air._fields[-4:], of_nodes, strict=True)))
        self.velocity, self.inverse_mass, self._drag, self.force, self.impulse, *_ = self._on_device

    def take_parameters(self, cloths: Sequence[ClothParameters]) -> None:
        """Drag and wind as the parameters have them now; air that a coupling put there stays.

        Raises:
            ValueError: air of a coupling would have two densities.
        """
        if self.is_shared and (conflict := conflict_in_one_air(cloths)):
            raise KeyRefusedError(*conflict)
        host = self._state.host
        drag = [
            (0.5 * cloth.air_density * cloth.drag, 0.5 * cloth.air_density * cloth.skin_drag, cloth.mass_per_area)
            for cloth in cloths
        ]
        of_triangles = host.of_triangles(drag)
        of_triangles[:, 2] *= triangle_areas(host.position, host.triangles)
        self._drag.from_numpy(of_triangles.astype(np.float32))
        density = [cloth.air_density if cloth.drag + cloth.skin_drag > 0.0 else 0.0 for cloth in cloths]
        self.density.from_numpy(host.of_triangles(density).astype(np.float32))
        wind_of = host.of_triangles([cloth.wind for cloth in cloths]).astype(np.float32)
        self.wind.from_numpy(wind_of)
        is_wind = self.source.to_numpy() == WIND
        self.velocity.from_numpy(np.where(is_wind[:, None], wind_of, self.velocity.to_numpy()))
        self.acts = any(density)

    def blow(self, forces: ForcesOn) -> None:
        """Let winds move the air that no coupling puts there, on top of the wind of the parameters."""
        state = self._state
        blow_at_triangles(self._on_device, self.wind, self.source, state.position, state.body, forces.now)

    def predict(self, gravity: Vector3, dt: float) -> None:
        """Accelerate the nodes by gravity and the air in a step of dt [s], note where that leads, and the impulse."""
        state = self._state
        count = state.triangle_count if self.acts else 0
        predict_in_air(self._on_device, count, state.position, state.nodes, gravity, dt)


@ti.func
def slowed(speed: ti.f32, rate: ti.f32, dt: ti.f32) -> ti.f32:
    """s after dt of ds/dt = -rate s² from `speed`, by implicit Euler: never beyond rest, however light the cloth."""
    return 2.0 * speed / (1.0 + ti.sqrt(1.0 + 4.0 * dt * rate * speed))


@ti.func
def drag_along(
    speed: ti.f32,
    left: ti.math.vec3,
    direction: ti.math.vec3,
    drag: ti.f32,
    mobility: ti.f32,
    air_mobility: ti.f32,
    dt: ti.f32,
) -> ti.f32:
    """Force per area along a direction, in which the air passes at `speed`, and has `left` left after what it gave.

    Quadratic in the passing speed at the end of the step, and at most what brings the air that is left and the cloth
    to the same velocity.
    """
    end = slowed(speed, drag * mobility, dt)
    force = drag * end * end
    if air_mobility > 0.0:
        force = ti.min(force, ti.max(left.dot(direction), 0.0) / (dt * (mobility + air_mobility)))
    return force


@kernel
def blow_at_triangles(air: Air, wind: Vectors, source: Integers, position: Vectors, body: Integers, forces: ForceTable):
    """Air of triangles that no coupling gives theirs: the wind of their cloth, and the winds at their centres."""
    for t in range(source.shape[0]):
        if source[t] == WIND:
            a, b, c = air.triangles[t][0], air.triangles[t][1], air.triangles[t][2]
            centre = (position[a] + position[b] + position[c]) / 3.0
            air.velocity[t] = wind[t] + air_at(forces, body[a], centre).xyz


@kernel
def push_nodes(nodes: Nodes, position: Vectors, body: Integers, carried: Floats, forces: ForceTable, dt: ti.f32):
    """Change velocities of nodes that nothing holds by forces from outside, which what they carry has felt already."""
    for i in range(position.shape[0]):
        if nodes.inverse_mass[i] > 0.0:
            v_i = nodes.velocity[i]
            own = 1.0 - carried[i] * nodes.inverse_mass[i]  # share in the mass of both
            nodes.velocity[i] = v_i + own * change_of_velocity(forces, body[i], position[i], v_i, dt)


@kernel
def predict_in_air(
    air: Air, triangle_count: ti.i32, position: Vectors, nodes: Nodes, gravity: ti.math.vec3, dt: ti.f32
):
    """Accelerate nodes by gravity and by their share of the force on each of their triangles; where that leads in dt.

    Of no triangles, if the air does not act, there is no force.

    The force of the air on each triangle [N] is normal and tangential, quadratic in the speed of the air past it:

        F = rho A / 2 (C_n |v_n| v_n + C_t |v_t| v_t),   v_n + v_t = air - cloth

    with the cloth's velocity at the end of the step, as far as gravity and the air change it: stable for light cloth in
    strong wind, and exact at terminal speed. A triangle yields by the share of its nodes that are not pinned.

    The air's velocity is what a coupling last found. What the cloth took from it since bounds the force, so that air
    within reach is not pushed beyond the cloth's velocity, and both together do not gain energy.
    """
    count = position.shape[0]
    for t in range(triangle_count):
        a, b, c = air.triangles[t][0], air.triangles[t][1], air.triangles[t][2]
        x_a = position[a]
        cross = (position[b] - x_a).cross(position[c] - x_a)
        squared = cross.dot(cross)
        force = ti.math.vec3(0.0)
        if squared > 0.0:
            inverse = ti.rsqrt(squared)
            area = 0.5 * squared * inverse
            normal = inverse * cross
            mean = air.share[a] * nodes.velocity[a] + air.share[b] * nodes.velocity[b]
            mean += air.share[c] * nodes.velocity[c]
            free = 0.0
            for k in ti.static(range(3)):
                i = air.triangles[t][k]
                free += ti.select(nodes.inverse_mass[i] > 0.0, air.share[i], 0.0)
            mobility = free * area / air.drag[t][2]
            air_mobility = air.inverse_mass[t]
            past = air.velocity[t] - mean - dt * free * gravity
            left = past - air_mobility / area * air.impulse[t]
            s_n = past.dot(normal)
            along = past - s_n * normal
            s_t = along.norm()
            normal *= ti.math.sign(s_n)
            force = drag_along(ti.abs(s_n), left, normal, air.drag[t][0], mobility, air_mobility, dt) * normal
            if s_t > 0.0:
                # With that speed, not that of the air in this direction: of air that blows straight onto the triangle,
                # rounding leaves a trace along the normal, where the air passes much faster.
                along /= s_t
                force += drag_along(s_t, left, along, air.drag[t][1], mobility, air_mobility, dt) * along
            force *= area
            air.impulse[t] = air.impulse[t] + dt * force  # += is an atomic operation
        air.force[t] = force
    for i in range(count):
        w_i = nodes.inverse_mass[i]
        if w_i > 0.0:
            v_i = nodes.velocity[i] + dt * gravity
            if triangle_count > 0:
                force = ti.math.vec3(0.0)
                for k in range(air.triangle_start[i], air.triangle_start[i + 1]):
                    force += air.force[air.triangle_list[k]]
                v_i += dt * w_i * air.share[i] * force
            nodes.velocity[i] = v_i
            nodes.displacement[i] = nodes.carry[i] + dt * v_i
        else:
            nodes.displacement[i] = nodes.carry[i]
