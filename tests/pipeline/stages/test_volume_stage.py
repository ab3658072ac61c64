"""Smoke from the cache to OpenVDB: the same cells in the same places, and a clear line where that is impossible."""

from pathlib import Path

import numpy as np
import pytest
from inline_tasks import run_task
from read_volumes import read_volume

from pipeline.base.layout import JobLayout
from pipeline.kinds.smoke import SMOKE
from pipeline.model.job import Job
from pipeline.run.events import Failed, Finished, TaskEvent
from pipeline.stages.product import ProductStage
from pipeline.store.cache import write_frame
from render.errors import VolumeUnavailableError
from render.volume import import_openvdb
from sim.core.snapshots import Snapshot
from sim.core.world import FrameReport

try:
    import_openvdb()
except VolumeUnavailableError as error:
    pytestmark = pytest.mark.skip(reason=str(error))

SHAPE = (40, 44, 36)
FILLED = (slice(33, 38), slice(5, 9), slice(20, 31))
CELL_SIZE = 0.05
JOB_FILE = """\
name = "puff"
frames = 2
fps = 60
device = "cpu"
[domain]
min = [-1.0, -1.1, 0.0]
max = [1.0, 1.1, 1.8]
[[smoke]]
name = "plume"
cell_size = 0.05
[[smoke.source]]
shape = { type = "sphere", radius = 0.2 }
position = [0.0, 0.0, 0.5]
"""


@pytest.fixture
def layout(tmp_path: Path) -> JobLayout:
    layout = JobLayout(tmp_path / "puff")
    layout.path(layout.frame_cache(1)).parent.mkdir(parents=True)
    layout.job_file.write_text(JOB_FILE)
    return layout


def puff() -> Snapshot:
    random = np.random.default_rng(5)
    density = np.zeros(SHAPE, np.float32)
    density[FILLED] = random.uniform(0.1, 1.0, density[FILLED].shape)
    arrays = {
        "density": density,
        "temperature": 300.0 + 500.0 * density,
        "velocity": random.uniform(-1.0, 1.0, (*SHAPE, 3)).astype(np.float32),
    }
    return Snapshot(
        "smoke", arrays, {"origin": (-1.0, -1.1, 0.0), "cell_size": CELL_SIZE, "ambient_temperature": 300.0}
    )


def volume_of(layout: JobLayout, smoke: Snapshot, *, longest_shutter_s: float | None) -> TaskEvent:
    """Write frame 1 to the cache and run its task."""
    report = FrameReport(1, 1 / 60, {}, {}, {})
    write_frame(
        layout.path(layout.frame_cache(1)), {"plume": smoke}, report, device="cpu", longest_shutter_s=longest_shutter_s
    )
    job = Job.model_validate(
        {
            "name": "puff",
            "frames": 2,
            "smoke": ({"name": "plume", "source": ({"shape": {"type": "sphere", "radius": 0.2}},)},),
        }
    )
    return run_task(ProductStage(SMOKE, SMOKE.product).plan(job, layout)[1], layout)


def test_a_volume_holds_what_the_cache_holds_where_it_is(layout):
    smoke = puff()
    assert isinstance(volume_of(layout, smoke, longest_shutter_s=1 / 60), Finished)
    volume = read_volume(layout.path(layout.product("volumes", "plume", 1, ".vdb")), SHAPE)
    arrays = smoke.arrays
    # The cache rounds to 11 bits, and so do 16-bit floats, which changes nothing more.
    np.testing.assert_allclose(volume.density, arrays["density"], rtol=2.0**-11)
    # 1/8 K from the cache, and 2^-11 of up to 500 K above ambient from the volume.
    np.testing.assert_allclose(volume.temperature, arrays["temperature"] - 300.0, rtol=2.0**-11, atol=0.126)
    # Half of a 64th of a cell a frame from the cache, and 2^-11 of 1 m/s from the volume.
    error = np.abs(volume.velocity - arrays["velocity"])[FILLED]
    assert error.max() <= 0.5 * CELL_SIZE * 60 / 64 + 2.0**-11
    assert volume.centre == pytest.approx((-0.975, -1.075, 0.025), abs=1e-12)


def test_a_window_of_a_smoke_lies_where_it_is_and_takes_the_room_of_its_own(layout):
    """Whatever part of the box is computed, voxels are where the smoke is, and nothing else is in the files."""
    whole = puff()
    first = (24, 0, 16)
    own = {name: np.ascontiguousarray(array[24:, :16, 16:]) for name, array in whole.arrays.items()}
    x, y, z = (low + n * CELL_SIZE for low, n in zip((-1.0, -1.1, 0.0), first, strict=True))
    window = Snapshot("smoke", own, {**whole.attributes, "origin": (x, y, z)})
    places, sizes = [], []
    for smoke in (whole, window):
        assert isinstance(volume_of(layout, smoke, longest_shutter_s=1 / 60), Finished)
        path = layout.path(layout.product("volumes", "plume", 1, ".vdb"))
        (grid,) = (each for each in import_openvdb().readAll(str(path))[0] if each.name == "density")
        voxels = {
            tuple(np.round(grid.transform.indexToWorld(each.min), 9)): each.value for each in grid.citerOnValues()
        }
        places.append(voxels)
        sizes.append(layout.path(layout.frame_cache(1)).stat().st_size)
        path.unlink()
    assert places[0] == places[1]
    assert len(places[0]) == 5 * 4 * 11
    assert sizes[1] < 1.02 * sizes[0]


@pytest.mark.parametrize("field", ["density", "temperature", "velocity"])
def test_values_that_are_not_finite_are_refused_with_frame_field_and_cell(layout, field):
    """They do not come out of the simulation; a frame may be from elsewhere."""
    smoke = puff()
    smoke.arrays[field][34, 6, 21] = np.nan
    failed = volume_of(layout, smoke, longest_shutter_s=None)
    assert isinstance(failed, Failed)
    cached = layout.path(layout.frame_cache(1))
    assert f'{cached}: smoke "plume": {field} of cell (34, 6, 21) is not finite' in failed.message
    assert not layout.path(layout.product("volumes", "plume", 1, ".vdb")).exists()
