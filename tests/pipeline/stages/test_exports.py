"""Exports, read by the libraries of the programs that they are for."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import viewed_job
from exported_jobs import FRAMES, simulated
from films import Studio
from inline_tasks import run_task
from places import PROJECT

from pipeline.job.loading import load_job
from pipeline.run.events import Finished
from pipeline.run.goal import read_goal
from pipeline.stages import EXPORTS
from pipeline.store.cache import read_frame
from render.errors import InvalidFileError
from render.gltf_files import read_glb
from render.meshes import read_ply
from render.pictures import read_picture
from render.point_clouds import KINDS, read_point_cloud
from render.usd_files import validate_usd
from render.vtk_files import validate_vtk

pytestmark = pytest.mark.slow

LAST = FRAMES - 1


@pytest.fixture(scope="module")
def studio(tmp_path_factory) -> Studio:
    return simulated(tmp_path_factory.mktemp("studio"))


@pytest.fixture(scope="module")
def vtk(studio) -> Studio:
    studio.run("export", "tiny", "--to", "vtk").assert_code(0)
    return studio


@pytest.fixture(scope="module")
def usd(studio) -> Studio:
    studio.run("export", "tiny", "--to", "usd").assert_code(0)
    return studio


@pytest.fixture(scope="module")
def blend(studio) -> Studio:
    studio.run("export", "tiny", "--to", "blend").assert_code(0)
    return studio


def cached(studio: Studio, body: str, frame: int) -> Any:
    return read_frame(studio.layout.path(studio.layout.frame_cache(frame)), body).bodies[body]


def surface(studio: Studio, frame: int) -> Any:
    return read_ply(studio.layout.path(studio.layout.surface("water", frame)))


def whitewater(studio: Studio, frame: int) -> Any:
    return read_point_cloud(studio.layout.path(studio.layout.whitewater("water", frame)))


# --- ParaView ---


def blocks_of(path: Path) -> dict[str, Any]:
    from vtkmodules.vtkIOXML import vtkXMLMultiBlockDataReader

    reader = vtkXMLMultiBlockDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    frame = reader.GetOutput()
    names = [frame.GetMetaData(index).Get(frame.NAME()) for index in range(frame.GetNumberOfBlocks())]
    return {name: frame.GetBlock(index) for index, name in enumerate(names)}


def array(data: Any, name: str) -> np.ndarray:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    return vtk_to_numpy(data.GetArray(name))


def points(block: Any) -> np.ndarray:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    return vtk_to_numpy(block.GetPoints().GetData())


def test_vtk_reads_what_the_cache_has(vtk):
    blocks = blocks_of(vtk.layout.root / f"vtk/{LAST:06d}.vtm")
    names = {"ball", "duck", "water", "water.surface", "water.drops", "water.whitewater", "sheet", "plume", "sparks"}
    assert blocks.keys() == names
    for body in ("water", "sheet"):
        there = cached(vtk, body, LAST).arrays
        np.testing.assert_array_equal(points(blocks[body]), there["position"])
        np.testing.assert_array_equal(array(blocks[body].GetPointData(), "velocity"), there["velocity"])
    mesh, cloud = surface(vtk, LAST), whitewater(vtk, LAST)
    assert blocks["water.surface"].GetNumberOfCells() == len(mesh.faces)
    np.testing.assert_array_equal(array(blocks["water.surface"].GetPointData(), "velocity"), mesh.velocities)
    np.testing.assert_array_equal(array(blocks["water.whitewater"].GetPointData(), "kind"), cloud.kind)
    sparks = cached(vtk, "sparks", LAST).arrays
    assert len(sparks["temperature"]) > 20
    np.testing.assert_array_equal(points(blocks["sparks"]), sparks["position"])
    np.testing.assert_array_equal(array(blocks["sparks"].GetPointData(), "temperature"), sparks["temperature"])


def test_vtk_reads_drops_with_radii_and_dye_of_the_surface(tmp_path):
    layout = viewed_job.submitted(tmp_path / "job")
    receipt = viewed_job.commit(layout, 0)
    viewed_job.commit_surface(layout, receipt, 0, dye=[0.0, 0.25, 1.0])
    viewed_job.commit_spray(layout, receipt, 0)
    viewed_job.commit_drops(layout, receipt, 0)
    task, *_ = EXPORTS["vtk"].plan(load_job(layout.job_file), layout)
    assert isinstance(run_task(task, layout), Finished)
    blocks = blocks_of(layout.root / "vtk/000000.vtm")
    drops = read_point_cloud(layout.path(layout.drops("water", 0)))
    assert len(drops.radius) == 30
    np.testing.assert_array_equal(points(blocks["water.drops"]), drops.position)
    np.testing.assert_array_equal(array(blocks["water.drops"].GetPointData(), "radius"), drops.radius)
    np.testing.assert_array_equal(array(blocks["water.drops"].GetPointData(), "velocity"), drops.velocity)
    assert array(blocks["water.surface"].GetPointData(), "dye").tolist() == [0.0, 0.25, 1.0]


JELLY = """
name = "tiny"
frames = 1
device = "cpu"

[domain]
min = [-0.5, -0.5, 0.0]
max = [0.5, 0.5, 1.0]

[[soft]]
name = "lump"
material = "jelly"
cell_size = 0.05
block = [{ shape = { type = "box", size = [0.2, 0.2, 0.2] }, position = [0.0, 0.0, 0.1] }]
"""


def test_vtk_reads_the_surface_of_soft_matter(tmp_path):
    studio = Studio.open(tmp_path, JELLY)
    studio.submit("--until", "soft")
    studio.run("export", "tiny", "--to", "vtk").assert_code(0)
    blocks = blocks_of(studio.layout.root / "vtk/000000.vtm")
    assert blocks.keys() == {"lump", "lump.surface"}
    mesh = read_ply(studio.layout.root / "soft/lump/000000.ply")
    assert blocks["lump.surface"].GetNumberOfCells() == len(mesh.faces) > 100
    np.testing.assert_array_equal(points(blocks["lump.surface"]), mesh.vertices)
    np.testing.assert_array_equal(array(blocks["lump.surface"].GetPointData(), "velocity"), mesh.velocities)


def test_vtk_reads_the_grid_of_smoke_with_x_first(vtk):
    block = blocks_of(vtk.layout.root / f"vtk/{LAST:06d}.vtm")["plume"]
    smoke = cached(vtk, "plume", LAST)
    i0, i1, j0, j1, k0, k1 = block.GetExtent()
    box = (slice(i0, i1), slice(j0, j1), slice(k0, k1))
    np.testing.assert_allclose(block.GetOrigin(), smoke.attributes["origin"])
    np.testing.assert_allclose(block.GetSpacing(), [smoke.attributes["cell_size"]] * 3)
    shape = smoke.arrays["density"][box].shape
    for name in ("density", "temperature", "velocity"):
        own = smoke.arrays[name][box]
        there = array(block.GetCellData(), name).reshape(*shape[::-1], *own.shape[3:])
        np.testing.assert_array_equal(there.swapaxes(0, 2), own)


def test_vtk_reads_units_and_times(vtk):
    from vtkmodules.vtkCommonCore import vtkDataArray

    blocks = blocks_of(vtk.layout.root / f"vtk/{LAST:06d}.vtm")

    def unit(values: Any) -> str:
        return values.GetInformation().Get(vtkDataArray.UNITS_LABEL())

    units = {name: unit(blocks["water"].GetPointData().GetArray(name)) for name in ("velocity", "density", "pressure")}
    assert units == {"velocity": "m/s", "density": "kg/m3", "pressure": "Pa"}
    assert unit(blocks["plume"].GetCellData().GetArray("temperature")) == "K"
    assert array(blocks["water"].GetFieldData(), "TimeValue") == pytest.approx([LAST / 60])


def test_vtk_has_bodies_where_they_are(vtk):
    block = blocks_of(vtk.layout.root / f"vtk/{LAST:06d}.vtm")["ball"]
    pose = cached(vtk, "ball", LAST).arrays
    np.testing.assert_allclose(points(block).mean(axis=0), pose["position"], atol=1e-4)
    speeds = array(block.GetPointData(), "velocity")
    np.testing.assert_allclose(speeds.mean(axis=0), pose["velocity"], atol=1e-3)


@pytest.mark.parametrize("place", [0.3, 0.6, 0.95])
def test_a_damaged_vtk_file_is_refused(vtk, tmp_path, place):
    content = bytearray((vtk.layout.root / f"vtk/water/{LAST:06d}.vtp").read_bytes())
    path = tmp_path / "damaged.vtp"
    path.write_bytes(content[: int(place * len(content))])
    with pytest.raises(InvalidFileError):
        validate_vtk(path)


# --- USD ---


def test_usd_is_in_metres_z_up_and_passes_its_own_validators(usd):
    from pxr import Usd, UsdGeom, UsdValidation

    stage = Usd.Stage.Open(str(usd.layout.root / "tiny.usd"))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, LAST, 60)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [each.GetErrorAsString() for each in errors] == []


def test_usd_plays_what_the_cache_has(usd):
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(usd.layout.root / "tiny.usd"))
    for frame in (0, LAST):
        mesh, made = surface(usd, frame), UsdGeom.Mesh.Get(stage, "/World/water")
        np.testing.assert_array_equal(np.array(made.GetPointsAttr().Get(frame)), mesh.vertices)
        np.testing.assert_array_equal(np.array(made.GetVelocitiesAttr().Get(frame)), mesh.velocities)
        indices = made.GetFaceVertexIndicesAttr().Get(frame)
        np.testing.assert_array_equal(np.array(indices), mesh.faces.ravel())
        assert UsdGeom.Mesh.ValidateTopology(indices, made.GetFaceVertexCountsAttr().Get(frame), len(mesh.vertices))[0]
        sheet, cloth = UsdGeom.Mesh.Get(stage, "/World/sheet"), cached(usd, "sheet", frame).arrays
        np.testing.assert_array_equal(np.array(sheet.GetPointsAttr().Get(frame)), cloth["position"])
        np.testing.assert_array_equal(np.array(sheet.GetVelocitiesAttr().Get(frame)), cloth["velocity"])
        cloud = whitewater(usd, frame)
        spray = UsdGeom.Points.Get(stage, "/World/water_spray")
        is_spray = cloud.kind == KINDS.index("spray")
        assert len(spray.GetPointsAttr().Get(frame)) == is_spray.sum()
        assert (np.array(spray.GetWidthsAttr().Get(frame)) <= 2.0 * cloud.radius[is_spray] + 1e-9).all()


def test_usd_moves_bodies_and_names_volumes_by_relative_paths(usd):
    from pxr import Usd, UsdGeom, UsdShade, UsdVol

    stage = Usd.Stage.Open(str(usd.layout.root / "tiny.usd"))
    ball = UsdGeom.Xformable.Get(stage, "/World/ball")
    for frame in range(FRAMES):
        place = ball.ComputeLocalToWorldTransform(frame).ExtractTranslation()
        np.testing.assert_allclose(place, cached(usd, "ball", frame).arrays["position"], atol=1e-6)
    assert UsdGeom.Mesh(ball).GetPointsAttr().GetNumTimeSamples() == 0  # its mesh is there once
    file = UsdVol.OpenVDBAsset.Get(stage, "/World/plume/density").GetFilePathAttr().Get(LAST)
    assert file.path == f"./volumes/plume/{LAST:06d}.vdb"
    assert Path(file.resolvedPath).is_file()
    material, _ = UsdShade.MaterialBindingAPI(ball).ComputeBoundMaterial()
    assert material.ComputeSurfaceSource()[0].GetIdAttr().Get() == "UsdPreviewSurface"


def test_after_an_export_what_is_asked_of_a_job_is_its_film_again(usd):
    assert not any(end.startswith("export-") for end in read_goal(usd.layout))


def test_tasks_and_files_of_every_export_are_explained_whichever_was_the_last(usd):
    usd.run("export", "tiny", "--to", "vtk", "--frames", "0-1").assert_code(0)
    for task in (f"export-usd/{LAST:06d}", "export-vtk/000001", f"usd/{LAST:06d}.usdc", "tiny.usd"):
        told = usd.run("explain", "tiny", task).assert_code(0).out
        assert "up to date" in told.partition("\n")[0], told
    usd.run("explain", "tiny", "export-gltf").assert_code(1)


def test_the_same_usd_has_the_same_bytes(usd):
    names = ["tiny.usd", "usd/manifest.usda", f"usd/{LAST:06d}.usdc"]
    before = [(usd.layout.root / name).read_bytes() for name in names]
    usd.run("rerun", "tiny", "--stage", "export-usd").assert_code(0)
    assert [(usd.layout.root / name).read_bytes() for name in names] == before


def test_a_truncated_usd_layer_is_refused(usd, tmp_path):
    content = (usd.layout.root / f"usd/{LAST:06d}.usdc").read_bytes()
    path = tmp_path / "damaged.usdc"
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(InvalidFileError):
        validate_usd(path)


# --- Blender ---

DRAW = """
import sys, bpy
file, frame, picture = sys.argv[1:]
bpy.ops.wm.open_mainfile(filepath=file)
bpy.context.scene.frame_set(int(frame))
bpy.context.scene.render.image_settings.file_format = "PNG"
bpy.context.scene.render.filepath = picture
bpy.ops.render.render(write_still=True)
"""


def test_the_blend_file_given_away_draws_the_films_frame(blend, tmp_path):
    target = tmp_path / "given"
    blend.run("export", "tiny", "--to", "blend", "-o", str(target)).assert_code(0)
    blend.submit("--until", f"render:{LAST}")
    own = blend.layout.path(blend.layout.picture(LAST))
    assert not blend.layout.path(blend.layout.picture(0)).exists()
    picture = tmp_path / "blend.png"
    argv = [sys.executable, "-c", DRAW, str(target / "tiny.blend"), str(LAST), str(picture)]
    subprocess.run(argv, check=True, capture_output=True, cwd=PROJECT)
    film, drawn = (read_picture(path)[..., :3].astype(float) / 255.0 for path in (own, picture))
    # Measured 0.0003: normals of imported surfaces are rounded. Without the whitewater it is 0.01.
    assert np.abs(film - drawn).mean() < 0.002


def test_alembic_has_what_the_cache_has(studio, tmp_path):
    """Blender's reader is the only one of Alembic that has a package; positions are y up in the file."""
    studio.run("export", "tiny", "--to", "abc").assert_code(0)
    script = """
import json, sys, bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = 60
bpy.ops.wm.alembic_import(filepath=sys.argv[1], set_frame_range=True, as_background_job=False)
scene = bpy.context.scene
scene.frame_set(int(sys.argv[2]))
graph, told = bpy.context.evaluated_depsgraph_get(), {"": [scene.frame_start, scene.frame_end]}
for each in bpy.data.objects:
    if each.type == "MESH":
        made = each.evaluated_get(graph)
        velocity = made.data.attributes.get("velocity")
        told[each.name] = [
            [list(made.matrix_world @ vertex.co) for vertex in made.data.vertices],
            [list(row.vector) for row in velocity.data] if velocity else None,
        ]
print("TOLD", json.dumps(told))
"""
    argv = [sys.executable, "-c", script, str(studio.layout.root / "tiny.abc"), str(LAST)]
    printed = subprocess.run(argv, check=True, capture_output=True, text=True, cwd=PROJECT).stdout
    told = json.loads(next(line for line in printed.splitlines() if line.startswith("TOLD "))[5:])
    assert told[""] == [0, LAST]
    mesh, cloth, cloud = surface(studio, LAST), cached(studio, "sheet", LAST).arrays, whitewater(studio, LAST)
    np.testing.assert_allclose(told["water"][0], mesh.vertices, atol=1e-6)
    np.testing.assert_allclose(told["water"][1], mesh.velocities, atol=1e-5)
    np.testing.assert_allclose(told["sheet"][0], cloth["position"], atol=1e-6)
    np.testing.assert_allclose(told["sheet"][1], cloth["velocity"], atol=1e-5)
    pose = cached(studio, "ball", LAST).arrays
    np.testing.assert_allclose(np.mean(told["ball"][0], axis=0), pose["position"], atol=1e-4)
    assert len(told["water_foam"][0]) == (cloud.kind == KINDS.index("foam")).sum()


# --- the web ---


@pytest.fixture(scope="module")
def gltf(studio) -> Path:
    ended = studio.run("export", "tiny", "--to", "gltf").assert_code(0)
    assert "left out" in ended.out and "smoke (plume), drops (water), whitewater (water)" in ended.out
    return studio.layout.root / "tiny.glb"


def test_a_reader_of_gltf_finds_metres_y_up_and_every_face(studio, gltf):
    import trimesh

    scene = trimesh.load_scene(gltf)
    for frame in range(FRAMES):
        mesh, read = surface(studio, frame), scene.geometry[f"water.{frame}"]
        assert len(read.faces) == len(mesh.faces)
        np.testing.assert_array_equal(read.vertices, mesh.vertices[:, [0, 2, 1]] * np.float32([1, 1, -1]))
    assert len(scene.geometry["sheet"].vertices) == len(cached(studio, "sheet", 0).arrays["position"])
    place = scene.graph.get("ball")[0][:3, 3]
    np.testing.assert_allclose(place, cached(studio, "ball", 0).arrays["position"][[0, 2, 1]] * [1, 1, -1], atol=1e-6)
    np.testing.assert_allclose(np.ptp(scene.geometry["ball"].vertices, axis=0), 0.16, rtol=0.02)  # 8 cm of radius
    assert not np.allclose(scene.geometry["ball"].vertex_normals, 0.0)


GLTF_AT = """
import json, sys, bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = 60
bpy.ops.import_scene.gltf(filepath=sys.argv[1])
scene, told = bpy.context.scene, {}
for moment in map(float, sys.argv[2:]):
    scene.frame_set(int(moment), subframe=moment % 1)
    graph, found = bpy.context.evaluated_depsgraph_get(), {}
    for each in bpy.data.objects:
        made = each.evaluated_get(graph)
        if each.type == "MESH" and max(made.matrix_world.to_scale()) > 0.5:
            found[each.name] = [list(made.matrix_world @ vertex.co) for vertex in made.data.vertices]
        elif each.type == "CAMERA":
            found[each.name] = [list(row) for row in made.matrix_world]
    told[moment] = found
glass = bpy.data.materials["water"].node_tree.nodes["Principled BSDF"].inputs
told["water"] = [glass["Transmission Weight"].default_value, glass["IOR"].default_value]
told["angle"] = bpy.data.cameras[0].angle_y
print("TOLD", json.dumps(told))
"""


def test_blender_plays_the_gltf_as_the_cache_has_it(studio, gltf):
    argv = [sys.executable, "-c", GLTF_AT, str(gltf), "0", str(LAST), str(LAST - 0.5)]
    printed = subprocess.run(argv, check=True, capture_output=True, text=True, cwd=PROJECT).stdout
    told = json.loads(next(line for line in printed.splitlines() if line.startswith("TOLD "))[5:])
    domain = load_job(studio.layout.job_file).domain
    assert told["water"] == pytest.approx([1.0, 1.33])
    assert told["angle"] == pytest.approx(2.0 * np.arctan(18.0 / 50.0 * 54 / 96), abs=1e-4)
    for frame in (0, LAST):
        found = told[f"{float(frame)}"]
        assert {name for name in found if name.startswith("water")} == {f"water.{frame}"}  # one surface at a time
        np.testing.assert_allclose(found[f"water.{frame}"], surface(studio, frame).vertices, atol=1e-6)
        np.testing.assert_allclose(found["sheet"], cached(studio, "sheet", frame).arrays["position"], atol=1e-5)
        pose = cached(studio, "ball", frame).arrays
        ball = np.asarray(found["ball"])
        np.testing.assert_allclose((ball.min(axis=0) + ball.max(axis=0)) / 2, pose["position"], atol=2e-3)
        camera = np.asarray(found["camera"])
        np.testing.assert_allclose(camera[:3, 3], [0.7, -1.2, 0.7], atol=1e-6)
        aim = np.mean([domain.min, domain.max], axis=0) - camera[:3, 3]
        np.testing.assert_allclose(-camera[:3, 2], aim / np.linalg.norm(aim), atol=1e-5)
    between = told[f"{LAST - 0.5}"]
    assert f"water.{LAST - 1}" in between  # it stays until the next one
    halves = [cached(studio, "sheet", frame).arrays["position"] for frame in (LAST - 1, LAST)]
    np.testing.assert_allclose(between["sheet"], np.mean(halves, axis=0), atol=1e-5)


def test_gltf_of_some_frames_keeps_their_times_and_its_bytes(studio, gltf):
    before = gltf.read_bytes()
    ended = studio.run("export", "tiny", "--to", "gltf", "--frames", f"1-{LAST}x2").assert_code(0)
    assert f"2 frames (1-{LAST}x2)" in ended.out
    document, arrays = read_glb(gltf.read_bytes())
    ends = [arrays[each["input"]][-1] for each in document["animations"][0]["samplers"]]
    assert max(ends) == pytest.approx((LAST - 1) / 60)
    studio.run("export", "tiny", "--to", "gltf").assert_code(0)
    assert gltf.read_bytes() == before


# --- exports as stages ---


def test_an_export_is_made_once_and_frames_can_be_chosen(vtk):
    vtk.run("export", "tiny", "--to", "vtk").assert_code(0)  # of the tasks on record, too
    before = vtk.attempts()
    ended = vtk.run("export", "tiny", "--to", "vtk").assert_code(0)
    assert "up to date" in ended.out
    assert vtk.tasks_run_since(before) == set()
    ended = vtk.run("export", "tiny", "--to", "vtk", "--frames", "1-2").assert_code(0)
    assert "2 frames (1-2)" in ended.out
    assert vtk.tasks_run_since(before) == {"export-vtk/series"}
    series = (vtk.layout.root / "tiny.pvd").read_text()
    assert [f"{frame:06d}.vtm" in series for frame in range(FRAMES)] == [False, True, True, False]
    vtk.run("export", "tiny", "--to", "vtk").assert_code(0)


def test_what_is_given_away_is_whole_and_copied_once(usd, tmp_path):
    from pxr import Usd, UsdUtils

    target = tmp_path / "given"
    usd.run("export", "tiny", "--to", "usd", "-o", str(target)).assert_code(0)
    _, _, missing = UsdUtils.ComputeAllDependencies(str(target / "tiny.usd"))
    assert missing == []
    assert Usd.Stage.Open(str(target / "tiny.usd")).GetPrimAtPath("/World/water")
    again = usd.run("export", "tiny", "--to", "usd", "-o", str(target)).assert_code(0)
    assert "0 of" in again.err


def test_the_film_is_untouched_by_exports_and_they_by_cleaning(vtk, tmp_path):
    copy = vtk.copy(tmp_path / "copy")
    copy.run("clean", "tiny", "--superseded", "--yes").assert_code(0)
    assert (copy.layout.root / "tiny.pvd").is_file()
    assert "render" in copy.run("plan", "tiny").assert_code(0).out
    assert "export" not in copy.run("plan", "tiny").out


def test_a_frame_that_is_not_there_and_a_busy_job_are_refused(vtk, tmp_path):
    ended = vtk.run("export", "tiny", "--to", "vtk", "--frames", f"0-{FRAMES}")
    assert ended.code != 0
    assert f"no frame {FRAMES}" in ended.err
    shutil.rmtree(tmp_path, ignore_errors=True)
    assert vtk.run("export", "tiny", "--to", "openjd", "--frames", "1").code == 2
    assert vtk.run("export", "tiny", "--to", "vtk", "--python", "x").code == 2
