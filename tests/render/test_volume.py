"""OpenVDB files: what is written is what is read, where it is read, and nothing else."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from fresh_python import run_python as run_fresh_python
from read_volumes import read_volume

from render.errors import InvalidFileError, VolumeUnavailableError
from render.parameters import VolumeParameters
from render.volume import import_openvdb, validate_volume, write_volume

SHAPE = (20, 24, 16)
FULL_PRECISION = VolumeParameters(half_precision=False, tolerance=1.0e-4)

try:
    import_openvdb()
except VolumeUnavailableError as error:
    pytestmark = pytest.mark.skip(reason=str(error))


@pytest.fixture
def smoke() -> dict[str, np.ndarray]:
    """A puff away from the walls, hot, in a wind that varies from cell to cell."""
    random = np.random.default_rng(7)
    density = np.zeros(SHAPE, np.float32)
    density[8:12, 9:14, 6:10] = random.uniform(0.1, 1.0, (4, 5, 4))
    return {
        "density": density,
        "temperature": 293 + 80 * density,
        "velocity": random.uniform(0.5, 1.0, (*SHAPE, 3)).astype(np.float32),
    }


def write(path: Path, fields: dict[str, np.ndarray], **changes) -> Path:
    arguments = {
        "origin": (-1.0, 2.0, 0.5),
        "cell_size": 0.1,
        "ambient_temperature": 293.0,
        "parameters": FULL_PRECISION,
        "fps": 60.0,
        "shutter": 0.5,
        **fields,
        **changes,
    }
    write_volume(path, **arguments)
    return path


def test_fields_read_back_as_written(tmp_path, smoke):
    path = write(tmp_path / "smoke.vdb", smoke)
    validate_volume(path)
    volume = read_volume(path, SHAPE)
    np.testing.assert_array_equal(volume.density, smoke["density"])
    np.testing.assert_array_equal(volume.temperature, (smoke["temperature"] - np.float32(293)))
    inside = smoke["density"] > 0
    np.testing.assert_array_equal(volume.velocity[inside], smoke["velocity"][inside])


def test_half_precision_rounds_to_sixteen_bits(tmp_path, smoke):
    smoke["density"] = np.random.default_rng(8).uniform(0.1, 1.0, SHAPE).astype(np.float32)
    full = write(tmp_path / "full.vdb", smoke)
    half = write(tmp_path / "half.vdb", smoke, parameters=VolumeParameters(half_precision=True))
    density = read_volume(half, SHAPE).density
    # 11 bits of mantissa: half a unit in the last place, or a whole one where OpenVDB truncates.
    np.testing.assert_allclose(density, smoke["density"], rtol=2.0**-10)
    assert not np.array_equal(density, smoke["density"])
    # Two bytes less for each of the two scalars of a cell, at least: random mantissas do not compress.
    assert full.stat().st_size - half.stat().st_size > 2 * 2 * smoke["density"].size


def test_memory_order_of_the_arrays_does_not_matter(tmp_path, smoke):
    fields = {name: np.asarray(values, order="F") for name, values in smoke.items()}
    reference = write(tmp_path / "reference.vdb", smoke)
    assert write(tmp_path / "other.vdb", fields).read_bytes() == reference.read_bytes()


def test_cells_lie_where_the_grid_says(tmp_path, smoke):
    volume = read_volume(write(tmp_path / "smoke.vdb", smoke), SHAPE)
    # Double precision through one multiplication and one addition.
    np.testing.assert_allclose(volume.centre, (-0.95, 2.05, 0.55), rtol=1e-12)
    assert volume.cell_size == pytest.approx(0.1, rel=1e-12)


def test_density_below_the_tolerance_is_empty_space(tmp_path, smoke):
    smoke["density"][0, 0, 0] = 0.9e-4
    smoke["density"][1, 1, 1] = 1.1e-4
    path = write(tmp_path / "smoke.vdb", smoke)
    assert read_volume(path, SHAPE).density[0, 0, 0] == 0
    assert read_volume(path, SHAPE).density[1, 1, 1] == np.float32(1.1e-4)
    assert read_volume(path, SHAPE).metadata["density"]["file_voxel_count"] == (smoke["density"] > 1e-4).sum()


def test_empty_space_takes_no_room(tmp_path, smoke):
    """The file of a puff in a large room is hardly larger than that of the puff alone."""
    small = write(tmp_path / "small.vdb", smoke)
    large = {name: np.zeros((120, 120, 120, *values.shape[3:]), np.float32) for name, values in smoke.items()}
    large["temperature"] += 293
    for name, values in smoke.items():
        large[name][:20, :24, :16] = values
    # Some more tree nodes, and the velocity around the puff is compressed in other blocks.
    assert write(tmp_path / "large.vdb", large).stat().st_size < 1.1 * small.stat().st_size


@pytest.mark.parametrize("speed", [0.0, 30.0])
def test_velocity_reaches_as_far_around_the_smoke_as_it_can_blur(tmp_path, smoke, speed):
    smoke["velocity"][:] = (speed, 0.0, 0.1)
    volume = read_volume(write(tmp_path / "smoke.vdb", smoke, shutter=1.0), SHAPE)
    reach = int(np.ceil(np.hypot(speed, 0.1) * 1.0 / (2 * 60) / 0.1)) + 1
    blurred = np.zeros(SHAPE, bool)
    blurred[8 - reach : 12 + reach, 9 - reach : 14 + reach, 6 - reach : 10 + reach] = True
    np.testing.assert_array_equal(volume.velocity.any(axis=-1), blurred)


def test_smoke_at_the_wall_keeps_its_velocity_beyond_the_grid(tmp_path, smoke):
    smoke["density"][-1, 10, 10] = 1.0
    path = write(tmp_path / "smoke.vdb", smoke)
    outside = read_volume(path, (1, 1, 1), first_cell=(SHAPE[0], 10, 10))
    np.testing.assert_array_equal(outside.velocity[0, 0, 0], smoke["velocity"][-1, 10, 10])
    assert outside.density[0, 0, 0] == 0


def test_grids_say_what_they_are_made_of_by_the_conventions_that_renderers_look_for(tmp_path, smoke):
    metadata = read_volume(write(tmp_path / "smoke.vdb", smoke, parameters=VolumeParameters()), SHAPE).metadata
    units = {
        "density": "dimensionless",
        "temperature": "K above ambient_temperature",
        "velocity": "m/s, at cell centres",
    }
    for name, unit in units.items():
        expected = {"name": name, "creator": "physics-pipeline", "is_saved_as_half_float": True, "unit": unit}
        assert expected.items() <= metadata[name].items()
    assert metadata["density"]["class"] == metadata["temperature"]["class"] == "fog volume"
    assert metadata["temperature"]["ambient_temperature"] == 293.0
    assert metadata["velocity"]["vector_type"] == "contravariant relative"
    assert metadata["velocity"]["is_local_space"] is False
    assert "class" not in metadata["velocity"]  # "staggered" would be half a cell wrong


def test_only_cells_with_something_in_them_are_active(tmp_path, smoke):
    """In a box of 20 x 24 x 16 cells and whole leaves of 8³, of which the puff touches 2 x 2 x 2."""
    write(tmp_path / "smoke.vdb", smoke, shutter=0.0)
    grids = {grid.name: grid for grid in import_openvdb().readAll(str(tmp_path / "smoke.vdb"))[0]}
    assert grids["density"].activeVoxelCount() == 4 * 5 * 4
    assert grids["temperature"].activeVoxelCount() == (80 * smoke["density"] > 0.5).sum()
    assert grids["velocity"].activeVoxelCount() == 6 * 7 * 6  # a cell for interpolation
    assert grids["density"].leafCount() == 1 * 1 * 2  # x 8 to 11, y 9 to 13, z 6 to 9
    assert grids["velocity"].leafCount() == 2 * 1 * 2  # x 7 to 12, y 8 to 14, z 5 to 10
    for grid in grids.values():
        outside = grid.background
        assert outside == (0 if grid.valueTypeName == "float" else (0, 0, 0))


def test_a_grid_that_sixteen_bits_cannot_hold_is_stored_in_full(tmp_path, smoke):
    """A half float ends at 65504; beyond it OpenVDB writes infinity."""
    smoke["density"][9, 10, 7] = 65505.0
    smoke["temperature"][9, 10, 7] = 293.0 + 65504.0
    path = write(tmp_path / "smoke.vdb", smoke, parameters=VolumeParameters())
    validate_volume(path)
    volume = read_volume(path, SHAPE)
    halves = {name: volume.metadata[name].get("is_saved_as_half_float", False) for name in volume.metadata}
    assert halves == {"density": False, "temperature": True, "velocity": True}
    np.testing.assert_array_equal(volume.density, smoke["density"])
    assert volume.temperature[9, 10, 7] == 65504.0


def test_a_part_of_the_box_lies_where_it_does_in_the_whole(tmp_path, smoke):
    part = tuple(slice(a, b) for a, b in ((3, 18), (5, 24), (1, 15)))
    whole = write(tmp_path / "whole.vdb", smoke)
    cut = {name: values[part] for name, values in smoke.items()}
    assert write(tmp_path / "part.vdb", cut, first_cell=(3, 5, 1)).read_bytes() == whole.read_bytes()
    cut["density"] = cut["density"].copy()
    cut["density"][1, 2, 3] = np.inf
    with pytest.raises(ValueError, match=r"density of cell \(4, 7, 4\) is not finite"):
        write(tmp_path / "part.vdb", cut, first_cell=(3, 5, 1))


@pytest.mark.parametrize("column", [8, 16, 640])
def test_the_columns_that_a_volume_is_written_in_leave_no_trace(tmp_path, smoke, column, monkeypatch):
    smoke["density"][0, 10, 10] = 1.0  # its velocity begins outside of the box, at a negative index
    reference = write(tmp_path / "reference.vdb", smoke, shutter=1.0)
    monkeypatch.setattr("render.volume._COLUMN", column)
    other = write(tmp_path / "other.vdb", smoke, shutter=1.0)
    validate_volume(other)
    assert other.read_bytes() == reference.read_bytes()


def test_writing_takes_little_memory_beside_the_arrays(tmp_path):
    """A full box, of which no copy is made but of the temperature; OpenVDB's own memory is not counted here."""
    cells = 128
    random = np.random.default_rng(4)
    fields = {
        "density": random.random((cells,) * 3, dtype=np.float32),
        "temperature": 293 + 50 * random.random((cells,) * 3, dtype=np.float32),
        "velocity": random.random((cells, cells, cells, 3), dtype=np.float32),
    }
    tracemalloc.start()
    try:
        write(tmp_path / "smoke.vdb", fields, parameters=VolumeParameters())
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # 22 were measured: the temperature above ambient, masks of one byte each, and either a quarter of the velocities in
    # both precisions, or the file (random numbers do not compress) while it is hashed. A float64 copy of the velocity
    # would be 24 alone, a padded one of float32 13.
    assert peak < 24 * cells**3


def test_hot_air_without_smoke_keeps_its_velocity(tmp_path, smoke):
    """It may glow."""
    smoke["temperature"][2, 3, 4] = 900.0
    volume = read_volume(write(tmp_path / "smoke.vdb", smoke), SHAPE)
    np.testing.assert_array_equal(volume.velocity[1:4, 2:5, 3:6], smoke["velocity"][1:4, 2:5, 3:6])


def test_a_frame_without_smoke_still_has_its_grids(tmp_path, smoke):
    smoke["density"][:] = 0
    smoke["temperature"][:] = 293
    path = write(tmp_path / "empty.vdb", smoke)
    validate_volume(path)
    volume = read_volume(path, SHAPE)
    assert set(volume.metadata) == {"density", "temperature", "velocity"}
    assert not volume.density.any()
    assert not volume.velocity.any()


def test_two_writes_give_equal_bytes(tmp_path, smoke):
    first, second = (write(tmp_path / name, smoke).read_bytes() for name in ("first.vdb", "second.vdb"))
    assert first == second
    smoke["density"][9, 10, 7] += 0.1
    assert write(tmp_path / "third.vdb", smoke).read_bytes()[21:57] != first[21:57]


@pytest.mark.parametrize("kept", [0, 20, 50, 300, 0.5, -1])
def test_a_truncated_file_is_refused(tmp_path, smoke, kept):
    path = write(tmp_path / "smoke.vdb", smoke)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content)) if isinstance(kept, float) else kept])
    with pytest.raises(InvalidFileError, match=r"smoke\.vdb: (is not an OpenVDB file|was truncated or changed)"):
        validate_volume(path)


def test_a_changed_byte_is_noticed(tmp_path, smoke):
    path = write(tmp_path / "smoke.vdb", smoke)
    content = bytearray(path.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content)
    with pytest.raises(InvalidFileError, match="changed"):
        validate_volume(path)


@pytest.mark.parametrize("field", ["density", "temperature", "velocity"])
def test_values_that_are_not_finite_are_refused_with_their_cell(tmp_path, smoke, field):
    smoke[field][3, 4, 5] = np.nan
    with pytest.raises(ValueError, match=rf"{field} of cell \(3, 4, 5\) is not finite"):
        write(tmp_path / "smoke.vdb", smoke)


def test_fields_of_different_grids_are_refused(tmp_path, smoke):
    smoke["temperature"] = smoke["temperature"][:-1]
    with pytest.raises(ValueError, match="one grid of cells"):
        write(tmp_path / "smoke.vdb", smoke)


def test_openvdb_is_found_without_importing_bpy_and_a_python_without_it_is_told_where_it_comes_from():
    run_fresh_python("""
    import importlib.util, sys
    from unittest.mock import patch
    from render.errors import VolumeUnavailableError
    from render.volume import import_openvdb
    found = importlib.util.find_spec
    without = lambda name, *rest: None if name in ("bpy", "openvdb") else found(name, *rest)
    with patch("importlib.util.find_spec", without):
        try:
            import_openvdb()
        except VolumeUnavailableError as error:
            assert "OpenVDB is not installed: it comes inside the bpy wheel" in str(error)
        else:
            raise AssertionError("it is there")
    import_openvdb()
    assert "bpy" not in sys.modules
    """)
