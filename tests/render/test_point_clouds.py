"""Whitewater files: round trips, and every way in which one can be wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from render.errors import InvalidFileError
from render.point_clouds import (
    KINDS,
    PointCloud,
    PointCounts,
    read_point_cloud,
    read_point_counts,
    validate_point_cloud,
    write_point_cloud,
)

FIELDS = ("position", "velocity", "radius", "lifetime", "kind")


def some_points(count: int = 50) -> PointCloud:
    random = np.random.default_rng(0)
    return PointCloud(
        position=random.normal(size=(count, 3)).astype(np.float32),
        velocity=random.normal(size=(count, 3)).astype(np.float32),
        radius=random.uniform(0.001, 0.002, count).astype(np.float32),
        lifetime=random.uniform(0, 2, count).astype(np.float32),
        kind=random.integers(0, len(KINDS), count).astype(np.uint8),
    )


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "points.ply"
    write_point_cloud(path, some_points())
    return path


@pytest.mark.parametrize("count", [0, 1, 50])
def test_a_cloud_reads_back_as_written(tmp_path, count):
    path, cloud = tmp_path / "points.ply", some_points(count)
    write_point_cloud(path, cloud)
    validate_point_cloud(path)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(read_point_cloud(path), name), getattr(cloud, name))
    assert read_point_cloud(path).dye is None


def test_drops_of_a_fluid_with_dye_have_it(tmp_path):
    path, dye = tmp_path / "points.ply", np.linspace(0.0, 1.0, 50, dtype=np.float32)
    write_point_cloud(path, replace(some_points(), dye=dye, not_made=2_000_000_000))
    validate_point_cloud(path)
    np.testing.assert_array_equal(read_point_cloud(path).dye, dye)
    assert read_point_counts(path).points == 50
    np.testing.assert_array_equal(trimesh.load(path, process=False).vertices, some_points().position)
    write_point_cloud(path, replace(some_points(), dye=np.full(50, np.nan, np.float32)))
    with pytest.raises(InvalidFileError, match="dye of point 0 is not finite"):
        validate_point_cloud(path)


def test_what_had_no_room_is_told_by_the_header_alone(tmp_path):
    path = tmp_path / "points.ply"
    write_point_cloud(path, replace(some_points(), not_made=1_234_567))
    assert read_point_counts(path) == PointCounts(points=50, not_made=1_234_567)
    assert read_point_cloud(path).not_made == 1_234_567
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(InvalidFileError, match="not a point cloud"):
        read_point_counts(path)


def test_a_file_of_an_earlier_version_is_counted_but_not_read(file):
    file.write_bytes(file.read_bytes().replace(b"comment not_made 0\n", b""))
    assert read_point_counts(file) == PointCounts(points=50, not_made=None)
    with pytest.raises(InvalidFileError, match="of an earlier version; make it anew"):
        read_point_cloud(file)


def test_other_software_reads_the_file(file):
    loaded = trimesh.load(file, process=False)
    np.testing.assert_array_equal(loaded.vertices, some_points().position)
    data = loaded.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(data["lifetime"], some_points().lifetime)
    np.testing.assert_array_equal(data["kind"], some_points().kind)


def test_the_same_arrays_give_the_same_bytes_whatever_their_memory_order(file, tmp_path):
    cloud = some_points()
    write_point_cloud(tmp_path / "other.ply", replace(cloud, position=np.asfortranarray(cloud.position)))
    assert (tmp_path / "other.ply").read_bytes() == file.read_bytes()


@pytest.mark.parametrize("name", FIELDS)
def test_arrays_that_do_not_fit_together_are_refused(tmp_path, name):
    cloud = some_points()
    with pytest.raises(ValueError, match="a row of each"):
        write_point_cloud(tmp_path / "points.ply", replace(cloud, **{name: getattr(cloud, name)[:-1]}))


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("position", np.nan, "position of point 7 is not finite"),
        ("velocity", np.inf, "velocity of point 7 is not finite"),
        ("lifetime", np.nan, "lifetime of point 7 is not finite"),
        ("radius", 0.0, "radius of point 7 is not positive"),
        ("kind", 3, "kind of point 7 is 3, of 0 to 2"),
    ],
)
def test_values_that_make_no_sense_are_found(tmp_path, name, value, said):
    cloud, path = some_points(), tmp_path / "points.ply"
    getattr(cloud, name)[7] = value
    write_point_cloud(path, cloud)
    with pytest.raises(InvalidFileError, match=said):
        validate_point_cloud(path)


@pytest.mark.parametrize("change", [-1, 1])
def test_a_file_of_another_size_is_refused(file, change):
    content = file.read_bytes()
    file.write_bytes(content[:change] if change < 0 else content + b"\0")
    with pytest.raises(InvalidFileError, match="its header promises"):
        validate_point_cloud(file)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"little", b"big"),
        (b"float radius", b"double radius"),
        (b"vertex 50", b"vertex 050"),
        (b"not_made 0", b"not_made -1"),
    ],
)
def test_another_layout_is_refused(file, old, new):
    content = file.read_bytes()
    assert old in content
    file.write_bytes(content.replace(old, new))
    with pytest.raises(InvalidFileError, match="not a point cloud of the expected layout"):
        validate_point_cloud(file)
