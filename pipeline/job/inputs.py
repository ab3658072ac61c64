"""The user's own files, kept with the job: its folder can be moved, and continued when the originals are gone."""

from __future__ import annotations

import os
from pathlib import Path

from blake3 import blake3

from pipeline.job.loading import LoadedJob, changed_text
from pipeline.job.overrides import Override
from pipeline.job.placements import mesh_shapes
from pipeline.layout import JobLayout


def keep_inputs(loaded: LoadedJob, layout: JobLayout) -> str:
    """Copy the job's mesh files into its folder.

    A copy is named after its content, so one of another job version never replaces it.

    Returns:
        The job's text, naming the copies by paths relative to the folder.

    Raises:
        OSError: a mesh cannot be read, or the folder not be written.
    """
    changes = []
    for place, shape in mesh_shapes(loaded.job):
        source = Path(shape.file)
        content = source.read_bytes()
        stem = source.stem.removesuffix(f"-{blake3(content).hexdigest()[:12]}")
        copy = layout.inputs / f"{stem}-{blake3(content).hexdigest()[:12]}{source.suffix}"
        if not copy.exists():
            _write(copy, content)
        changes.append(Override((*place, "file"), copy.relative_to(layout.root).as_posix(), loaded.path.name))
    return changed_text(loaded.text, changes) if changes else loaded.text


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part.{os.getpid()}")
    with part.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
