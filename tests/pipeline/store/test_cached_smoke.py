"""Smoke in the cache: where it is, as exactly as pictures can show, and nothing of the empty space around it."""

import dataclasses
from pathlib import Path

import h5py
import numpy as np
import pytest

from pipeline.base.errors import InvalidArtifactError
from pipeline.kinds.smoke_codec import TEMPERATURE_STEP_K, _to_bits
from pipeline.store.cache import read_compact, read_frame, validate_frame, write_frame
from render.errors import VolumeUnavailableError
from render.parameters import VolumeParameters
from render.volume import import_openvdb, write_volume
from sim.core.snapshots import Snapshot
from sim.core.world import FrameReport

FPS = 50.0
CELL_SIZE = 0.02
AMBIENT = 293.15
"""No sum of a few powers of two: what is empty must be exactly this all the same."""
SHAPE = (100, 60, 80)
PUFF = (slice(40, 52), slice(20, 30), slice(33, 50))


def puff(shape: tuple[int, int, int] = SHAPE, where: tuple[slice, ...] = PUFF) -> Snapshot:
    """Smoke and heat in a box, and a flow of up to 2 m/s that is nowhere at rest."""
    random = np.random.default_rng(11)
    density = np.zeros(shape, np.float32)
    density[where] = random.uniform(1.0e-3, 1.0, density[where].shape)
    temperature = np.where(density > 0, AMBIENT + 150.0 * density, AMBIENT).astype(np.float32)
    velocity = random.uniform(0.1, 1.15, (*shape, 3)).astype(np.float32)
    arrays = {"density": density, "temperature": temperature, "velocity": velocity}
    attributes = {"origin": (-1.0, 0.5, 0.0), "cell_size": CELL_SIZE, "ambient_temperature": AMBIENT}
    return Snapshot("smoke", arrays, attributes)


def write(path: Path, smoke: Snapshot, *, longest_shutter_s: float | None = 1 / FPS) -> Path:
    report = FrameReport(3, 3 / FPS, {}, {}, {"plume": {"mass": 1.0}})
    write_frame(path, {"plume": smoke}, report, device="cpu", longest_shutter_s=longest_shutter_s)
    return path


def near(smoke: Snapshot, shutter_s: float = 1 / FPS) -> np.ndarray:
    """Cells that the puff may be drawn in, by the formula: max|v| shutter / 2, and a cell for interpolation."""
    density, velocity = smoke.arrays["density"], smoke.arrays["velocity"]
    fastest = np.linalg.norm(velocity[density > 0].astype(float), axis=-1).max()
    reach = int(np.ceil(fastest * shutter_s / 2 / CELL_SIZE)) + 1
    mask = np.zeros(density.shape, bool)
    cells = np.argwhere(density > 0)
    low, high = np.maximum(cells.min(axis=0) - reach, 0), cells.max(axis=0) + reach + 1
    mask[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = True
    return mask


def test_what_pictures_show_comes_back_within_the_stated_errors(tmp_path):
    smoke = puff()
    read = read_frame(write(tmp_path / "a.h5", smoke)).bodies["plume"]
    assert read.attributes == smoke.attributes
    assert {array.dtype for array in read.arrays.values()} == {np.dtype(np.float32)}
    # Half a unit in the last of 11 bits; half a step of 1/4 K, and float32's own rounding at 450 K.
    np.testing.assert_allclose(read.arrays["density"], smoke.arrays["density"], rtol=2.0**-11, atol=0)
    np.testing.assert_allclose(read.arrays["temperature"], smoke.arrays["temperature"], rtol=0, atol=0.125 + 3e-5)
    # Half of the largest step: half a 64th of a cell a frame, of which half a shutter makes 1/256 of a cell.
    there = near(smoke)
    error = np.abs(read.arrays["velocity"] - smoke.arrays["velocity"])[there]
    assert error.max() <= 0.5 * CELL_SIZE * FPS / 64
    assert error.max() / FPS / 2 <= CELL_SIZE / 256
    assert not read.arrays["velocity"][~there].any()
    assert (read.arrays["temperature"][smoke.arrays["density"] == 0] == np.float32(AMBIENT)).all()


def test_densities_are_rounded_as_to_sixteen_bit_floats(tmp_path):
    random = np.random.default_rng(2)
    values = (2.0 ** random.uniform(-13.9, 3.0, 100_000)).astype(np.float32)
    ties = np.float32(1.0) + np.arange(8, dtype=np.float32) * np.float32(2.0**-11)
    for exact in (values, ties):
        np.testing.assert_array_equal(_to_bits(exact), exact.astype(np.float16).astype(np.float32))
    # Unlike those it knows no largest value.
    assert _to_bits(np.array([1.0e6], np.float32))[0] == pytest.approx(1.0e6, rel=2.0**-11)


def test_empty_space_is_not_in_the_file(tmp_path):
    """A puff in a room of eight times the volume takes as much as in a small one, but for the index of the chunks."""
    small = write(tmp_path / "small.h5", puff((64, 64, 64)))
    large = write(tmp_path / "large.h5", puff((128, 128, 128)))
    # 64 chunks of 32³ cells, of density, temperature and three components, with 16 bytes each in the index at most;
    # and 1 % for velocities that are other random numbers.
    assert abs(large.stat().st_size - small.stat().st_size) < 5 * 64 * 16 + 0.01 * small.stat().st_size
    with h5py.File(large) as file:
        group = file["bodies/plume"]
        assert group["density"].shape == (128, 128, 128)
        # In chunks, the puff lies in 1, 0 and 1 along x, y and z; two cells around it are in 0 along z, too.
        assert group["density"].id.get_num_chunks() == 1
        assert group["velocity"].id.get_num_chunks() == 3 * 2
        assert group["temperature"][0, 0, 0] == np.float32(AMBIENT)


def test_the_part_that_is_there_is_the_whole_without_its_surroundings(tmp_path):
    path = write(tmp_path / "a.h5", puff())
    whole, part = read_frame(path).bodies["plume"], read_compact(path, "plume")
    box = tuple(slice(a, a + n) for a, n in zip(part.first_cell, part.density.shape, strict=True))
    assert part.density.size < 0.06 * np.prod(SHAPE)
    for key in ("density", "temperature", "velocity"):
        filled = np.full_like(whole.arrays[key], AMBIENT if key == "temperature" else 0.0)
        filled[box] = getattr(part, key)
        np.testing.assert_array_equal(filled, whole.arrays[key])
    assert (part.origin, part.cell_size, part.ambient_temperature) == ((-1.0, 0.5, 0.0), CELL_SIZE, AMBIENT)


def test_a_frame_without_smoke_is_a_frame_too(tmp_path):
    smoke = puff(where=(slice(0, 0),) * 3)
    path = write(tmp_path / "a.h5", smoke)
    validate_frame(path)
    assert read_compact(path, "plume").density.shape == (0, 0, 0)
    arrays = read_frame(path).bodies["plume"].arrays
    assert not arrays["density"].any()
    assert not arrays["velocity"].any()
    assert (arrays["temperature"] == np.float32(AMBIENT)).all()


def test_hot_air_without_smoke_is_kept_with_its_velocity(tmp_path):
    smoke = puff()
    heat = smoke.arrays["temperature"].copy()
    smoke.arrays["density"][:] = 0
    read = read_frame(write(tmp_path / "a.h5", smoke)).bodies["plume"].arrays
    np.testing.assert_allclose(read["temperature"], heat, rtol=0, atol=0.5 * TEMPERATURE_STEP_K + 3e-5)
    assert read["velocity"][PUFF].all()


def test_smoke_is_kept_as_it_is_where_no_shutter_is_named(tmp_path):
    smoke = puff()
    path = write(tmp_path / "a.h5", smoke, longest_shutter_s=None)
    for read in (read_frame(path).bodies["plume"].arrays, vars(read_compact(path, "plume"))):
        for key, array in smoke.arrays.items():
            np.testing.assert_array_equal(read[key], array)


def test_the_same_smoke_gives_the_same_bytes(tmp_path):
    first, second = (write(tmp_path / name, puff()).read_bytes() for name in ("a.h5", "b.h5"))
    assert first == second


@pytest.mark.parametrize("key", ["density", "temperature", "velocity"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused_with_field_and_cell(tmp_path, key, value):
    smoke = puff()
    smoke.arrays[key][97, 3, 4] = value  # far from the smoke, where nothing would be kept
    with pytest.raises(InvalidArtifactError, match=rf'{key} of "plume" is not finite in cell \(97, 3, 4\)'):
        write(tmp_path / "a.h5", smoke)
    assert not (tmp_path / "a.h5").exists()


@pytest.mark.parametrize("kept", [0.2, 0.6, 0.999])
def test_a_truncated_frame_is_refused(tmp_path, kept):
    path = write(tmp_path / "a.h5", puff())
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(InvalidArtifactError, match=r"a\.h5: not a"):
        validate_frame(path)


def test_a_flipped_bit_in_any_array_is_refused(tmp_path):
    path = write(tmp_path / "a.h5", puff())
    content = path.read_bytes()
    for key in ("density", "temperature", "velocity"):
        with h5py.File(path) as file:
            chunk = file["bodies/plume"][key].id.get_chunk_info(0)
        damaged = bytearray(content)
        damaged[chunk.byte_offset + chunk.size // 2] ^= 4
        path.write_bytes(damaged)
        for read in (validate_frame, lambda damaged: read_compact(damaged, "plume")):
            with pytest.raises(InvalidArtifactError, match=r"a\.h5: not a readable frame of the cache"):
                read(path)
        path.write_bytes(content)


@pytest.mark.parametrize("shutter", [0.5, 1.0])
@pytest.mark.parametrize(
    "where", [PUFF, (slice(0, 10), slice(50, 60), slice(0, 80)), (slice(0, 100), slice(0, 60), slice(0, 80))]
)
def test_volumes_of_the_part_and_of_the_whole_are_the_same_file(tmp_path, where, shutter):
    """With any shutter, in the middle of the box, at its walls and all through it."""
    try:
        import_openvdb()
    except VolumeUnavailableError as error:
        pytest.skip(str(error))
    path = write(tmp_path / "a.h5", puff(where=where))
    part, arrays = read_compact(path, "plume"), read_frame(path).bodies["plume"].arrays
    fields = {key: arrays[key] for key in ("density", "temperature", "velocity")}
    whole = dataclasses.replace(part, **fields, first_cell=(0, 0, 0))
    for name, smoke in (("part", part), ("whole", whole)):
        write_volume(tmp_path / f"{name}.vdb", **vars(smoke), parameters=VolumeParameters(), fps=FPS, shutter=shutter)
    assert (tmp_path / "part.vdb").read_bytes() == (tmp_path / "whole.vdb").read_bytes()


def refused_by_all(path: Path, complaint: str) -> None:
    for read in (read_frame, validate_frame, lambda path: read_compact(path, "plume")):
        with pytest.raises(InvalidArtifactError, match=complaint):
            read(path)


@pytest.mark.parametrize(
    ("shape", "box", "complaint"),
    [
        ((1 << 20, 1 << 20, 64), None, "no smoke has a grid of shape"),
        ((100, 60), None, "no smoke has a grid of shape"),
        ((1000, 1000, 1000), None, "hardly any are stored"),
        (SHAPE, ((0, 0, 0), (100, 60, 81)), "leaves its grid"),
        (SHAPE, ((0, 20, 0), (100, 10, 80)), "leaves its grid"),
        (SHAPE, ((0, 0, 0), (100, 60, 80), (100, 60, 80)), "is no box of cells"),
        (SHAPE, ((0.0, 0.0, 0.0), (100.0, 60.0, float("nan"))), "is no box of cells"),
        (SHAPE, 3, "is no box of cells"),
    ],
)
def test_a_grid_that_no_smoke_has_is_refused_before_it_is_read(tmp_path, shape, box, complaint):
    """Empty space is not stored, so a small file may claim any size."""
    path = write(tmp_path / "frame.h5", puff())
    with h5py.File(path, "r+") as file:
        group = file["bodies/plume"]
        for key in ("density", "temperature", "velocity"):
            del group[key]
            components = (3,) if key == "velocity" else ()
            dataset = group.create_dataset(key, shape=(*shape, *components), dtype="f4", chunks=True)
            if box is not None:
                dataset.attrs["box"] = np.array(box)
    refused_by_all(path, complaint)


@pytest.mark.parametrize("key", ["density", "temperature", "velocity"])
def test_a_smoke_lacks_no_grid_and_all_are_of_one_shape(tmp_path, key):
    path = write(tmp_path / "frame.h5", puff())
    with h5py.File(path, "r+") as file:
        group = file["bodies/plume"]
        smaller = group[key][1:]
        del group[key]
    refused_by_all(path, f"no grid of {key}")
    with h5py.File(path, "r+") as file:
        file["bodies/plume"][key] = smaller
    refused_by_all(path, "differ in shape")
    with h5py.File(path, "r+") as file:
        del file["bodies/plume"][key]
        file["bodies/plume"].create_group(key)
    refused_by_all(path, f"no grid of {key}")


def test_a_smoke_may_have_other_arrays_beside_its_grids(tmp_path):
    path = write(tmp_path / "frame.h5", puff())
    with h5py.File(path, "r+") as file:
        file["bodies/plume"]["fuel"] = np.arange(5)
    validate_frame(path)
    assert read_frame(path).bodies["plume"].arrays["fuel"].tolist() == [0, 1, 2, 3, 4]
