"""The drawing of a frame: by the warm renderer of this worker process, once more if the picture fails the checks."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import InvalidArtifactError
from pipeline.base.parameter_set import digest_of
from pipeline.model.job import Job
from pipeline.stages.base import TaskContext
from pipeline.stages.gpu_kernels import compiled_once
from pipeline.stages.inputs import blender_version
from pipeline.stages.render_scene import framed_points, render_spec
from pipeline.stages.visibility import BodyAtFrame, expected_cells
from render.blender import Renderer, open_renderer
from render.camera_path import View
from render.errors import InvalidFileError
from render.pictures import PictureStatistics, check_pixels, over_black, read_picture, require_more_than_set
from render.temporary_folder import temporary_folder

SET_PIXELS = 96
"""Along the longer side of the empty set that pictures are held against: half a percent of it is 25 pixels."""

WHITE_SHARE = 0.8  # share of white pixels above which a picture is warned of; a white studio in twice its light has 0.4

BAD_PICTURE = "bad picture"
NEARLY_WHITE = "nearly white"
NO_GPU = "no GPU"
CPU = "CPU"  # a renderer's name for the processor


class FrameDrawing:
    """The drawing of one frame. What Blender is given of the job is described once, when this is made."""

    def __init__(self, context: TaskContext, view: View, bodies: Sequence[BodyAtFrame]) -> None:
        assert context.task.frame is not None
        job, layout = context.job, context.layout
        self._context, self._view, self._bodies = context, view, bodies
        self._frame = context.task.frame
        self._document = render_spec(job, layout, framed_points(job, layout)).document()
        self._key = digest_of(f"{layout.root} {context.threads} {context.gpu} {self._document}")
        self._checked: Path | None = None

    @property
    def renderer(self) -> Renderer:
        """This process's renderer for the frame, opened where the one that is there draws something else."""
        if self._key not in _WARM:
            close_renderers()
            root = self._context.layout.root
            part = root / f".scene.json.part.{os.getpid()}"
            part.write_text(self._document, encoding="utf-8")
            path = part.replace(root / "scene.json")
            blender = self._context.job.render.blender
            _WARM[self._key] = open_renderer(
                path, threads=self._context.threads, blender=blender, gpu=self._context.gpu
            )
        return _WARM[self._key]

    def draw_until_good(self, picture: Path, masters: Sequence[Path] = ()) -> None:
        """Draw the frame, and once more if its picture fails the checks; a picture that fails again is kept.

        `masters` gets the EXR, if the job asks for one. Raises InvalidArtifactError if the picture failed again.
        """
        context, frame = self._context, self._frame
        for once_more in (True, False):
            try:
                self._draw(picture, *masters)
                statistics = self._check(picture)
            except InvalidFileError as error:
                if once_more:
                    close_renderers()  # what went wrong in it may stay so
                    context.warn(BAD_PICTURE, f"frame {frame}: the picture {error.reason}; it is drawn once more")
                    continue
                rejected = context.layout.rejected_picture(frame)
                rejected.parent.mkdir(exist_ok=True)
                shutil.copyfile(picture, rejected)
                raise InvalidArtifactError(
                    f"frame {frame}: the picture {error.reason}; twice; it is kept as {rejected}"
                ) from error
            # What stands before white on purpose is no mistake, and light that was asked for no failure of Blender's.
            if statistics.white_share > WHITE_SHARE and not may_be_empty(context.job):
                context.warn(
                    NEARLY_WHITE,
                    f"frame {frame}: {100 * statistics.white_share:.0f} % of the picture is white; see set.strength, "
                    "the power of [[light]] and render.exposure",
                )
            self._checked = picture
            return

    def require_checked(self, picture: Path) -> None:
        """Refuse to commit a picture that `draw_until_good` has not decoded and passed; nothing is decoded twice."""
        if picture != self._checked:
            raise InvalidArtifactError(f"frame {self._frame}: the picture was not checked")

    def _draw(self, picture: Path, *masters: Path) -> None:
        """Draw the frame; the first one of this process on a GPU takes what compiling takes."""
        context, renderer = self._context, self.renderer
        if context.gpu is not None and renderer.device == CPU:
            sentence = f"frame {self._frame}: Cycles finds no GPU {context.gpu} any more; drawn on the processor"
            context.warn(NO_GPU, sentence)
        if renderer.device == CPU or renderer.device in _COMPILED:
            renderer.render(self._frame, picture, *masters)
            return

        def tell(message: str) -> None:
            context.progress(0, 1, message, preparing=True)

        with compiled_once(renderer.device, blender_version(context.job.render.blender), tell):
            renderer.render(self._frame, picture, *masters)
        _COMPILED.add(renderer.device)
        context.progress(0, 1)

    def _check(self, path: Path) -> PictureStatistics:
        """Decode and check a picture; returns its statistics.

        Raises InvalidFileError: it is damaged, black, of one colour, or shows the set without its bodies.
        """
        job = self._context.job
        pixels = read_picture(path)
        statistics = check_pixels(path, pixels, job.render.resolution, may_be_empty=may_be_empty(job))
        width, height = job.render.resolution
        scale = min(1.0, SET_PIXELS / max(width, height))
        columns, rows = max(4, round(scale * width)), max(4, round(scale * height))
        cells = expected_cells(job, self._view, self._bodies, (rows, columns))
        if cells is not None:
            require_more_than_set(path, over_black(pixels), self._empty_set(columns, rows), cells)
        return statistics

    def _empty_set(self, columns: int, rows: int) -> NDArray[np.uint8]:
        """The camera's view without any body, (rows, columns, 4); drawn once for a still camera."""
        if _STILL_SET in _EMPTY_SETS:
            return _EMPTY_SETS[_STILL_SET]
        with temporary_folder("set") as folder:
            picture = folder / "set.png"
            self.renderer.render_set(self._frame, picture, resolution=(columns, rows))
            empty = over_black(read_picture(picture))
        if not self._context.job.placed_camera.moves:
            _EMPTY_SETS[_STILL_SET] = empty
        return empty


def may_be_empty(job: Job) -> bool:
    """Whether nothing is left of a picture where no body is."""
    return not job.set.is_seen


_WARM: dict[str, Renderer] = {}
"""The renderer of this worker process, by the digest of its specification, thread count and GPU; at most one."""

_COMPILED: set[str] = set()  # the devices on which this process has drawn

_STILL_SET = "still"
_EMPTY_SETS: dict[str, NDArray[np.uint8]] = {}
"""The empty set as the warm renderer draws it, (rows, columns, 4); kept for a still camera."""


def close_renderers() -> None:
    """Close this process's renderer; idempotent."""
    for renderer in _WARM.values():
        renderer.close()
    _WARM.clear()
    _EMPTY_SETS.clear()
