"""Where Blender finds the smoke of a file, and how much of it; in a child process, for bpy may be there once only."""

from __future__ import annotations

import numpy as np
import pytest
from needed_blender import needs_bpy
from warm_python import run_python

from render.parameters import VolumeParameters
from render.volume import write_volume

pytestmark = needs_bpy

FIND_SMOKE = """
    import sys
    from pathlib import Path
    import bpy
    import numpy as np
    from blender_scripts.volumes import load_volume, new_volume_object
    expected = np.array([[float(value) for value in corner.split(",")] for corner in sys.argv[2:4]])
    smoke = new_volume_object("smoke")
    load_volume(smoke.data, Path(sys.argv[1]))
    grids = {grid.name: grid for grid in smoke.data.grids}
    types = {name: grid.data_type for name, grid in grids.items()}
    assert types == {"density": "FLOAT", "temperature": "FLOAT", "velocity": "VECTOR_FLOAT"}
    assert smoke.data.velocity_grid == "velocity"
    assert smoke.data.velocity_unit == "SECOND"
    # The surface on which an interpolated density is 1/2 is where the sides of full cells beside empty ones are.
    mesh = bpy.data.objects.new("surface", bpy.data.meshes.new("surface"))
    bpy.context.scene.collection.objects.link(mesh)
    modifier = mesh.modifiers.new("surface", "VOLUME_TO_MESH")
    modifier.object, modifier.grid_name, modifier.resolution_mode = smoke, "density", "GRID"
    modifier.threshold, modifier.adaptivity = 0.5, 0.0
    surface = mesh.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    points = np.empty(3 * len(surface.vertices), np.float32)
    surface.vertices.foreach_get("co", points)
    points = points.reshape(-1, 3)
    corners = np.stack([points.min(axis=0), points.max(axis=0)])
    print("CORNERS", corners.tolist(), "expected", expected.tolist())
    # float32 at one metre, times some roundings.
    assert np.abs(corners - expected).max() < 2e-6
"""


@pytest.mark.parametrize("half_precision", [True, False])
def test_blender_finds_smoke_at_its_place_in_the_world(tmp_path, half_precision):
    """A block of cells of three different lengths, off the middle of a box that is off the origin, read as a part."""
    shape, block, first_cell = (24, 20, 30), (slice(3, 9), slice(11, 13), slice(14, 27)), (5, 0, 9)
    origin, cell_size = np.array([-0.7, 0.31, 0.05]), 0.025
    density = np.zeros(shape, np.float32)
    density[block] = 1.0
    write_volume(
        tmp_path / "smoke.vdb",
        density=density,
        temperature=293.0 + 100.0 * density,
        velocity=np.full((*shape, 3), 0.5, np.float32),
        origin=origin,
        cell_size=cell_size,
        ambient_temperature=293.0,
        parameters=VolumeParameters(half_precision=half_precision),
        fps=60.0,
        shutter=0.5,
        first_cell=first_cell,
    )
    corners = [
        origin + cell_size * (np.array(first_cell) + [getattr(side, end) for side in block])
        for end in ("start", "stop")
    ]
    run_python(FIND_SMOKE, str(tmp_path / "smoke.vdb"), *(",".join(map(repr, map(float, each))) for each in corners))
