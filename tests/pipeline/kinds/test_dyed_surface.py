"""The surface of a fluid with dye, as its file has it."""

import numpy as np
import pytest

from pipeline.job.loading import job_of_text
from pipeline.kinds.fluid import SURFACE
from render.meshes import read_ply
from sim.core.snapshots import Snapshot

JOB = """
name = "pool"
[[fluid]]
name = "milk"
particle_radius = 0.01
[[fluid.block]]
shape = { type = "box", size = [0.2, 0.1, 0.1] }
"""
RADIUS = 0.01


@pytest.mark.parametrize("is_dyed", [True, False])
def test_a_vertex_has_the_dye_of_the_particles_around_it(is_dyed, tmp_path):
    axes = [RADIUS * (2 * np.arange(count) + 1) for count in (12, 6, 6)]
    position = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    position = np.concatenate([position, [[0.02, 0.06, 0.3]]], dtype=np.float32)  # spray, of the dye of the other end
    liquid = np.zeros(len(position), np.uint8)
    liquid[-1] = 2
    arrays = {"position": position, "velocity": np.zeros_like(position), "liquid": liquid}
    if is_dyed:
        arrays["dye"] = ((position[:, 0] < 0.12) & (liquid == 0)).astype(np.float32)
    attributes = {"particle_radius": RADIUS, "rest_density": 1000.0, "volume_of_drops": (2.0 * RADIUS) ** 3}
    fluid = Snapshot(kind="fluid", arrays=arrays, attributes=attributes)
    job = job_of_text(JOB, tmp_path / "pool.toml")
    SURFACE.write(tmp_path / "milk.ply", fluid, job, 1)
    mesh = read_ply(tmp_path / "milk.ply")
    if not is_dyed:
        assert mesh.dye is None
        assert mesh.dye_behind is None
        return
    x, dye = mesh.vertices[:, 0], mesh.dye[:, 0]
    assert (dye[x < 0.07] == 1.0).all() and (dye[x > 0.17] == 0.0).all()
    between = dye[np.abs(x - 0.12) < 0.005]
    assert 0.2 < between.mean() < 0.8
    # Straight behind the left face lies the dyed half, behind the bottom all that is above it.
    behind, inner = mesh.dye_behind[:, 0], (np.abs(mesh.vertices[:, 1:] - 0.06) < 0.03).all(axis=1)
    assert behind[inner & (x < 0.01)].mean() == pytest.approx(0.12, rel=0.05)
    assert (behind[x > 0.2] < 0.14).all()
    assert behind[(x > 0.15) & (mesh.normals[:, 2] < -0.99)].max() == 0.0
