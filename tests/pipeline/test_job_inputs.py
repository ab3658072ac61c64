"""A job's folder holds the meshes that it needs."""

from __future__ import annotations

import trimesh

from pipeline.job.inputs import keep_inputs
from pipeline.job.loading import load_job, read_job
from pipeline.layout import JobLayout

JOB = """
name = "ball"  # kept
[[rigid]]
name = "ball"
shape = { type = "mesh", file = "meshes/ball.ply" }
"""


def job_with_mesh(folder, radius=1.0):
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    trimesh.creation.icosphere(radius=radius).export(folder / "meshes" / "ball.ply")
    (folder / "ball.toml").write_text(JOB)
    return folder / "ball.toml"


def test_meshes_are_copied_and_the_text_names_the_copies(tmp_path):
    layout = JobLayout(tmp_path / "renders" / "ball")
    path = job_with_mesh(tmp_path)
    text = keep_inputs(read_job(path), layout)
    (copy,) = layout.inputs.iterdir()
    assert copy.read_bytes() == (tmp_path / "meshes" / "ball.ply").read_bytes()
    assert f'file = "inputs/{copy.name}"' in text
    assert "# kept" in text


def test_a_moved_folder_finds_its_meshes_without_the_originals(tmp_path):
    layout = JobLayout(tmp_path / "renders" / "ball")
    text = keep_inputs(read_job(job_with_mesh(tmp_path)), layout)
    layout.job_file.write_text(text)
    (tmp_path / "meshes" / "ball.ply").unlink()
    moved = layout.root.rename(tmp_path / "elsewhere")
    shape = load_job(moved / "job.toml").rigid[0].shape
    assert (moved / "inputs").samefile(shape.file.rpartition("/")[0])
    assert keep_inputs(read_job(moved / "job.toml"), JobLayout(moved)) == text


def test_a_changed_mesh_does_not_replace_the_copy_of_the_old_one(tmp_path):
    layout = JobLayout(tmp_path / "renders" / "ball")
    first = keep_inputs(read_job(job_with_mesh(tmp_path)), layout)
    second = keep_inputs(read_job(job_with_mesh(tmp_path, radius=2.0)), layout)
    assert first != second
    assert len(list(layout.inputs.iterdir())) == 2
