"""A coarser simulation that guides a finer one: motion is kept, detail added."""

import numpy as np
import pytest
from pydantic import ValidationError
from thread_counts import digest_of, result_on_any_threads

from sim.build import build_world
from sim.core.solver import OutgrownError, SimulationDivergedError
from sim.core.world import World
from sim.scene import SceneParameters
from sim.smoke.parameters import SmokeParameters
from sim.smoke.solver import SmokeSolver

pytestmark = pytest.mark.usefixtures("taichi_cpu")

FPS = 24.0
CELL = 1.0 / 32.0
FACES = ("u_face_x", "v_face_y", "w_face_z")
PLUME = {"shape": {"type": "sphere", "radius": 0.12}, "position": (0.0, 0.0, 0.2), "temperature": 450.0}
BURST = {**PLUME, "temperature": 900.0, "fuel": 1.0, "density": 0.3, "end_s": 0.2}
FIRE = {"fire": {"heat": 1200.0}, "source": [BURST], "buoyancy_temperature": 0.01}
PLATE = {"name": "plate", "shape": {"type": "box", "size": (0.3, 0.8, 0.07)}, "position": (0.1, 0.0, 0.7)}
SWEEP = {**PLATE, "kind": "kinematic", "position": (-0.4, 0.0, 0.7), "velocity": (0.6, 0.0, 0.0)}
GUSTS = {"type": "wind", "velocity": (0.8, 0.0, 0.0), "gusts": 0.5, "gust_s": 0.3}
CUBE = {"shape": {"type": "box", "size": (0.2, 0.2, 0.2)}, "position": (0.0, 0.0, 0.1)}
CASES = {
    "a plume": {},
    "cells of a quarter": {"upres": 4},
    "behind a plate": {"rigid": [PLATE]},
    "swept": {"rigid": [SWEEP]},
    "blown, open": {"grid": "open", "force": [GUSTS]},
    "fire in a window": {"grid": "window", **FIRE},
}


def scene(*, upres: int = 2, rigid=(), force=(), **smoke) -> SceneParameters:
    keys = {"name": "smoke", "cell_size": CELL, "upres": upres, "source": [PLUME], **smoke}
    domain = {"min": (-0.5, -0.5, 0.0), "max": (0.5, 0.5, 1.5)}
    return SceneParameters.model_validate({"domain": domain, "smoke": [keys], "rigid": rigid, "force": force})


def alone(guided: SceneParameters) -> SceneParameters:
    return guided.model_copy(update={"smoke": (guided.smoke[0].guide,)})


def world_of(parameters: SceneParameters, frames: int = 0) -> World:
    world = build_world(parameters, frames_per_second=FPS)
    for _ in range(frames):
        world.advance_frame()
    return world


def smoke_of(world: World) -> SmokeSolver:
    solver = world.solvers["smoke"]
    assert isinstance(solver, SmokeSolver)
    return solver


def faces(solver: SmokeSolver) -> list[np.ndarray]:
    arrays = solver.checkpoint()
    grid = solver.grid
    return [grid.trim(arrays[name], grid.face_shape(axis)).astype(np.float64) for axis, name in enumerate(FACES)]


def on_coarse_faces(fine: list[np.ndarray], ratio: int) -> list[np.ndarray]:
    """Means over the fine faces of each coarse one: the flux through it over its area."""
    means = []
    for axis, values in enumerate(fine):
        planes = np.moveaxis(values, axis, 0)[::ratio]
        n, m = planes.shape[1] // ratio, planes.shape[2] // ratio
        means.append(np.moveaxis(planes.reshape(-1, n, ratio, m, ratio).mean(axis=(2, 4)), 0, axis))
    return means


def in_coarse_cells(fine: np.ndarray, ratio: int) -> np.ndarray:
    x, y, z = (n // ratio for n in fine.shape)
    return fine.reshape(x, ratio, y, ratio, z, ratio).mean(axis=(1, 3, 5))


def correlation(one: list[np.ndarray], other: list[np.ndarray]) -> float:
    one, other = ([values - values.mean() for values in each] for each in (one, other))
    both, first, second = (
        sum(np.vdot(a, b) for a, b in zip(p, q, strict=True)) for p, q in ((one, other), (one, one), (other, other))
    )
    return float(both / np.sqrt(first * second))


def enstrophy(velocity: list[np.ndarray]) -> float:
    """Sum of squares of the curl of the velocity at the centres of cells, times the edge of one [m²/s²]."""
    u, v, w = (
        np.moveaxis(0.5 * (planes[1:] + planes[:-1]), 0, axis)
        for axis, planes in enumerate(np.moveaxis(values, axis, 0) for axis, values in enumerate(velocity))
    )
    slopes = [np.gradient(component) for component in (u, v, w)]
    curl = (slopes[2][1] - slopes[1][2], slopes[0][2] - slopes[2][0], slopes[1][0] - slopes[0][1])
    return float(sum((component**2).sum() for component in curl))


def interpolated(coarse: list[np.ndarray], ratio: int) -> list[np.ndarray]:
    """The coarse velocity on the fine faces: linear in every direction."""
    fine = []
    for axis, faces_across in enumerate(coarse):
        values = faces_across
        for along in range(3):
            n = values.shape[along]
            at, places = np.arange(n), (np.arange(n * ratio) + 0.5) / ratio - 0.5
            if along == axis:
                places = np.arange((n - 1) * ratio + 1) / ratio
            below = np.clip(np.floor(places).astype(int), 0, n - 2)
            part = np.clip(places - below, 0.0, 1.0).reshape([-1 if a == along else 1 for a in range(3)])
            values = values.take(at[below], along) * (1.0 - part) + values.take(at[below] + 1, along) * part
        fine.append(values)
    return fine


def test_a_guided_plume_goes_as_its_guide_and_has_smaller_eddies():
    ratio, frames = 2, 24
    guided, coarse, free = (smoke_of(world_of(each, frames)) for each in (scene(), alone(scene()), scene(upres=1)))
    given = faces(coarse)
    told = guided.diagnostics()["guide_correlation"]
    # Behind the front a plume is a matter of chance: one that nothing guides has gone its own way by now.
    assert correlation(on_coarse_faces(faces(guided), ratio), given) == pytest.approx(told, abs=2.0e-3)
    assert told > 0.99
    assert correlation(on_coarse_faces(faces(free), ratio), given) < 0.95
    smoke, known = (each.snapshots()["smoke"].arrays["density"] for each in (guided, coarse))
    assert np.corrcoef(in_coarse_cells(smoke, ratio).ravel(), known.ravel())[0, 1] > 0.95
    assert enstrophy(faces(guided)) > 1.4 * enstrophy(interpolated(given, ratio))


@pytest.mark.parametrize("case", CASES)
def test_a_guide_is_to_the_bit_what_its_smoke_is_in_coarse_cells(case):
    guided = scene(**CASES[case])
    world, coarse = world_of(guided, 12), world_of(alone(guided), 12)
    own, found = coarse.checkpoint(), world.checkpoint()
    for name, values in own.items():
        assert np.array_equal(found[f"smoke/guide/{name}"], values), name
    assert 0.95 < smoke_of(world).diagnostics()["guide_correlation"] < 1.0
    assert smoke_of(world).diagnostics()["not_converged"] == 0.0


@pytest.mark.parametrize("case", ["swept", "blown, open", "fire in a window"])
def test_a_guided_smoke_continues_to_the_bit(case):
    parameters = scene(**CASES[case])
    world = world_of(parameters, 4)
    saved = world.checkpoint()
    for _ in range(3):
        world.advance_frame()
    again = world_of(parameters)
    again.restore(4, saved)
    for _ in range(3):
        again.advance_frame()
    kept, found = world.checkpoint(), again.checkpoint()
    assert kept.keys() == found.keys()
    assert all(np.array_equal(kept[name], found[name]) for name in kept)


def test_a_checkpoint_without_its_guide_is_refused():
    world = world_of(scene(), 1)
    saved = {name: values for name, values in world.checkpoint().items() if "/guide/" not in name}
    with pytest.raises(ValueError, match=r'the checkpoint holds nothing for "smoke"'):
        world_of(scene()).restore(1, saved)


def test_smoke_stays_behind_a_wall_that_the_guide_does_not_see_as_it_is():
    # Between the guide's cells: two fine cells thick, and a coarse one in part.
    wall = {"name": "wall", "shape": {"type": "box", "size": (1.2, 1.2, 2.0 * CELL)}, "position": (0.0, 0.0, 0.5)}
    solver = smoke_of(world_of(scene(rigid=[wall]), 12))
    density = solver.snapshots()["smoke"].arrays["density"]
    assert density[:, :, :16].max() > 0.5
    assert density[:, :, 17:].max() == 0.0


def test_what_diverges_in_the_guide_is_said_to():
    world = world_of(scene(), 1)
    state = smoke_of(world).guide._smoke.air.state  # nothing else makes it diverge in so few frames
    state.velocity.x.fill(float("nan"))
    with pytest.raises(SimulationDivergedError, match="in the simulation that guides it"):
        world.advance_frame()


def test_a_guide_that_has_no_memory_to_grow_stops_the_world_where_it_is(monkeypatch):
    world = world_of(scene(**CASES["blown, open"]), 1)
    guide = smoke_of(world).guide
    begin = guide.begin_frame
    monkeypatch.setattr(guide, "begin_frame", lambda time_s, _: begin(time_s, lambda _: "no room"))
    with pytest.raises(OutgrownError, match=r"grows at .* no room"):
        for _ in range(40):
            world.advance_frame()
    assert world.frame > 1
    monkeypatch.undo()
    again = world_of(scene(**CASES["blown, open"]))
    again.restore(world.frame, world.checkpoint())
    for each in (world, again):
        each.advance_frame()
    kept, found = world.checkpoint(), again.checkpoint()
    assert all(np.array_equal(kept[name], found[name]) for name in kept)


@pytest.mark.parametrize(
    ("what", "tables"),
    [
        ("dynamic bodies", {"rigid": [{**PLATE, "kind": "dynamic", "density": 600.0}]}),
        ("fluid", {"fluid": [{"name": "water", "block": [CUBE]}]}),
        ("soft matter", {"soft": [{"name": "jelly", "material": "jelly", "block": [CUBE]}]}),
        ("cloth", {"cloth": [{"name": "flag", "shape": {"type": "rectangle", "size": (0.3, 0.3), "counts": (4, 4)}}]}),
    ],
)
def test_what_would_move_otherwise_beside_coarser_smoke_is_refused(what, tables):
    with pytest.raises(ValidationError, match=f"2 is of a smoke in a job with {what}, which would move otherwise"):
        SceneParameters.model_validate({"smoke": [{"name": "smoke", "upres": 2, "source": [PLUME]}], **tables})


def test_a_guide_whose_cells_lose_a_body_is_refused():
    # From 0.67 to 0.73 m, and corners of the guide's cells are at 0.625 and 0.75 m.
    thin = {**PLATE, "shape": {"type": "box", "size": (0.3, 0.8, 0.06)}}
    with pytest.raises(ValueError, match=r"upres: in the guide's cells of 0.125 m: .* falls between its cells"):
        world_of(scene(upres=4, rigid=[thin]))


def test_gusts_of_a_guide_are_as_large_as_its_cells_carry():
    smoke = SmokeParameters(name="smoke", source=[PLUME], upres=4, cell_size=0.02, turbulence={"strength": 1.0})
    assert smoke.guide.turbulence.size == pytest.approx(0.2)
    assert smoke.model_copy(update={"cell_size": 0.05}).guide.turbulence.size == pytest.approx(0.4)


def test_a_guided_plume_is_the_same_with_many_threads_a_row(monkeypatch):
    velocities = []
    for on_gpu in (False, True):
        for module in ("sim.core.reductions", "sim.core.scheduling", "sim.smoke.lanes"):
            monkeypatch.setattr(f"{module}.runs_on_gpu", lambda is_gpu=on_gpu: is_gpu)
        solver = smoke_of(world_of(scene(), 3))
        velocities.append((faces(solver), solver.diagnostics()["guide_correlation"]))
    (one, first), (many, second) = velocities
    # Sums of conjugate gradients have another order, and they stop at 1e-5 of the largest speed.
    largest = max(np.abs(values).max() for values in one)
    assert max(np.abs(a - b).max() for a, b in zip(one, many, strict=True)) < 1.0e-4 * largest
    assert first == pytest.approx(second, abs=1.0e-4)


def digest_of_a_guided_plume() -> tuple[str, float]:
    world = world_of(scene(**CASES["swept"]), 3)
    return digest_of(world.checkpoint()), smoke_of(world).diagnostics()["guide_correlation"]


def test_a_guided_plume_has_the_same_bits_on_any_number_of_threads():
    result_on_any_threads(digest_of_a_guided_plume)
