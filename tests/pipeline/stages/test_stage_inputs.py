"""What of the user's own files counts for a fingerprint: what is in them, not where they lie."""

from pathlib import Path

import pytest
from planned_jobs import digests

from pipeline.base.errors import MissingInputError
from pipeline.model.job import Job

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 {height}\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def write_mesh(path: Path, *, height: int = 1) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(TETRAHEDRON.format(height=height))
    return path


def with_meshes(*files: Path) -> dict[str, str]:
    """Digests of the stages, in a scene with these meshes as a body and as a block of water."""
    body, block = (files * 2)[:2]
    job = Job.model_validate(
        {
            "name": "film",
            "device": "cpu",
            "rigid": [{"name": "body", "shape": {"type": "mesh", "file": str(body)}}],
            "fluid": [{"name": "water", "block": [{"shape": {"type": "mesh", "file": str(block)}}]}],
        }
    )
    return {stage: digest for stage, digest in digests(job).items() if stage in ("simulate", "bodies")}


def test_a_mesh_that_was_moved_is_the_same_mesh(tmp_path: Path) -> None:
    here, there = write_mesh(tmp_path / "here/stone.obj"), write_mesh(tmp_path / "there/rock.OBJ")
    assert with_meshes(here) == with_meshes(there)


def test_a_mesh_that_was_changed_is_another_mesh(tmp_path: Path) -> None:
    before = with_meshes(write_mesh(tmp_path / "stone.obj"))
    after = with_meshes(write_mesh(tmp_path / "stone.obj", height=2))
    assert before["simulate"] != after["simulate"]
    assert before["bodies"] != after["bodies"]


def test_meshes_of_the_same_name_are_told_apart(tmp_path: Path) -> None:
    body, block = write_mesh(tmp_path / "a/mesh.obj"), write_mesh(tmp_path / "b/mesh.obj", height=2)
    assert with_meshes(body, block)["simulate"] != with_meshes(block, body)["simulate"]
    before = with_meshes(body, block)
    write_mesh(body, height=3)
    assert with_meshes(body, block)["bodies"] != before["bodies"]


def test_a_mesh_that_is_gone_is_named(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match=r"cannot read the mesh .*stone\.obj: No such file"):
        with_meshes(tmp_path / "stone.obj")


def frame_digest(**tables: object) -> str:
    """Of a frame of a ball."""
    ball = {"name": "ball", "shape": {"type": "sphere", "radius": 0.1}}
    return digests(Job.model_validate({"name": "film", "rigid": [ball], "frames": 1, **tables}))["render"]


def test_a_picture_around_the_scene_counts_by_what_is_in_it(tmp_path: Path) -> None:
    here, there, other = (tmp_path / name for name in ("here.hdr", "there.HDR", "other.hdr"))
    for path, content in ((here, b"noon"), (there, b"noon"), (other, b"dusk")):
        path.write_bytes(content)
    noon = frame_digest(set={"hdri": str(here)})
    assert noon == frame_digest(set={"hdri": str(there)})
    assert noon == frame_digest(set={"hdri": str(here), "name": "outdoor"})  # its light and sky are not there
    others = [
        frame_digest(),
        frame_digest(set={"hdri": str(other)}),
        frame_digest(set={"hdri": str(here), "rotation_deg": 30.0}),
        frame_digest(set={"hdri": str(here), "ground": "stone"}),
    ]
    assert len({noon, *others}) == 5


def test_a_backplate_counts_by_what_is_in_it_and_a_set_without_one_as_before(tmp_path: Path) -> None:
    here, there, other = (tmp_path / name for name in ("here.jpg", "there.JPG", "other.jpg"))
    for path, content in ((here, b"street"), (there, b"street"), (other, b"beach")):
        path.write_bytes(content)
    street = frame_digest(set={"backplate": str(here)})
    assert street == frame_digest(set={"backplate": str(there)})
    assert len({street, frame_digest(), frame_digest(set={"backplate": str(other)})}) == 3


def test_frames_whose_camera_frames_the_action_count_how_it_does_that(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it stands follows from the film, so that no number of the job says it."""
    cameras: tuple[dict[str, object], ...] = ({"framing": "action"}, {"position": [0.0, -3.0, 1.0]})
    before = [frame_digest(camera=camera) for camera in cameras]
    monkeypatch.setattr("pipeline.stages.render.FRAMING_VERSION", 99)
    after = [frame_digest(camera=camera) for camera in cameras]
    assert before[0] != after[0]
    assert before[1] == after[1]


def test_a_picture_that_is_gone_is_told_when_the_job_is_planned(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match=r"cannot read the picture .*gone\.hdr: No such file"):
        frame_digest(set={"hdri": str(tmp_path / "gone.hdr")})


def test_a_material_of_a_file_counts_by_what_is_in_the_file_and_by_its_name(tmp_path: Path) -> None:
    def digest(blend: str) -> str:
        return frame_digest(material={"ball": {"blend": f"{tmp_path}/{blend}"}})

    for name, content in (("a.blend", b"one"), ("b.blend", b"one"), ("c.blend", b"two")):
        (tmp_path / name).write_bytes(content)
    assert digest("a.blend:Gold") == digest("b.blend:Gold")
    assert len({digest("a.blend:Gold"), digest("c.blend:Gold"), digest("a.blend:Tin")}) == 3
