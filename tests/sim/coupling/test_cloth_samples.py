"""Where a fluid's samples of cloths are, and what they stand for."""

import numpy as np
import pytest

from sim.cloth.parameters import ClothParameters
from sim.cloth.solver import ClothSolver
from sim.core.domain import DomainParameters
from sim.coupling.cloth_fluid import ClothSamples
from sim.fluid.kernels import evaluate, particle_volume
from sim.fluid.sheets import AMID_SAMPLES, STANDOFF, kept_away, sheet_depth

SPACING = 0.02


def sampled(side: float, nodes: int, support: float = 2.0, **more: object) -> tuple[ClothSolver, ClothSamples]:
    shape = {"type": "rectangle", "size": (side, side), "counts": (nodes, nodes)}
    cloth = ClothParameters.model_validate({"name": "sheet", "shape": shape, "thickness": 0.002, **more})
    solver = ClothSolver([cloth], domain=DomainParameters(), gravity=(0.0, 0.0, -9.81), frames_per_second=60.0)
    return solver, ClothSamples.of(solver, SPACING, support)


@pytest.mark.parametrize("nodes", [3, 11, 31], ids=["coarse", "alike", "fine"])
def test_samples_share_mass_and_reach_every_node(taichi_cpu, nodes):
    cloth, samples = sampled(0.2, nodes, mass_per_area=0.3)
    assert samples.sheets.own_mass.sum() == pytest.approx(0.3 * 0.04)
    assert np.allclose(samples.weights.sum(axis=1), 1.0) and samples.weights.min() > 0.0
    assert len(np.unique(samples.nodes)) == cloth.state.vertex_count
    # None farther from the next than a spacing, in squares cut into two triangles each.
    nearest = np.linalg.norm(samples.start[:, None] - samples.start[None], axis=2) + 10.0 * np.eye(len(samples.start))
    assert nearest.min(axis=1).max() < SPACING


@pytest.mark.parametrize("support", [2.0, 3.0, 4.0])
@pytest.mark.parametrize("nodes", [5, 21], ids=["coarse", "fine"])
def test_a_particle_amid_the_samples_is_pushed_out_and_fluid_rests_where_it_should(taichi_cpu, nodes, support):
    _, samples = sampled(0.4, nodes, support)
    volumes = samples.sheets.boundary.volumes(SPACING, support)
    behind = sheet_depth(support) * SPACING
    height = np.linspace(0.0, support * SPACING - behind, 41)
    places = np.random.default_rng(0).uniform(-0.05, 0.05, (100, 2))  # samples within the support are all there
    probes = np.concatenate([np.column_stack([places, np.full(100, z + behind)]) for z in height])
    distance = np.linalg.norm(probes[:, None] - samples.sheets.boundary.positions[None], axis=2)
    density = (evaluate(distance, support * SPACING) @ volumes).reshape(len(height), 100)
    assert density[0].mean() == pytest.approx(AMID_SAMPLES, rel=0.1)
    assert density[0].min() > 1.5
    lattice = np.stack(np.meshgrid(*[np.arange(-4.0, 5.0)] * 2, np.arange(1.0, 5.0), indexing="ij"), axis=-1)
    beyond = np.linalg.norm(lattice.reshape(-1, 3), axis=1)
    lacking = particle_volume(1.0, support) * evaluate(beyond, support).sum()
    rest = np.interp(-lacking, -density.mean(axis=1), height) / SPACING
    assert rest == pytest.approx(STANDOFF, abs=0.05)


def test_the_water_that_stays_away_is_that_of_the_gap_less_the_volume_of_the_sheet(taichi_cpu):
    _, samples = sampled(0.2, 11)
    around = 2.0 * kept_away() * SPACING * 0.04
    assert samples.sheets.missing_volume.sum() == pytest.approx(around - 0.002 * 0.04)
