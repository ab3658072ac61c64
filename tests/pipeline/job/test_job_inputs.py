"""A job's folder holds the meshes that it needs."""

import os

import trimesh

from pipeline.base.layout import JobLayout
from pipeline.job.inputs import keep_inputs
from pipeline.job.loading import load_job, read_job
from pipeline.stages.bodies import BodiesStage
from pipeline.store.artifacts import sweep_parts

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
    _, text = keep_inputs(read_job(path), layout)
    (copy,) = layout.inputs.iterdir()
    assert copy.read_bytes() == (tmp_path / "meshes" / "ball.ply").read_bytes()
    assert f'file = "inputs/{copy.name}"' in text
    assert "# kept" in text


def test_a_moved_folder_finds_its_meshes_without_the_originals(tmp_path):
    layout = JobLayout(tmp_path / "renders" / "ball")
    _, text = keep_inputs(read_job(job_with_mesh(tmp_path)), layout)
    layout.job_file.write_text(text)
    (tmp_path / "meshes" / "ball.ply").unlink()
    moved = layout.root.rename(tmp_path / "elsewhere")
    shape = load_job(moved / "job.toml").rigid[0].shape
    assert (moved / "inputs").samefile(shape.file.rpartition("/")[0])
    assert keep_inputs(read_job(moved / "job.toml"), JobLayout(moved))[1] == text


def test_a_changed_mesh_does_not_replace_the_copy_of_the_old_one(tmp_path):
    layout = JobLayout(tmp_path / "renders" / "ball")
    _, first = keep_inputs(read_job(job_with_mesh(tmp_path)), layout)
    _, second = keep_inputs(read_job(job_with_mesh(tmp_path, radius=2.0)), layout)
    assert first != second
    assert len(list(layout.inputs.iterdir())) == 2


def test_what_is_planned_is_what_the_workers_load_even_if_the_original_changes(tmp_path):
    layout = JobLayout(tmp_path / "renders" / "ball")
    job, text = keep_inputs(read_job(job_with_mesh(tmp_path)), layout)
    layout.job_file.write_text(text)
    planned = {task.id: task.parameters.digest for task in BodiesStage().plan(job, layout)}
    job_with_mesh(tmp_path, radius=2.0)
    assert job == load_job(layout.job_file)
    assert {task.id: task.parameters.digest for task in BodiesStage().plan(job, layout)} == planned


def test_a_copy_that_was_changed_is_written_again(tmp_path):
    layout = JobLayout(tmp_path / "renders" / "ball")
    path = job_with_mesh(tmp_path)
    keep_inputs(read_job(path), layout)
    (copy,) = layout.inputs.iterdir()
    copy.write_bytes(copy.read_bytes()[:-100])
    keep_inputs(read_job(path), layout)
    assert copy.read_bytes() == (tmp_path / "meshes" / "ball.ply").read_bytes()


def test_a_runner_that_sweeps_meanwhile_leaves_the_copy_alone(tmp_path, monkeypatch):
    layout = JobLayout(tmp_path / "renders" / "ball")
    fsync = os.fsync

    def sweep_and_sync(descriptor: int) -> None:
        assert sweep_parts(layout) == []
        fsync(descriptor)

    monkeypatch.setattr("os.fsync", sweep_and_sync)
    keep_inputs(read_job(job_with_mesh(tmp_path)), layout)
    assert len(list(layout.inputs.iterdir())) == 1
