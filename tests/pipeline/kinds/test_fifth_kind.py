"""A kind of body that the program has never heard of, brought in by one row: grains in free fall."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import pytest
from command_line import pipeline
from numpy.typing import NDArray
from places import HELPERS, PROJECT
from pydantic import Field

from pipeline.base.errors import PipelineError
from pipeline.base.layout import JobLayout
from pipeline.job.loading import load_job
from pipeline.kinds import table
from pipeline.kinds.base import Display, Kind, Product
from pipeline.model.job import Job
from pipeline.model.looks import BODY
from pipeline.model.problems import Findings
from pipeline.store.cache import read_frame
from pipeline.web.live.admission import live_job
from pipeline.web.serving import page_server
from pipeline.web.viewer.page import ViewPage
from render.bounds import reach_of_particles
from render.parameters import MaterialParameters
from render.point_clouds import PointCloud, validate_point_cloud, write_point_cloud
from render.spec import PointSequenceObject
from sim.core.parameters import Parameters, Positive, Vector3
from sim.core.snapshots import Snapshot
from sim.core.solver import Remedies
from sim.scene import SceneParameters


class GrainParameters(Parameters):
    """Grains that fall and meet nobody."""

    name: str
    position: Vector3 = Field(default=(0.0, 0.0, 0.0), description="Middle of the heap [m].")
    radius: Positive = Field(default=0.01, description="Radius of a grain [m].")
    side: int = Field(default=3, ge=1, description="Grains along each edge of the heap [-].")


class FreeFall:
    """x'' = g, by symplectic Euler."""

    def __init__(self, parameters: GrainParameters, gravity: Vector3) -> None:
        self.name, self._radius, self._gravity = parameters.name, parameters.radius, np.array(gravity)
        steps = (np.arange(parameters.side) - (parameters.side - 1) / 2) * 4.0 * parameters.radius
        lattice = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
        self._position, self._velocity = lattice + parameters.position, np.zeros_like(lattice)

    def stable_dt(self) -> float:
        return 1.0e-3

    def remedies(self) -> Remedies:
        return Remedies("weaker gravity", "none")

    def substep(self, dt: float) -> None:
        self._velocity = self._velocity + dt * self._gravity
        self._position = self._position + dt * self._velocity

    def snapshots(self) -> dict[str, Snapshot]:
        arrays = {"position": self._position.astype(np.float32), "velocity": self._velocity.astype(np.float32)}
        return {self.name: Snapshot("grain", arrays, {"radius": self._radius})}

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        return {"position": self._position, "velocity": self._velocity}

    def restore(self, arrays: Any) -> None:
        self._position, self._velocity = np.array(arrays["position"]), np.array(arrays["velocity"])

    def diagnostics(self) -> dict[str, float]:
        return {"particle_count": float(len(self._position))}

    def begin_frame(self, time_s: float) -> None:
        pass

    def first_bad_quantity(self) -> str | None:
        return None if np.isfinite(self._position).all() else "position is not finite"


def count(_job: Job, grain: GrainParameters) -> float:
    return grain.side**3


def check(job: Job, _solids: object, _budget: object, findings: Findings) -> int:
    for index, grain in enumerate(GRAIN.bodies(job)):
        if grain.position[2] < job.domain.min[2]:
            findings.error(("grain", index, "position"), "is below the domain")
    return sum(int(count(job, grain)) for grain in GRAIN.bodies(job))


def write_points(path: Path, grains: Snapshot, _job: Job, _threads: int) -> None:
    n = len(grains.arrays["position"])
    radius, alive = np.full(n, grains.number("radius"), np.float32), np.ones(n, np.float32)
    position, velocity = grains.arrays["position"], grains.arrays["velocity"]
    write_point_cloud(path, PointCloud(position, velocity, radius, alive, np.zeros(n, np.uint8)))


def objects(_job: Job, _layout: JobLayout, grain: GrainParameters, material_of: Any) -> Iterator[PointSequenceObject]:
    file = f"grains/{grain.name}/{{frame}}.ply"
    yield PointSequenceObject(name=grain.name, file=file, kind="spray", material=material_of(BODY))


def reach(_job: Job, _layout: JobLayout, _grain: GrainParameters, group: h5py.Group) -> Any:
    return reach_of_particles(group["position"][()], float(group.attrs["radius"]))


def solvers(scene: SceneParameters, _fps: float) -> list[FreeFall]:
    return [FreeFall(grain, scene.gravity) for grain in GRAIN.bodies(scene)]


GRAIN = Kind(
    name="grain",
    parameters=GrainParameters,
    about="Grains in free fall.",
    size="{:,} grains",
    elements=count,
    snapshot_bytes=(24.0, 24.0, 48.0),
    material=lambda _grain: {BODY: MaterialParameters(look="plastic", color=(0.9, 0.1, 0.05))},
    check=check,
    coarser=lambda job, _factor, _: [(("grain", k, "side"), 1) for k in range(len(GRAIN.bodies(job)))],
    solvers=solvers,
    product=Product(
        stage="grains",
        version=1,
        folder="grains",
        suffix=".ply",
        tools=lambda _job: {},
        parameters=lambda _job, _body: {},
        memory_bytes=lambda job, grain: 100_000_000 + int(100 * count(job, grain)),
        write=write_points,
        validate=validate_point_cloud,
        file_bytes=lambda _grains, count: 33.0 * count,
    ),
    objects=objects,
    reach=reach,
    display=Display("Grains", "points"),
    facts=lambda grain, _count: f"grains of radius {grain.radius:g} m",
)

JOB = """\
name = "sandfall"
frames = {frames}
device = "cpu"

[[grain]]
name = "sand"
position = [0.0, 0.0, 0.6]
radius = 0.08

[render]
resolution = [64, 36]
quality = "draft"
samples = 4
"""

FRAMES = 4


@pytest.fixture(scope="module", autouse=True)
def registered() -> Iterator[None]:
    table.register(GRAIN)
    yield
    del table.KINDS["grain"]


def written(folder: Path, frames: int = FRAMES) -> Path:
    path = folder / "sandfall.toml"
    path.write_text(JOB.format(frames=frames))
    return path


def submit(folder: Path, frames: int = FRAMES) -> JobLayout:
    """Run the command line in a process of its own, which learns of the kind from this module."""
    arguments = ["submit", str(written(folder, frames)), "--farm", str(folder / "renders"), "--executor", "inline"]
    script = (
        "from test_fifth_kind import GRAIN, table\n"
        "from pipeline.cli.main import main\n"
        f"table.register(GRAIN)\nmain({arguments})\n"
    )
    paths = os.pathsep.join([str(PROJECT), str(HELPERS), str(Path(__file__).parent)])
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
    return JobLayout(folder / "renders" / "sandfall")


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> JobLayout:
    """The film of the grains."""
    return submit(tmp_path_factory.mktemp("film"))


def test_a_name_that_the_job_file_has_already_is_refused():
    with pytest.raises(ValueError, match='"render" is a key of the job file already'):
        table.register(Kind(**{**vars(GRAIN), "name": "render"}))


def test_the_job_file_has_its_table_and_its_keys(tmp_path):
    path = written(tmp_path)
    path.write_text(path.read_text().replace("radius =", "radios ="))
    told = pipeline("check", path)
    assert told.exit_code == 2
    assert 'grain[0].radios: unknown key "radios"; did you mean "radius"?' in told.output


def test_its_bodies_are_checked_and_counted(tmp_path):
    path = written(tmp_path)
    assert "27 grains" in pipeline("check", path).output
    assert "1 grains" in pipeline("check", path, "--preview").output
    told = pipeline("check", path, "--set", "grain.sand.position=[0,0,-1]")
    assert told.exit_code == 2
    assert "grain[0].position: is below the domain" in told.output


def test_its_frames_are_in_the_cache_where_physics_puts_them(film):
    fallen = [read_frame(film.path(film.frame_cache(k)), "sand").bodies["sand"].arrays for k in (0, FRAMES - 1)]
    time_s = (FRAMES - 1) / 60.0
    drop = fallen[0]["position"][:, 2] - fallen[1]["position"][:, 2]
    # Symplectic Euler is ahead of g t²/2 by g t dt/2, with steps of a millisecond at most.
    assert np.allclose(drop, 0.5 * 9.81 * time_s**2, atol=0.5 * 9.81 * time_s * 1.0e-3 + 1.0e-6)


def test_a_film_that_went_on_is_as_one_made_at_once(film, tmp_path):
    submit(tmp_path, frames=2)
    layout = submit(tmp_path)
    for artifact in (film.frame_cache(FRAMES - 1), film.product("grains", "sand", FRAMES - 1, ".ply")):
        assert layout.path(artifact).read_bytes() == film.path(artifact).read_bytes()


def test_it_is_in_the_pictures(film):
    with av.open(str(film.path(film.movie()))) as movie:
        assert sum(1 for _ in movie.decode(video=0)) == FRAMES
    with av.open(str(film.path(film.picture(1)))) as picture:
        red, green, blue = next(picture.decode(video=0)).to_ndarray(format="rgb24").astype(int).transpose(2, 0, 1)
    assert np.count_nonzero((red > 2 * green) & (red > 2 * blue)) > 20


def test_the_viewer_shows_it_where_the_cache_has_it(film):
    with page_server() as server:
        page = ViewPage(server, film, most_particles=10_000, most_bytes=10**8)
        for frame in (0, FRAMES - 1):
            page.playback.seek(frame)
            page.advance(0.0)
            drawn = server.scene.get_handle_by_name("/grain/sand")
            cached = read_frame(film.path(film.frame_cache(frame)), "sand").bodies["sand"]
            np.testing.assert_allclose(drawn.points + drawn.position, cached.arrays["position"], atol=1.0e-3)
            assert drawn.point_size == 2.0 * cached.number("radius")
        assert "Grains" in page.controls._layers
        assert "speed" in page.controls._color_by.options
        page.controls._layers["Grains"].value = False
        page.advance(0.0)
        assert "/grain/sand" not in page.canvas.names


def test_it_does_not_run_live(tmp_path):
    with pytest.raises(PipelineError, match="sandfall: grain does not run live"):
        live_job(load_job(written(tmp_path)))


def test_the_report_tells_of_it(film):
    assert "grains of radius 0.08 m" in film.report.read_text(encoding="utf-8")
