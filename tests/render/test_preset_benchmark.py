"""The benchmark of presets, with a real Blender in a process of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from blender_scenes import spec_of
from blender_stand_in import write_blender_stand_in
from needed_blender import needs_bpy

from benchmarks import changed_frames, presets
from render.blender import open_renderer

pytestmark = needs_bpy


def test_every_blender_that_was_opened_is_ended(tmp_path: Path, monkeypatch):
    executable = str(write_blender_stand_in(tmp_path))
    opened: list[Any] = []

    def in_a_process(spec: Path, *, threads: int, blender: None) -> Any:
        opened.append(open_renderer(spec, threads=threads, blender=executable))
        return opened[-1]

    monkeypatch.setattr(changed_frames, "open_renderer", in_a_process)
    spec_of().write(tmp_path / "scene.json")
    least = presets.measure(tmp_path, frame=0, changes={"quality": "draft"}, threads=1, repeats=0)
    assert least["wall_s"] > 0.0
    assert opened[0]._process.poll() is not None
