"""Bodies that files animate, as fluids, cloth, smoke and other bodies meet them."""

import numpy as np
import pytest
from animated_files import BOX_FACES, ball, box, write_usd
from coupled_tanks import EARTH, SPACING, Tank

from sim.build import build_world
from sim.core.domain import DomainParameters
from sim.core.motion import rotation
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.solver import RigidSolver
from sim.scene import SceneParameters
from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid

pytestmark = pytest.mark.usefixtures("taichi_cpu")

FILE_FPS = 24.0
OPEN_FACES = ("x-", "x+", "y-", "y+", "z-", "z+")
PADDLE = (0.04, 0.16, 0.12)
KEYS = [
    {"time_s": k / FILE_FPS, "position": (0.06 + 0.012 * k, 0.12, 0.08), "rotation_deg": (0.0, 0.0, 2.5 * k)}
    for k in range(9)
]


def moved_by_keys(points: np.ndarray) -> np.ndarray:
    """Points in each of the keyframes, (9, n, 3)."""
    turns = [rotation.from_degrees(key["rotation_deg"]) for key in KEYS]
    return np.stack([rotation.rotated(turn, points) + key["position"] for turn, key in zip(turns, KEYS, strict=True)])


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A paddle that moves as `KEYS` say; a ball that grows from 0.06 to 0.09 m in half a second; a slab whose top and
    bottom move apart along x at 0.2 m/s."""
    folder = tmp_path_factory.mktemp("animations")
    vertices, faces = ball(0.06)
    grows = np.linspace(1.0, 1.5, 13)[:, None, None] * vertices
    slab = box((0.8, 0.5, 0.1))
    sheared = np.stack([slab + 0.1 * k / FILE_FPS * np.sign(slab[:, 2:]) * [1.0, 0.0, 0.0] for k in range(13)])
    return {
        "paddle": write_usd(folder / "paddle.usdc", moved_by_keys(box(PADDLE)), BOX_FACES),
        "ball": write_usd(folder / "ball.usdc", grows, faces),
        "slab": write_usd(folder / "slab.usdc", sheared, BOX_FACES),
    }


def animated(file: str, **more: object) -> dict:
    return {
        "kind": "kinematic",
        "shape": {"type": "animation", "file": file, "interpolation": "linear"},
        **more,
    }


def growth_of(radius: float) -> float:
    """How much more than at the start the ball fills [m³]; its mesh has 99 % of the volume of a ball."""
    vertices, faces = ball(1.0)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0) * (radius**3 - 0.06**3)


def smooth(body: dict) -> dict:
    return {**body, "shape": {**body["shape"], "interpolation": "cubic"}}


def keyframed_paddle() -> dict:
    return {"kind": "kinematic", "shape": {"type": "box", "size": PADDLE}, "keyframe": KEYS}


def test_a_rigid_animation_pushes_a_body_as_keyframes_do(files):
    cube = {"name": "cube", "kind": "dynamic", "density": 500.0, "shape": {"type": "box", "size": (0.06, 0.06, 0.06)}}
    ends = []
    for paddle in (keyframed_paddle(), smooth(animated(files["paddle"]))):
        bodies = [
            RigidBodyParameters.model_validate({**cube, "position": (0.12, 0.14, 0.0301)}),
            RigidBodyParameters.model_validate({"name": "paddle", **paddle}),
        ]
        solver = RigidSolver(bodies, domain=DomainParameters(), gravity=EARTH)
        for _ in range(200):
            solver.substep(2.0e-3)
        ends.append((solver.bodies.position[0].copy(), solver.bodies.orientation[0].copy()))
    assert ends[0][0][0] > 0.15  # it was pushed
    # The mesh is as large as the box to float32, and contacts amplify that little.
    np.testing.assert_allclose(ends[1][0], ends[0][0], atol=1e-4)
    np.testing.assert_allclose(ends[1][1], ends[0][1], atol=1e-3)


def test_a_rigid_animation_moves_water_as_keyframes_do(tmp_path):
    import trimesh

    still = {"type": "mesh", "file": str(tmp_path / "paddle.ply")}
    trimesh.Trimesh(box(PADDLE), BOX_FACES, process=False).export(still["file"])
    mesh = {"kind": "kinematic", "shape": still, "keyframe": KEYS}
    # Of the same triangles in the same order, so that their samples are in the same places.
    same = build_solid(Placement.model_validate({"shape": still})).rest_mesh()
    file = write_usd(tmp_path / "paddle.usdc", moved_by_keys(same.vertices), same.faces)
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(0.24, 0.24, 0.3))
    ends = []
    for paddle in (mesh, smooth(animated(file))):
        tank = Tank([paddle], domain=domain, water=((0.0, 0.0, 0.0), (0.24, 0.24, 0.12)))
        tank.run(0.2)
        arrays = tank.fluid.snapshots()["water"].arrays
        ends.append((arrays["position"].mean(axis=0), arrays["velocity"].mean(axis=0)))
    assert ends[0][1][0] > 0.005  # it was pushed
    # Samples differ by rounding, which a splash makes larger.
    np.testing.assert_allclose(ends[1][0], ends[0][0], atol=1e-3 * SPACING)
    np.testing.assert_allclose(ends[1][1], ends[0][1], atol=1e-3)


def test_a_ball_that_is_touched_takes_the_speed_of_the_surface(files):
    bodies = [
        {"name": "pea", "kind": "dynamic", "density": 500.0, "shape": {"type": "sphere", "radius": 0.02}},
        {"name": "lung", **animated(files["ball"])},
    ]
    bodies[0]["position"] = (0.06, 0.072, 0.0)  # 0.0937 m away, met when the ball has 0.0737 m
    domain = DomainParameters(min=(-1, -1, -1), max=(1, 1, 1), open_faces=OPEN_FACES)
    solver = RigidSolver(
        [RigidBodyParameters.model_validate(body) for body in bodies], domain=domain, gravity=(0.0, 0.0, 0.0)
    )
    away = np.hypot(0.06, 0.072)
    for _ in range(225):
        solver.substep(2.0e-3)
        reached = 0.06 * (1.0 + solver.time_s)
        # Contacts of grids are off by a hundredth of a cell's square over the radius, facets by half a percent of it.
        assert np.linalg.norm(solver.bodies.position[0]) > reached + 0.02 - 7.0e-4
    outwards = np.array([0.06, 0.072, 0.0]) / away
    assert solver.bodies.velocity[0] @ outwards == pytest.approx(0.06, rel=0.015)
    # Facets are up to 5 degrees out of the ball's normal.
    np.testing.assert_allclose(solver.bodies.velocity[0], 0.06 * outwards, atol=5e-3)


def test_water_rises_by_what_a_body_gains(files):
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(0.3, 0.3, 0.4))
    area, place = 0.3 * 0.3, (0.15, 0.15, 0.12)
    lung = animated(files["ball"], position=place)
    tank = Tank(
        [{**lung, "shape": {**lung["shape"], "start_s": 0.4}}],
        domain=domain,
        water=((0.0, 0.0, 0.0), (0.3, 0.3, 0.24)),
        solver="dfsph",
        particle_radius=0.0075,
    )

    def level(radius: float) -> float:
        """From the height of the water's centre, as if its surface were flat [m]."""
        held = 4.0 / 3.0 * np.pi * radius**3
        middle = float(tank.fluid.snapshots()["water"].arrays["position"][:, 2].astype(np.float64).mean())
        a, b, c = 0.5 * area, -middle * area, held * (middle - place[2])
        return float((-b + np.sqrt(b * b - 4.0 * a * c)) / (2.0 * a))

    tank.run(0.4)  # the lattice, which has gaps around the ball, comes to rest
    before = level(0.06)
    volumes = tank.fluid.tank.boundary.checkpoint()["body_volumes"].sum()
    tank.run(1.1)  # half a second of growth, and the waves calm down
    # Waves are 1 mm high by then.
    assert level(0.09) - before == pytest.approx(growth_of(0.09) / area, rel=0.04)
    # Samples are farther apart then, and stand for as much more: their layer grows with the surface.
    assert tank.fluid.tank.boundary.checkpoint()["body_volumes"].sum() > 1.9 * volumes


def test_smoke_is_pushed_out_by_what_a_body_gains(files):
    scene = {
        "domain": {"min": (0.0, 0.0, 0.0), "max": (0.6, 0.3, 0.3)},
        "gravity": (0.0, 0.0, 0.0),
        "rigid": [{"name": "lung", **animated(files["ball"], position=(0.25, 0.15, 0.15))}],
        "smoke": [
            {
                "name": "air",
                "cell_size": 0.6 / 64,
                "open_faces": ("x+",),
                "source": [{"shape": {"type": "sphere", "radius": 0.04}, "position": (0.5, 0.15, 0.15)}],
            }
        ],
    }
    world = build_world(SceneParameters.model_validate(scene), frames_per_second=60.0)
    smoke = world.solvers["air"]
    out = 0.0
    for _ in range(24):
        world.advance_frame()
        flux = smoke.grid.trim(smoke.checkpoint()["u_face_x"], smoke.grid.face_shape(0))[-1].sum()
        out += float(flux) * smoke.grid.cell_size**2 / 60.0
    # The part that a ball leaves open of cells is known to second order of their size: 4 % are lost with half as many.
    assert out == pytest.approx(growth_of(0.06 * (1.0 + 24 / 60.0)), rel=0.02)


def cloth_scene(body: dict, sheet: dict) -> SceneParameters:
    return SceneParameters.model_validate(
        {
            "domain": {"min": (-1, -1, -1), "max": (1, 1, 1), "open_faces": OPEN_FACES},
            "rigid": [{"name": "thing", **body}],
            "cloth": [{"name": "sheet", "air_density": 0.0, **sheet}],
        }
    )


def test_cloth_is_dragged_by_a_surface_that_slides_under_it(files):
    sheet = {
        "shape": {"type": "rectangle", "size": (0.1, 0.1), "counts": (6, 6)},
        "thickness": 2.0e-3,
        "friction": 0.5,
        "position": (0.0, 0.0, 0.052),
    }
    world = build_world(cloth_scene(animated(files["slab"]), sheet), frames_per_second=60.0)
    for _ in range(24):
        world.advance_frame()
    velocity = world.solvers["cloth"].snapshots()["sheet"].arrays["velocity"]
    # sqrt(0.5 * 0.5) g takes 0.02 s to give it the speed of the top.
    np.testing.assert_allclose(velocity, np.tile([0.1, 0.0, 0.0], (36, 1)), atol=2e-3)


def test_cloth_is_lifted_by_a_body_that_grows(files):
    sheet = {
        "shape": {"type": "rectangle", "size": (0.24, 0.24), "counts": (17, 17)},
        "thickness": 3.0e-3,
        "position": (0.0, 0.0, 0.065),
        "pin": [{"corner": corner} for corner in ("x-y-", "x-y+", "x+y-", "x+y+")],
    }
    world = build_world(cloth_scene(animated(files["ball"]), sheet), frames_per_second=60.0)
    for frame in range(1, 31):
        world.advance_frame()
        position = world.solvers["cloth"].snapshots()["sheet"].arrays["position"]
        radius = 0.06 * (1.0 + min(frame / 60.0, 0.5))
        # Facets are 0.6 % of the radius below the ball; the cloth keeps half its thickness.
        assert np.linalg.norm(position, axis=1).min() > 0.993 * radius + 0.5e-3
    assert position[:, 2].max() > 0.09


def everything(files: dict[str, str]) -> SceneParameters:
    return SceneParameters.model_validate(
        {
            "domain": {"min": (-0.15, -0.15, 0.0), "max": (0.15, 0.15, 0.4)},
            "rigid": [
                {"name": "lung", **smooth(animated(files["ball"], position=(0.0, 0.0, 0.12)))},
                {
                    "name": "cube",
                    "kind": "dynamic",
                    "density": 400.0,
                    "shape": {"type": "box", "size": (0.05, 0.05, 0.05)},
                    "position": (0.01, 0.0, 0.21),
                },
            ],
            "fluid": [
                {
                    "name": "water",
                    "particle_radius": 0.012,
                    "block": [{"shape": {"type": "box", "size": (0.3, 0.3, 0.12)}, "position": (0.0, 0.0, 0.06)}],
                }
            ],
            "cloth": [
                {
                    "name": "sheet",
                    "shape": {"type": "rectangle", "size": (0.16, 0.16), "counts": (9, 9)},
                    "position": (0.0, 0.0, 0.26),
                }
            ],
            "smoke": [
                {
                    "name": "air",
                    "cell_size": 0.025,
                    "open_faces": ("z+",),
                    "source": [{"shape": {"type": "sphere", "radius": 0.04}, "position": (0.1, 0.0, 0.3)}],
                }
            ],
        }
    )


@pytest.mark.slow
def test_all_continue_from_a_checkpoint_to_the_bit(files):
    world = build_world(everything(files), frames_per_second=60.0)
    for _ in range(5):
        world.advance_frame()
    kept = world.checkpoint()
    for _ in range(3):
        world.advance_frame()
    again = build_world(everything(files), frames_per_second=60.0)
    again.restore(5, kept)
    for _ in range(3):
        again.advance_frame()
    expected, found = world.checkpoint(), again.checkpoint()
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)
