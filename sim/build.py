"""From a scene's parameters to a world of solvers, and to the particles they start with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from sim.cloth.solver import SOLVER_NAME as CLOTH_NAME
from sim.cloth.solver import ClothSolver
from sim.core.solver import Coupling, Solver
from sim.core.world import World
from sim.coupling.body_speed import expected_body_speed, expected_cloth_speed, expected_soft_speed
from sim.coupling.cloth_fluid import ClothFluidCoupling, ClothSamples
from sim.coupling.cloth_joints import ClothJointsCoupling, passing_of, points_of_joints
from sim.coupling.cloth_rigid import ClothRigidCoupling, contacts_of_cloths
from sim.coupling.emitter_bodies import with_emitters_on
from sim.coupling.fluid_rigid import FluidRigidCoupling, samples_of_moving_bodies
from sim.coupling.smoke_cloth import SmokeClothCoupling
from sim.coupling.smoke_embers import AirOfSmoke
from sim.coupling.smoke_fluid import SmokeFluidCoupling
from sim.coupling.smoke_reach import too_thin_bodies
from sim.coupling.smoke_rigid import SmokeRigidCoupling
from sim.coupling.smoke_sources import SmokeSourcesOnBodies, with_sources_on
from sim.coupling.soft_cloth import SoftClothCoupling
from sim.coupling.soft_emitters import poured_by
from sim.coupling.soft_fluid import SoftFluidCoupling, samples_of_soft
from sim.coupling.soft_rigid import SoftRigidCoupling, contacts_of_soft
from sim.embers.solver import EmberSolver
from sim.fluid.boundary_akinci2012 import BoundarySamples, domain_wall_samples, sink_samples
from sim.fluid.emitter import Carrier
from sim.fluid.filling import fill_fluids, particle_capacity
from sim.fluid.kernels import Discretization
from sim.fluid.opening import Opening, openings_of
from sim.fluid.opening_conflicts import opening_problem
from sim.fluid.parameters import shared_conflicts
from sim.fluid.solvers import SOLVERS
from sim.fluid.tank import FluidStart
from sim.forces.field import ForceField
from sim.rigid.joint_parameters import joint_problems
from sim.rigid.solver import SOLVER_NAME as RIGID_NAME
from sim.rigid.solver import RigidSolver
from sim.rigid.start import check_start
from sim.rigid.states import StaticBody
from sim.shapes.placement import SharedShapes, build_solid
from sim.smoke.guide import Guide
from sim.smoke.parameters import SmokeParameters, boxes_overlap
from sim.smoke.solver import SmokeSolver
from sim.soft.parameters import coarse_for_fluid
from sim.soft.solver import SOLVER_NAME as SOFT_NAME
from sim.soft.solver import SoftSolver

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sim.core.domain import DomainParameters
    from sim.fluid.fluid import SPHFluid
    from sim.fluid.parameters import FluidParameters
    from sim.rigid.joint_points import JointPoints
    from sim.rigid.parameters import RigidBodyParameters
    from sim.scene import SceneParameters
    from sim.shapes.solid import Solid


def build_world(scene: SceneParameters, *, frames_per_second: float, solvers: Sequence[Solver] = ()) -> World:
    """The solvers of a scene in their initial state, coupled; `sim.core.runtime.initialize` must have run.

    Further solvers may share the world, and meet nobody.

    Raises:
        ShapeError: a shape cannot be built.
        ValueError: a body cannot start as described.
    """
    _refuse_names(scene)
    forces = ForceField(scene.force) if scene.force else None
    shapes = SharedShapes()
    static = [StaticBody(parameters, shapes) for parameters in scene.rigid if parameters.kind == "static"]
    _refuse_joints(scene)
    cloths = []
    if scene.cloth:  # one solver for all, as they collide with each other
        solver = ClothSolver(
            scene.cloth,
            domain=scene.domain,
            gravity=scene.gravity,
            frames_per_second=frames_per_second,
            forces=forces,
        )
        cloths = [solver]
    sewn = any(cloth.name in joint.between for joint in scene.joint for cloth in scene.cloth)
    nodes, points = points_of_joints(scene.joint, cloths[0], frames_per_second) if sewn else (None, None)
    rigid = _build_rigid(scene, points, forces)
    softs = [_build_soft(scene, static, forces)] if scene.soft else []
    samples = None
    if cloths and scene.fluid:
        samples = ClothSamples.of(cloths[0], scene.fluid[0].spacing, scene.fluid[0].support_in_spacings)
    around = static, rigid, samples, next(iter(softs), None)
    fluids = [_build_fluids(scene, *around, forces)] if scene.fluid else []
    smokes = [_build_smoke(smoke, scene, static, forces, frames_per_second) for smoke in scene.smoke]
    coupled: list[Solver] = [*fluids, *softs, *cloths, *([] if rigid is None else [rigid]), *smokes]
    couplings: list[Coupling] = [] if rigid is None else [FluidRigidCoupling(fluid, rigid) for fluid in fluids]
    for cloth in cloths:
        names = [body.name for kind in (True, False) for body in scene.rigid if (body.kind != "static") == kind]
        passing = passing_of(scene.joint, scene.cloth, names)
        contacts = contacts_of_cloths(cloth, scene.rigid, domain=scene.domain, rigid=rigid, passing=passing.any(axis=0))
        cloth.contacts = contacts
        couplings += [] if rigid is None else [ClothRigidCoupling(cloth, rigid, contacts)]
        if rigid is not None and nodes is not None:
            couplings.append(ClothJointsCoupling(cloth, rigid, nodes, passing))
        couplings += [] if samples is None else [ClothFluidCoupling(fluid, cloth, samples) for fluid in fluids]
        couplings += [SoftClothCoupling(soft, cloth) for soft in softs]
    for soft in softs:
        couplings += [SoftFluidCoupling(fluid, soft) for fluid in fluids]
        soft.contacts = contacts_of_soft(soft, scene.rigid, rigid, static, mass=soft.mass + _most_mass(fluids))
        if rigid is not None and soft.contacts is not None:
            couplings.append(SoftRigidCoupling(soft, rigid, soft.contacts))
    airs = {smoke.name: AirOfSmoke(smoke, scene.domain) for smoke in smokes}
    coupled += [
        EmberSolver(each, air=airs[each.smoke], gravity=scene.gravity, frames_per_second=frames_per_second)
        for each in scene.embers
    ]
    couplings += _couple_smokes(smokes, scene, fluids=fluids, cloths=cloths, softs=softs, rigid=rigid)
    standing = {body.name: body.snapshot() for body in static}
    return World(
        [*coupled, *solvers],
        frames_per_second=frames_per_second,
        couplings=couplings,
        standing=standing,
        at_moment=forces and forces.at,
    )


def _refuse_names(scene: SceneParameters) -> None:
    """Refuse fluids, smokes and embers with the name of a solver for many bodies."""
    names = {body.name for body in (*scene.fluid, *scene.smoke, *scene.embers)}
    moves = any(body.kind != "static" for body in scene.rigid)
    for name, there, what in (
        (RIGID_NAME, moves, "moving bodies"),
        (CLOTH_NAME, bool(scene.cloth), "cloths"),
        (SOFT_NAME, bool(scene.soft), "soft bodies"),
    ):
        if name in names and there:
            raise ValueError(
                f'"{name}" is what all {what} are called together; name the fluid, smoke or embers otherwise'
            )


def _build_fluids(
    scene: SceneParameters,
    static: Sequence[StaticBody],
    rigid: RigidSolver | None,
    cloth: ClothSamples | None,
    soft: SoftSolver | None,
    forces: ForceField | None,
) -> SPHFluid:
    """One solver for all fluids, as they share the tank; of what moves it has the samples."""
    if conflicts := shared_conflicts(scene.fluid):
        number, key, message = conflicts[0]
        raise ValueError(f'fluid "{scene.fluid[number].name}": {key} {message}')
    spacing, support = scene.fluid[0].spacing, scene.fluid[0].support_in_spacings
    discretization = Discretization(spacing, support)
    volume = discretization.particle_volume
    movers = [body for body in scene.rigid if body.kind != "static"]
    shapes = SharedShapes()
    solids = [*(body.solid for body in static), *(build_solid(body, shapes) for body in movers)]
    solids += [build_solid(block, shapes) for each in scene.soft for block in each.block]
    fluids = with_emitters_on(scene.fluid, scene.rigid)
    followed = {body.name: body for body in movers}
    _check_openings(fluids, scene, solids, followed, spacing, volume)
    for each in scene.soft:
        if coarse := coarse_for_fluid(each, spacing):
            raise ValueError(f'soft "{each.name}": cell_size {coarse}')
    filling = fill_fluids(fluids, scene.domain, solids, None if cloth is None else (cloth.start, cloth.normals))
    speeds = [] if rigid is None else [expected_body_speed(movers, rigid.solids, scene.domain, scene.gravity)]
    speeds += [] if soft is None else [expected_soft_speed(soft, scene.domain)]
    speeds += [] if cloth is None else [expected_cloth_speed(scene.cloth, cloth.start, scene.domain, scene.gravity)]
    samples = [
        sink_samples(
            _reachable(body.solid.surface_samples(spacing), scene.domain, discretization.support_radius),
            body.solid.signed_distance,
            spacing,
            support,
        )
        for body in static
    ]
    carriers = {}
    if rigid is not None:
        arms = [solid.centre_of_mass for solid in rigid.solids]
        carriers = {name: Carrier(number, arms[number]) for number, name in enumerate(rigid.bodies.names)}
    start = FluidStart(
        fluids,
        domain=scene.domain,
        gravity=scene.gravity,
        positions=filling.positions,
        velocities=filling.velocities,
        phase=filling.phase,
        dye=filling.dye,
        boundary=BoundarySamples.of_bodies(domain_wall_samples(scene.domain, spacing, support), *samples),
        moving=BoundarySamples.of_bodies() if rigid is None else samples_of_moving_bodies(rigid, spacing, support),
        sheets=samples_of_soft(soft) if soft is not None else None if cloth is None else cloth.sheets,
        body_count=len(movers),
        body_speed=max(speeds, default=0.0),
        followed=followed,
        carriers=carriers,
        capacity=particle_capacity(fluids, scene.domain, filling, volume),
        forces=forces,
    )
    return SOLVERS[scene.fluid[0].solver](start)


def _most_mass(fluids: Sequence[SPHFluid]) -> float:
    """Of all the fluid that there can ever be [kg]."""
    return sum(f.particles.capacity * f.particle_volume * float(f.phases.rest_densities.max()) for f in fluids)


def _check_openings(
    fluids: Sequence[FluidParameters],
    scene: SceneParameters,
    solids: list[Solid],
    followed: Mapping[str, RigidBodyParameters],
    spacing: float,
    volume: float,
) -> None:
    """Raise ValueError unless the openings of all fluids are free, and not in each other's way."""
    names = [f'fluid "{fluid.name}" emitter[{number}]' for fluid in fluids for number in range(len(fluid.emitter))]
    openings: dict[str, Opening] = {}
    for name, (_, opening) in zip(names, openings_of(fluids, volume, followed), strict=True):
        if reason := opening_problem(opening, spacing, scene.domain, solids, openings):
            raise ValueError(f"{name}: {reason}")
        openings[name] = opening


def _reachable(samples: NDArray[np.float32], domain: DomainParameters, margin: float) -> NDArray[np.float32]:
    """The samples within a margin [m] of the domain, which its fluid may feel: a body may stand partly outside."""
    inside = (samples >= np.asarray(domain.min) - margin) & (samples <= np.asarray(domain.max) + margin)
    return samples[inside.all(axis=1)]


def _refuse_joints(scene: SceneParameters) -> None:
    """Refuse joints that cannot be."""
    problems = [
        f'joint "{scene.joint[each.number].name}": {each.text}'
        for each in joint_problems(scene.joint, scene.rigid, [cloth.name for cloth in scene.cloth])
    ]
    if problems:
        raise ValueError("; ".join(problems))


def _build_rigid(scene: SceneParameters, points: JointPoints | None, forces: ForceField | None) -> RigidSolver | None:
    """The solver of the bodies that move, if there are any, with points of cloths that joints hold."""
    moving = [body for body in scene.rigid if body.kind != "static"]
    if not moving:
        return None
    obstacles = [body for body in scene.rigid if body.kind == "static"]
    solver = RigidSolver(
        moving,
        obstacles=obstacles,
        joints=scene.joint,
        points=points,
        domain=scene.domain,
        gravity=scene.gravity,
        forces=forces,
    )
    solver.has_own_steps = not (scene.fluid or scene.cloth or scene.soft)
    check_start(solver)
    return solver


def _build_soft(scene: SceneParameters, static: Sequence[StaticBody], forces: ForceField | None) -> SoftSolver:
    """One solver for all soft bodies, clear of rigid ones."""
    shapes = SharedShapes()
    movers = [build_solid(body, shapes) for body in scene.rigid if body.kind != "static"]
    solids = [*(body.solid for body in static), *movers]
    blocks = [build_solid(block, shapes) for each in scene.soft if each.emitter for block in each.block]
    return SoftSolver(
        scene.soft,
        domain=scene.domain,
        gravity=scene.gravity,
        solids=solids,
        poured=poured_by(scene.soft, scene.domain, [*solids, *blocks]),
        forces=forces,
    )


def _build_smoke(
    smoke: SmokeParameters,
    scene: SceneParameters,
    static: Sequence[StaticBody],
    forces: ForceField | None,
    frames_per_second: float,
) -> SmokeSolver:
    """The solver of one smoke, with static bodies in it, room for what will move in it, and its guide."""
    movers = sum(body.kind != "static" for body in scene.rigid)
    return SmokeSolver(
        with_sources_on(smoke, scene.rigid),
        domain=scene.domain,
        gravity=scene.gravity,
        solids=[body.solid for body in static],
        moving=_meets_particles(smoke, scene) or movers > 0,
        free_bodies=movers if any(body.kind == "dynamic" for body in scene.rigid) else 0,
        forces=forces,
        frame_s=1.0 / frames_per_second,
        guide=_build_guide(smoke, scene, frames_per_second) if smoke.upres > 1 else None,
    )


def _build_guide(smoke: SmokeParameters, scene: SceneParameters, frames_per_second: float) -> Guide:
    """The same scene in coarser cells, with this smoke alone and without what the air carries."""
    coarse = scene.model_copy(update={"smoke": (smoke.guide,), "embers": ()})
    try:
        world = build_world(coarse, frames_per_second=frames_per_second)
    except ValueError as error:
        raise ValueError(f"upres: in the guide's cells of {smoke.guide.cell_size:g} m: {error}") from error
    solver = world.solvers[smoke.name]
    assert isinstance(solver, SmokeSolver)
    return Guide(world, solver, refinement=smoke.upres, frame_s=1.0 / frames_per_second)


def _meets_particles(smoke: SmokeParameters, scene: SceneParameters) -> bool:
    """Whether fluid or soft matter, which stay in the domain, could come into the smoke's box."""
    domain = scene.domain
    return bool(scene.fluid or scene.soft) and boxes_overlap(smoke.corners(domain), (domain.min, domain.max))


def _couple_smokes(
    smokes: Sequence[SmokeSolver],
    scene: SceneParameters,
    *,
    fluids: Sequence[SPHFluid],
    cloths: Sequence[ClothSolver],
    softs: Sequence[SoftSolver],
    rigid: RigidSolver | None,
) -> list[Coupling]:
    """Each smoke with what is in its way, which is put there, and with what hangs in it."""
    couplings: list[Coupling] = []
    on_bodies: list[Coupling] = []  # after all that the air of any smoke does to bodies
    moving = [body for body in scene.rigid if body.kind != "static"]
    for number, smoke in enumerate(smokes):
        solids = [] if rigid is None else rigid.solids
        for body, reason in too_thin_bodies(smoke.parameters, moving, solids, scene.domain):
            raise ValueError(f'"{moving[body].name}" {reason}')
        in_the_way: list[Coupling] = []
        if _meets_particles(smoke.parameters, scene):
            in_the_way += [SmokeFluidCoupling(each, smoke, domain=scene.domain) for each in (*fluids, *softs)]
        in_the_way += [] if rigid is None else [SmokeRigidCoupling(rigid, smoke, domain=scene.domain)]
        for coupling in in_the_way:
            coupling.exchange(0.0)
        smoke.move_obstacles()
        if smoke.free_bodies is not None:
            smoke.give_way(smoke.free_bodies)
        follows = any(source.follow is not None for source in smoke.parameters.source)
        on_bodies += [SmokeSourcesOnBodies(rigid, smoke)] if rigid is not None and follows else []
        couplings += [*in_the_way, *(SmokeClothCoupling(cloth, smoke, number=number) for cloth in cloths)]
    return [*couplings, *on_bodies]
