"""Cloth through the pipeline: what is planned for it, and the mesh that Blender gets."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from checked_jobs import load_checked_job
from inline_tasks import run_task
from planned_jobs import LAYOUT, concerned, digests, first_of, planned

from pipeline.base.errors import MissingInputError
from pipeline.base.layout import JobLayout
from pipeline.job.inputs import keep_inputs
from pipeline.job.loading import read_job
from pipeline.kinds.cloth import CLOTH
from pipeline.kinds.elements import count_cloth_nodes, count_nodes
from pipeline.kinds.table import material_of
from pipeline.model.job import Job
from pipeline.run.events import Finished
from pipeline.stages.product import ProductStage
from pipeline.stages.render_scene import render_spec
from pipeline.store.cache import write_frame
from render.meshes import read_ply
from sim.cloth.sheet import build_sheet
from sim.core.snapshots import Snapshot
from sim.core.world import FrameReport

JOB_FILE = """\
name = "drape"
frames = 3
device = "cpu"
[[cloth]]
name = "sheet"
shape = { type = "rectangle", size = [0.4, 0.3], counts = [5, 4] }
position = [0.0, 0.0, 0.5]
"""
SHEET = {"name": "sheet", "shape": {"type": "rectangle", "size": (0.4, 0.3), "counts": (5, 4)}}
DRAPE = {"name": "drape", "frames": 3, "device": "cpu", "cloth": (SHEET,)}


def job(**changes) -> Job:
    return Job.model_validate(DRAPE | changes)


def test_every_frame_of_a_cloth_becomes_a_mesh_that_its_picture_waits_for():
    tasks = planned(job())
    assert tasks["cloth/sheet/000002"].inputs == ("cache/000002.h5",)
    assert tasks["render/000002"].inputs == ("cloths/sheet/000002.ply",)
    (drawn,) = render_spec(job(), LAYOUT).objects
    assert (drawn.type, drawn.file) == ("mesh_sequence", "cloths/sheet/{frame}.ply")


@pytest.mark.parametrize(
    ("change", "stages"),
    [
        ({"cloth": (SHEET | {"friction": 0.1},)}, {"simulate"}),
        ({"cloth": (SHEET | {"pin": ({"corner": "x-y-"},)},)}, {"simulate"}),
        ({"cloth": (SHEET | {"material": "silk"},)}, {"simulate", "render"}),
        ({"material": {"sheet": {"look": "denim"}}}, {"render"}),
        ({"material": {"sheet": {"look": "cotton", "thread_spacing": 0.002}}}, {"render"}),
    ],
    ids=["friction", "pin", "material", "look", "threads"],
)
def test_a_change_of_the_cloth_concerns_only_the_stages_that_read_it(change, stages):
    assert concerned(job(), job(**change)) == stages


@pytest.mark.parametrize("material", ["cotton", "silk", "denim", "rubber"])
def test_a_cloth_looks_like_what_it_is_made_of(material):
    assert material_of(job(cloth=(SHEET | {"material": material},)), "sheet").look == material


def with_mesh(folder: Path, *, width: float) -> Path:
    mesh = trimesh.Trimesh([[0, 0, 0], [width, 0, 0], [width, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    mesh.export(folder / "shawl.ply")
    path = folder / "drape.toml"
    path.write_text(JOB_FILE.replace('"rectangle", size = [0.4, 0.3], counts = [5, 4]', '"mesh", file = "shawl.ply"'))
    return path


def test_a_mesh_of_a_cloth_is_kept_with_the_job_and_counts_by_its_content(tmp_path):
    layout = JobLayout(tmp_path / "renders" / "drape")
    first, text = keep_inputs(read_job(with_mesh(tmp_path, width=1.0)), layout)
    (copy,) = layout.inputs.iterdir()
    assert f'file = "inputs/{copy.name}"' in text
    assert count_cloth_nodes(first) == 4
    digest = digests(read_job(with_mesh(tmp_path, width=1.0)).job)["simulate"]
    assert digests(first)["simulate"] == digest
    assert digests(read_job(with_mesh(tmp_path, width=2.0)).job)["simulate"] != digest


def test_nodes_of_a_mesh_are_counted_however_large_its_file_is(tmp_path):
    octagon = ["3 0", "6 0", "9 3", "9 6", "6 9", "3 9", "0 6", "0 3"]
    short = "".join(f"v {point} 0\n" for point in octagon) + "f 1 2 3 4 5 6 7 8\n"
    corners = [f"{float(x):.12f} {float(y):.12f}" for x, y in map(str.split, octagon)]
    long = "".join(f"v {corner} {0.0:.12f}\nvt {corner}\nvn 0 0 1\n" for corner in corners)
    long += "f " + " ".join(f"{n}/{n}/{n}" for n in range(1, 9)) + "\n"
    for name, text in (("short.obj", short), ("long.obj", long)):
        (tmp_path / name).write_text(text)
    trimesh.load_mesh(tmp_path / "short.obj").export(tmp_path / "soup.stl")  # three vertices a triangle
    for name in ("short.obj", "long.obj", "soup.stl"):
        shape = {"type": "mesh", "file": str(tmp_path / name)}
        cloth = job(cloth=({"name": "sheet", "shape": shape},)).cloth[0]
        assert count_nodes(cloth) == len(build_sheet(cloth.shape).vertices) == 8, name
    path = tmp_path / "short.obj"
    path.write_text(short.replace("f 1 2", "v 1 1 1\nf 1 2").replace(" 8\n", "\n"))
    assert count_nodes(job(cloth=({"name": "sheet", "shape": {"type": "mesh", "file": str(path)}},)).cloth[0]) == 7


@pytest.mark.parametrize("text", ["f 1 2 3\n", "v 0 0 0\n", "no mesh"])
def test_a_mesh_without_a_sheet_is_no_matter_of_the_plan_but_told(tmp_path, text):
    path = tmp_path / "shawl.obj"
    path.write_text(text)
    with pytest.raises(MissingInputError, match=r"shape\.file: .*shawl\.obj.*; the job needs it"):
        count_nodes(job(cloth=({"name": "sheet", "shape": {"type": "mesh", "file": str(path)}},)).cloth[0])
    path.unlink()
    with pytest.raises(MissingInputError, match="cannot read the mesh"):
        count_nodes(job(cloth=({"name": "sheet", "shape": {"type": "mesh", "file": str(path)}},)).cloth[0])


def test_memory_of_a_mesh_task_grows_with_the_nodes_of_its_cloth():
    def memory(counts: tuple[int, int]) -> int:
        shape = SHEET["shape"] | {"counts": counts}
        return first_of(job(cloth=(SHEET | {"shape": shape},)), "cloth").resources.memory_bytes

    small, large = memory((5, 4)), memory((2001, 2000))
    # Two triangles a node of 3 x 4 bytes, and position, velocity and normal: read, and written once more.
    assert large - small > 2 * (2 * 12 + 3 * 12) * 4_000_000
    assert small > 100_000_000  # the interpreter with its libraries


@pytest.mark.parametrize(
    ("written", "coarser"),
    [
        ("counts = [5, 4]", {"counts": (3, 3), "resolution": None}),
        ("resolution = 0.05", {"counts": None, "resolution": 0.1}),
    ],
)
def test_a_preview_has_cells_twice_as_large(written, coarser, tmp_path):
    path = tmp_path / "drape.toml"
    path.write_text(JOB_FILE.replace("counts = [5, 4]", written))
    shape = read_job(path, preview=True).job.cloth[0].shape
    assert {key: getattr(shape, key) for key in coarser} == coarser


@pytest.mark.parametrize(
    "place",
    [
        "index = [19]",
        # In a sheet of half as many cells no node starts here: the job would be refused.
        'region = { type = "sphere", position = [-0.1, 0.05, 0.5], radius = 0.01 }',
    ],
    ids=["number", "region"],
)
def test_a_preview_leaves_a_sheet_alone_of_which_it_would_pin_other_nodes(place, tmp_path):
    path = tmp_path / "drape.toml"
    path.write_text(f"{JOB_FILE}[[cloth.pin]]\n{place}\n")
    assert load_checked_job(path)[1].errors == load_checked_job(path, preview=True)[1].errors == []
    assert read_job(path, preview=True).job.cloth[0].shape.counts == (5, 4)


@pytest.fixture
def frame() -> dict[str, Snapshot]:
    """A sheet of four triangles, folded by a right angle along x = 0."""
    position = np.array([[0, 0, 1], [0, 2, 1], [1, 0, 1], [1, 2, 1], [0, 0, 0], [0, 2, 0]], np.float32)
    triangles = np.array([[0, 2, 3], [0, 3, 1], [4, 0, 1], [4, 1, 5]], np.int32)
    arrays = {
        "position": position,
        "velocity": position + 7,
        "triangles": triangles,
        "uv": np.array([[1, 0], [1, 2], [2, 0], [2, 2], [0, 0], [0, 2]], np.float32),
    }
    return {"sheet": Snapshot("cloth", arrays, {"thickness": 0.001})}


def test_the_mesh_has_the_frames_arrays_and_normals_of_its_own(frame, tmp_path):
    layout = JobLayout(tmp_path / "drape")
    layout.path(layout.frame_cache(0)).parent.mkdir(parents=True)
    layout.job_file.write_text(JOB_FILE)
    write_frame(layout.path(layout.frame_cache(0)), frame, FrameReport(0, 0.0, {}, {}, {}), device="cpu")
    task = ProductStage(CLOTH, CLOTH.product).plan(job(), layout)[0]
    assert isinstance(run_task(task, layout), Finished)
    mesh, given = read_ply(layout.path(layout.product("cloths", "sheet", 0, ".ply"))), frame["sheet"].arrays
    np.testing.assert_array_equal(mesh.vertices, given["position"])
    np.testing.assert_array_equal(mesh.faces, given["triangles"])
    np.testing.assert_array_equal(mesh.velocities, given["velocity"])
    np.testing.assert_array_equal(mesh.uv, given["uv"])
    # Up on the level half, along -x on the other; on the fold between, by the areas of the triangles that meet there.
    level, fold, fold_too, upright = mesh.normals[2], mesh.normals[0], mesh.normals[1], mesh.normals[4]
    np.testing.assert_allclose(level, [0, 0, 1], atol=1e-7)  # float32
    np.testing.assert_allclose(upright, [-1, 0, 0], atol=1e-7)
    np.testing.assert_allclose(fold, np.array([-1, 0, 2]) / np.sqrt(5), atol=1e-7)
    np.testing.assert_allclose(fold_too, np.array([-2, 0, 1]) / np.sqrt(5), atol=1e-7)
