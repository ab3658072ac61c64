"""The HDF5 cache gives back what was written, the same bytes each time, and refuses what is damaged."""

import random
from dataclasses import replace

import h5py
import numpy as np
import pytest

from pipeline.base.errors import InvalidArtifactError
from pipeline.store.cache import (
    Checkpoint,
    read_checkpoint,
    read_frame,
    validate_frame,
    write_checkpoint,
    write_frame,
)
from sim.core.snapshots import Snapshot
from sim.core.world import FrameReport

REPORT = FrameReport(7, 7 / 60, {"water": 12}, {"water": 1.25e-3}, {"water": {"mass": 8.0, "iterations": 3.0}})


def bodies(particles: int = 50_000) -> dict[str, Snapshot]:
    random = np.random.default_rng(3)
    fluid = Snapshot(
        "fluid",
        {
            "position": random.random((particles, 3), dtype=np.float32),
            "velocity": random.random((particles, 3), dtype=np.float32),
            "density": np.full(particles, 1000, np.float32),
            "particle_id": np.arange(particles, dtype=np.int32),
        },
        {"particle_radius": 0.01, "rest_density": 1000.0},
    )
    smoke = Snapshot(
        "smoke",
        {
            "density": random.random((8, 9, 10), dtype=np.float32),
            "temperature": 293.0 + random.random((8, 9, 10), dtype=np.float32),
            "velocity": random.random((8, 9, 10, 3), dtype=np.float32),
        },
        {"origin": (0.0, -0.5, 0.25), "cell_size": 0.02},
    )
    return {"water": fluid, "plume": smoke}


def test_a_frame_reads_back_as_written(tmp_path):
    path = tmp_path / "frame.h5"
    written = bodies()
    write_frame(path, written, REPORT, device="cpu")
    frame = read_frame(path)
    assert (frame.frame, frame.time_s, frame.device) == (7, 7 / 60, "cpu")
    assert frame.diagnostics["water"] == {"substeps": 12, "smallest_dt_s": 1.25e-3, "mass": 8.0, "iterations": 3.0}
    for name, body in written.items():
        assert frame.bodies[name].kind == body.kind
        assert frame.bodies[name].attributes == body.attributes
        for key, array in body.arrays.items():
            np.testing.assert_array_equal(frame.bodies[name].arrays[key], array)
            assert frame.bodies[name].arrays[key].dtype == array.dtype


def test_one_body_is_read_without_the_others(tmp_path):
    write_frame(tmp_path / "frame.h5", bodies(), REPORT, device="cpu")
    assert list(read_frame(tmp_path / "frame.h5", "plume").bodies) == ["plume"]


def test_the_same_frame_gives_the_same_bytes(tmp_path):
    for name in ("a.h5", "b.h5"):
        write_frame(tmp_path / name, bodies(), REPORT, device="cpu")
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_a_frame_made_in_memory_has_the_bytes_that_hdf5_writes_to_the_disk(tmp_path, monkeypatch):
    write_frame(tmp_path / "memory.h5", bodies(), REPORT, device="cpu")
    monkeypatch.setattr("pipeline.store.cache._new_file", lambda path: h5py.File(path, "w", libver=("v108", "v110")))
    write_frame(tmp_path / "disk.h5", bodies(), REPORT, device="cpu")
    assert (tmp_path / "memory.h5").read_bytes() == (tmp_path / "disk.h5").read_bytes()


def test_a_fluid_without_particles_is_a_frame_too(tmp_path):
    write_frame(tmp_path / "frame.h5", bodies(0), REPORT, device="cpu")
    validate_frame(tmp_path / "frame.h5")
    assert read_frame(tmp_path / "frame.h5").bodies["water"].arrays["position"].shape == (0, 3)


@pytest.mark.parametrize("kept", [0.0, 0.1, 0.5, 0.999])
def test_a_truncated_frame_is_refused(tmp_path, kept):
    path = tmp_path / "frame.h5"
    write_frame(path, bodies(), REPORT, device="cpu")
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * kept)])
    with pytest.raises(InvalidArtifactError):
        validate_frame(path)


def test_a_flipped_bit_in_an_array_is_refused(tmp_path):
    path = tmp_path / "frame.h5"
    write_frame(path, bodies(), REPORT, device="cpu")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(InvalidArtifactError):
        validate_frame(path)


def test_values_that_are_not_finite_are_refused(tmp_path):
    damaged = bodies()
    damaged["water"].arrays["velocity"][17, 1] = np.nan
    write_frame(tmp_path / "frame.h5", damaged, REPORT, device="cpu")
    with pytest.raises(InvalidArtifactError, match='velocity of "water"'):
        validate_frame(tmp_path / "frame.h5")


def test_a_file_of_another_kind_is_refused(tmp_path):
    write_checkpoint(tmp_path / "other.h5", Checkpoint(3, "f", "cpu", {"water/x": np.zeros(4)}))
    with pytest.raises(InvalidArtifactError, match="not a complete"):
        read_frame(tmp_path / "other.h5")


def test_a_checkpoint_reads_back_bit_for_bit(tmp_path):
    random = np.random.default_rng(5)
    arrays = {
        "water/position": random.random((1000, 3), dtype=np.float32),
        "water/counters": np.array([3, 2**53 + 1]),
        "plume/time": np.array(0.1),
        "plume/none": np.empty((0, 3), np.float32),
    }
    write_checkpoint(tmp_path / "c.h5", Checkpoint(42, "abc", "cpu", arrays))
    checkpoint = read_checkpoint(tmp_path / "c.h5")
    assert (checkpoint.frame, checkpoint.fingerprint, checkpoint.device) == (42, "abc", "cpu")
    assert set(checkpoint.arrays) == set(arrays)
    for key, array in arrays.items():
        np.testing.assert_array_equal(checkpoint.arrays[key], array)
        assert checkpoint.arrays[key].dtype == array.dtype


def test_a_checkpoint_of_a_scene_without_state_reads_back(tmp_path):
    write_checkpoint(tmp_path / "c.h5", Checkpoint(3, "abc", "cpu", {}))
    assert read_checkpoint(tmp_path / "c.h5").arrays == {}


def test_no_flipped_bit_of_a_checkpoint_goes_unnoticed(tmp_path):
    """HDF5's own checksums are about the arrays, not about the attributes and what says how to read the arrays."""
    path, chance = tmp_path / "c.h5", random.Random(2)
    arrays = {"rigid/position": np.arange(9.0).reshape(3, 3), "rigid/count": np.int64(3), "smoke/on": np.array([True])}
    write_checkpoint(path, Checkpoint(7, "f" * 64, "cpu", arrays))
    whole = path.read_bytes()
    refused = 0
    for _ in range(1500):
        flipped = bytearray(whole)
        flipped[chance.randrange(len(whole))] ^= 1 << chance.randrange(8)
        path.write_bytes(flipped)
        try:
            checkpoint = read_checkpoint(path)
        except InvalidArtifactError:
            refused += 1
        else:  # in what holds nothing
            assert (checkpoint.frame, checkpoint.fingerprint, checkpoint.device) == (7, "f" * 64, "cpu")
            assert checkpoint.arrays.keys() == arrays.keys()
            assert all(np.array_equal(checkpoint.arrays[key], array) for key, array in arrays.items())
    assert refused > 100


def test_a_dataset_that_claims_far_more_than_is_stored_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "frame.h5"
    write_frame(path, bodies(100), REPORT, device="cpu")
    with h5py.File(path, "r+") as file:
        group = next(group for group in file.values() if isinstance(group, h5py.Group) and "water" in group)["water"]
        del group["density"]
        group.create_dataset("density", shape=(10**13,), dtype="f4", chunks=(1 << 20,))  # 40 TB, none of it written
    with pytest.raises(InvalidArtifactError, match="hardly any are stored"):
        read_frame(path, "water")


def test_the_most_compressible_array_is_still_read(tmp_path):
    path = tmp_path / "c.h5"
    write_checkpoint(path, Checkpoint(0, "f", "cpu", {"still": np.zeros(8 << 20)}))
    assert not read_checkpoint(path).arrays["still"].any()


def test_every_array_of_a_body_says_its_unit(tmp_path):
    path = tmp_path / "frame.h5"
    there = bodies()
    plume = replace(there["plume"], attributes={**there["plume"].attributes, "ambient_temperature": 293.0})
    write_frame(path, {**there, "plume": plume}, REPORT, device="cpu", longest_shutter_s=1 / 60)
    with h5py.File(path) as file:
        units = {
            f"{group.attrs['kind']}/{key}": dataset.attrs["units"]
            for group in file["bodies"].values()
            for key, dataset in group.items()
        }
    assert units["fluid/position"] == "m"
    assert (units["fluid/density"], units["smoke/density"]) == ("kg/m3", "1")
    assert set(units.values()) <= {"m", "m/s", "kg/m3", "Pa", "K", "rad/s", "1"}
