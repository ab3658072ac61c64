"""Plain pictures by Blender's Workbench engine, in a child process: it ends the process where it cannot draw."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

from render.blender import (
    TEMPORARY_PREFIX,
    BlenderUnavailableError,
    FrameRenderError,
    require_bpy,
    run_script,
    script_argv,
)
from render.system_libraries import install_line, missing_libraries
from render.temporary_folder import environment_of_child

EGL_PACKAGES = {"libEGL.so.1": "libegl1"}
"""Library -> Debian package: how OpenGL draws without a screen."""
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
    """Draw frames of a specification whose engine is Workbench.

    Args:
        spec_path: the RenderSpec document.
        frames: which frames, in order.
        folder: gets the pictures, `000042.png`.
        threads: CPU threads to draw with.
        blender: path of a Blender executable, or None for the bpy module.
        drawn: called with each frame that is done.

    Returns:
        The pictures, in the order of the frames.

    Raises:
        FrameRenderError: a frame could not be drawn.
    """
    output = str(folder / "{frame:06d}.png")
    wanted = f"{frames[0]}-{frames[-1]}" if isinstance(frames, range) else ",".join(map(str, frames))
    options = [str(spec_path), "--frames", wanted, "--output", output, "--threads", str(threads)]
    argv = script_argv(blender, "render_frames.py", options)
    done, last = 0, ""
    with (
        environment_of_child(TEMPORARY_PREFIX) as environment,
        subprocess.Popen(
            argv,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            errors="replace",
            env=environment,
        ) as process,
    ):
        assert process.stdout is not None
        try:
            for line in process.stdout:
                if line.startswith(f"FRAME_DONE {frames[done] if done < len(frames) else ''} "):
                    drawn(frames[done])
                    done += 1
                elif line.startswith(("FRAME_FAILED", "RENDERER_FAILED")):
                    raise FrameRenderError(frames[min(done, len(frames) - 1)], line.split(" ", 2)[-1].strip())
                else:
                    last = line.strip() or last
        finally:
            process.terminate()
    if done < len(frames):
        raise FrameRenderError(frames[done], f"Blender ended with exit code {process.returncode}: {last}")
    return [folder / f"{frame:06d}.png" for frame in frames]
