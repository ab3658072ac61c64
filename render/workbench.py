"""Plain pictures by Blender's Workbench engine, in a child process: it ends the process where it cannot draw."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

from render.blender import (
    BlenderUnavailableError,
    ChildRenderer,
    FrameRenderError,
    require_bpy,
    run_script,
    script_argv,
)
from render.system_libraries import install_line, missing_libraries

EGL_PACKAGES = {"libEGL.so.1": "libegl1"}  # library -> Debian package: how OpenGL draws without a screen
_DRIVERS = "libgl1-mesa-dri"
"""Mesa's drivers, among them one that draws with the processor; they are loaded by libEGL alone."""
_PROBE_TIMEOUT_S = 120.0
_READY = "WORKBENCH_READY"


def require_workbench(blender: str | None) -> None:
    """Make sure that Workbench can draw here, by letting it draw a few pixels in a child process.

    Args:
        blender: path of a Blender executable, or None for the bpy module.

    Raises:
        BlenderUnavailableError: it cannot; names the packages that are missing.
    """
    if blender is None:
        require_bpy()
    install = install_line([*EGL_PACKAGES.values(), _DRIVERS])
    if missing := missing_libraries(EGL_PACKAGES):
        raise BlenderUnavailableError(
            f"Workbench draws through EGL, and this system lacks {', '.join(missing)}; install it: {install}"
        )
    argv = script_argv(blender, "workbench.py", [])
    completed = run_script(argv, timeout_s=_PROBE_TIMEOUT_S, purpose="draw a picture with Workbench")
    if _READY not in completed.stdout:
        last = "\n".join((completed.stdout + completed.stderr).splitlines()[-5:])
        raise BlenderUnavailableError(
            f"Workbench cannot draw here (exit code {completed.returncode}); it needs a driver for OpenGL: {install}\n"
            f"{last}"
        )


def draw_frames(
    spec_path: Path,
    frames: Sequence[int],
    folder: Path,
    *,
    threads: int,
    blender: str | None,
    drawn: Callable[[int], None],
) -> list[Path]:
    """Draw frames of a RenderSpec document whose engine is Workbench, in order.

    Args:
        spec_path: the document.
        frames: which frames.
        folder: gets the pictures, `000042.png`, which are returned.
        threads: CPU threads to draw with.
        blender: path of a Blender executable, or None for the bpy module.
        drawn: called with each frame that is done.

    Raises:
        FrameRenderError: a frame could not be drawn.
    """
    pictures = [folder / f"{frame:06d}.png" for frame in frames]
    try:
        renderer = ChildRenderer(spec_path, threads=threads, blender=blender)
    except BlenderUnavailableError as error:
        raise FrameRenderError(frames[0], str(error)) from error
    with closing(renderer):
        for frame, picture in zip(frames, pictures, strict=True):
            renderer.render(frame, picture)
            drawn(frame)
    return pictures
