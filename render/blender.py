"""Blender as a renderer: the bpy module in this process, or a child process that is asked for frame after frame."""

from __future__ import annotations

import contextlib
import json
import logging
import re
import subprocess
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from render.system_libraries import install_line, missing_libraries, missing_packages
from render.temporary_folder import environment_of_child

logger = logging.getLogger(__name__)

MINIMUM_BLENDER_VERSION = (4, 5)
_STARTUP_VERSION_TIMEOUT_S = 120.0
_TERMINATE_TIMEOUT_S = 10.0
_LOG_TAIL_LINES = 30
_TEXT: Any = {"encoding": "utf-8", "errors": "replace"}


class BlenderUnavailableError(RuntimeError):
    """Blender cannot be used on this machine; says what is missing and how to get it."""


class BlenderKilledError(BlenderUnavailableError):
    """The Blender executable was ended by a signal while it started: the machine's fault, which may be gone by now."""


class BlenderHungError(BlenderUnavailableError):
    """A script did not end in time; `told` is what it had written to its standard output by then."""

    def __init__(self, message: str, told: str = "") -> None:
        super().__init__(message, told)
        self.told = told

    def __str__(self) -> str:
        return str(self.args[0])


class FrameRenderError(RuntimeError):
    """A frame could not be drawn."""

    def __init__(self, frame: int, reason: str) -> None:
        super().__init__(frame, reason)
        self.frame, self.reason = frame, reason

    def __str__(self) -> str:
        return f"frame {self.frame}: {self.reason}"


class BlenderDiedError(FrameRenderError):
    """The Blender executable ended while it was needed: no fault of the frame, which another renderer may draw.

    Attributes:
        returncode: exit code of the child; negative for the signal that ended it.
    """

    def __init__(self, frame: int, returncode: int, last_lines: str) -> None:
        super().__init__(frame, f"Blender is gone, exit code {returncode}; its last lines:\n{last_lines}")
        self.args = (frame, returncode, last_lines)  # what pickling calls this with
        self.returncode = returncode


def open_renderer(spec_path: Path, *, threads: int, blender: str | None, gpu: int | None = 0) -> Renderer:
    """Open a renderer for many frames of a RenderSpec document.

    Args:
        spec_path: the document.
        threads: CPU threads to render with.
        blender: path of a Blender executable, or None for the bpy module.
        gpu: which one if the document leaves a choice, counted from 0 as `render.gpus` lists them; None: none of them.

    Raises:
        BlenderUnavailableError: there is no usable Blender, or it refuses the specification.
    """
    if blender is None:
        return ModuleRenderer(spec_path, threads=threads, gpu=gpu)
    return ChildRenderer(spec_path, threads=threads, blender=blender, gpu=gpu)


def require_bpy() -> None:
    """Raise BlenderUnavailableError, with the remedy, when the bpy module cannot be imported here.

    The libraries are looked for first: without them the import ends in an obscure loader error.
    """
    if find_spec("bpy") is None:
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        raise BlenderUnavailableError(
            f"there is no bpy module for this Python {version}; use Python 3.11 or 3.13, "
            'or name a Blender executable: [render] blender = "/path/to/blender"'
        )
    missing = missing_libraries()
    if missing:
        raise BlenderUnavailableError(
            f"Blender needs shared libraries that this system lacks: {', '.join(missing)}; "
            f"install them: {install_line(missing_packages())}"
        )


class ModuleRenderer:
    """Draws frames of one RenderSpec with the bpy module in this process; a new one closes the last.

    Attributes:
        device: that Cycles renders on, e.g. `CPU` or `OPTIX: NVIDIA RTX 4090`.
        pictures_by_uv: names of the objects with pictures in their material that lie by texture coordinates.
    """

    def __init__(self, spec_path: Path, *, threads: int, gpu: int | None = 0) -> None:
        require_bpy()
        from blender_scripts.errors import RenderInputError
        from blender_scripts.render_frames import SceneRenderer

        try:
            self._scene = SceneRenderer(spec_path, threads=threads, gpu=gpu)
        except (RenderInputError, RuntimeError) as error:
            raise BlenderUnavailableError(str(error)) from error
        self.device: str = self._scene.device
        self.pictures_by_uv = frozenset(self._scene.pictures_by_uv)

    def render(self, frame: int, output_path: Path, master_path: Path | None = None) -> None:
        """Draw a frame into a PNG file of any name, and into an EXR if one is named. Raises FrameRenderError."""
        with _errors_of(frame):
            self._scene.render(frame, output_path, master_path)

    def render_set(self, frame: int, output_path: Path, *, resolution: tuple[int, int]) -> None:
        """Draw the view of a frame's camera without any body. Raises FrameRenderError."""
        with _errors_of(frame):
            self._scene.render_set(frame, output_path, resolution=resolution)

    def save_surfaces(self, frame: int, folder: Path) -> None:
        """Write the surfaces of fluids as they are drawn at a frame, NAME.ply each. Raises FrameRenderError."""
        with _errors_of(frame):
            self._scene.save_surfaces(frame, folder)

    def close(self) -> None:
        """Nothing to do: the module stays loaded, and the next scene replaces this one."""


class ChildRenderer:
    """Draws with a Blender executable or the bpy module in a child process, which it asks for frame after frame.

    Attributes as of `ModuleRenderer`.
    """

    def __init__(self, spec_path: Path, *, threads: int, blender: str | None, gpu: int | None = 0) -> None:
        if blender is not None:
            require_supported_executable(blender)
        self._log_tail: deque[str] = deque(maxlen=_LOG_TAIL_LINES)
        self._argv = build_argv(blender, spec_path.resolve(), threads=threads, gpu=gpu)
        with contextlib.ExitStack() as on_failure:
            environment = on_failure.enter_context(environment_of_child("blender"))
            pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
            self._process: subprocess.Popen[str] = subprocess.Popen(self._argv, env=environment, **pipes, **_TEXT)
            self._leftovers = on_failure.pop_all()
        try:
            self.pictures_by_uv: frozenset[str] = frozenset()
            words = ("RENDERER_READY", "RENDERER_FAILED", "PICTURES_BY_UV")
            while (answer := self._read_answer(words)) is not None and answer.startswith("PICTURES_BY_UV"):
                self.pictures_by_uv = frozenset(json.loads(answer.partition(" ")[2]))
            if answer is None:
                raise self._not_started()
            if answer.startswith("RENDERER_FAILED"):
                raise BlenderUnavailableError(answer.partition(" ")[2])
        except BaseException:
            self.close()
            raise
        self.device = answer.split(" ", 2)[2]

    def render(self, frame: int, output_path: Path, master_path: Path | None = None) -> None:
        """Draw a frame into a PNG file of any name, and into an EXR if one is named.

        Raises FrameRenderError, of which a BlenderDiedError says that this renderer is of no more use.
        """
        master = "" if master_path is None else f"\t{master_path.resolve()}"
        self._ask(frame, f"{frame} {output_path.resolve()}{master}")

    def render_set(self, frame: int, output_path: Path, *, resolution: tuple[int, int]) -> None:
        """Draw the view of a frame's camera without any body. Raises as `render` does."""
        width, height = resolution
        self._ask(frame, f"set {frame} {width}x{height} {output_path.resolve()}")

    def save_surfaces(self, frame: int, folder: Path) -> None:
        """Write the surfaces of fluids as they are drawn at a frame, NAME.ply each. Raises as `render` does."""
        self._ask(frame, f"surfaces {frame} {folder.resolve()}")

    def _ask(self, frame: int, request: str) -> None:
        stdin = self._process.stdin
        assert stdin is not None
        try:
            stdin.write(f"{request}\n")
            stdin.flush()
        except (BrokenPipeError, ValueError) as error:
            raise self._died(frame) from error
        answer = self._read_answer((f"FRAME_DONE {frame} ", f"FRAME_FAILED {frame} "))
        if answer is None:
            raise self._died(frame)
        if answer.startswith("FRAME_FAILED"):
            raise FrameRenderError(frame, answer.split(" ", 2)[2])

    def close(self) -> None:
        """End the child: ask it to, then insist."""
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                # What is still buffered for a dead child cannot be flushed, and need not be.
                with contextlib.suppress(BrokenPipeError):
                    stream.close()
        self._process.terminate()
        try:
            self._process.wait(_TERMINATE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._leftovers.close()

    def _read_answer(self, prefixes: tuple[str, ...]) -> str | None:
        """The next line of the protocol, or None when the child has closed its output; other lines are logged."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            text = line.rstrip("\n")
            if text.startswith(prefixes):
                return text
            self._log_tail.append(text)
            logger.debug("blender: %s", text)
        return None

    def _not_started(self) -> BlenderUnavailableError:
        """The error of a child that has closed its output, and ends by itself if it does so soon."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_TERMINATE_TIMEOUT_S)
        self.close()
        code = self._process.returncode
        return (BlenderKilledError if code < 0 else BlenderUnavailableError)(
            f"Blender did not start: exit code {code} of {' '.join(self._argv)}; its last lines:\n{self._last_lines()}"
        )

    def _died(self, frame: int) -> BlenderDiedError:
        self.close()
        return BlenderDiedError(frame, self._process.returncode, self._last_lines())

    def _last_lines(self) -> str:
        return "\n".join(self._log_tail) or "(it wrote nothing)"


Renderer = ModuleRenderer | ChildRenderer


@contextlib.contextmanager
def _errors_of(frame: int) -> Iterator[None]:
    """Errors of the scripts in this process as those of a frame."""
    from blender_scripts.errors import RenderFailedError, RenderInputError

    try:
        yield
    except (RenderInputError, RenderFailedError, RuntimeError, ValueError) as error:
        raise FrameRenderError(frame, str(error)) from error


def build_argv(blender: str | None, spec_path: Path, *, threads: int, gpu: int | None) -> list[str]:
    """Arguments that make Blender draw frames of a specification on demand."""
    words = ["--threads", str(threads)]
    options = [str(spec_path), *words, "--gpu", "none" if gpu is None else str(gpu)]
    return script_argv(blender, "render_frames.py", options, own=words)


def script_argv(blender: str | None, script: str, options: Sequence[str], *, own: Sequence[str] = ()) -> list[str]:
    """Arguments that run a script of `blender_scripts`.

    `--factory-startup` keeps the user's preferences and add-ons out of the pictures, `--disable-autoexec` what .blend
    files would run.

    Args:
        blender: path of a Blender executable, or None for the bpy module.
        script: name of the script.
        options: words for the script.
        own: words for the executable.

    Raises:
        BlenderUnavailableError: the project is not on Python's path.
    """
    package = find_spec("blender_scripts")
    if package is None or package.origin is None:
        raise BlenderUnavailableError("the folder blender_scripts of this project is not on Python's path")
    path = str(Path(package.origin).with_name(script))
    if blender is None:
        return [sys.executable, path, *options]
    start = [blender, "--background", "--factory-startup", "--disable-autoexec", *own]
    return [*start, "--python", path, "--", *options]


def run_script(argv: Sequence[str], *, timeout_s: float, purpose: str) -> subprocess.CompletedProcess[str]:
    """Run a script to its end, whatever that is; its output is text.

    Raises:
        BlenderHungError: it does not end in time [s], and so has not done its purpose.
        BlenderUnavailableError: it cannot be started.
        OSError: there is no place for its temporary files.
    """
    with environment_of_child("blender") as environment:
        try:
            return subprocess.run(argv, capture_output=True, timeout=timeout_s, check=False, env=environment, **_TEXT)
        except OSError as error:
            raise BlenderUnavailableError(f"cannot start {argv[0]}: {error.strerror}") from error
        except subprocess.TimeoutExpired as error:
            told = (error.stdout or b"").decode(errors="replace")  # bytes, whatever was asked for
            raise BlenderHungError(f"Blender took more than {timeout_s:g} s to {purpose}", told) from error


def early_end(completed: subprocess.CompletedProcess[str], purpose: str) -> str:
    """What to say of a script that ended, with its last line, while it did something: "looked for GPUs"."""
    last = (completed.stdout + completed.stderr).strip().rpartition("\n")[2]
    return f"Blender ended with exit code {completed.returncode} while it {purpose}: {last}"


def parse_blender_version(text: str) -> tuple[int, int, int] | None:
    """The version in the first lines that `blender --version` prints, or None."""
    match = re.search(r"^Blender (\d+)\.(\d+)\.(\d+)", text, flags=re.MULTILINE)
    return (int(match[1]), int(match[2]), int(match[3])) if match else None


def require_supported_executable(blender: str) -> tuple[int, int, int]:
    """Version of a Blender executable.

    Raises:
        BlenderUnavailableError: it cannot be started, is no Blender, or is too old.
    """
    try:
        completed = subprocess.run(
            [blender, "--version"], capture_output=True, timeout=_STARTUP_VERSION_TIMEOUT_S, check=False, **_TEXT
        )
    except OSError as error:
        raise BlenderUnavailableError(f"cannot start the Blender executable {blender}: {error.strerror}") from error
    except subprocess.TimeoutExpired as error:
        raise BlenderUnavailableError(f"{blender} --version did not answer in {error.timeout:g} s") from error
    version = parse_blender_version(completed.stdout)
    if version is None:
        raise BlenderUnavailableError(
            f"{blender} is not a Blender executable: --version exited with {completed.returncode} and printed "
            f"{(completed.stdout + completed.stderr)[:200]!r}"
        )
    if version[:2] < MINIMUM_BLENDER_VERSION:
        raise BlenderUnavailableError(f"{blender} is Blender {'.'.join(map(str, version))}; 4.5 LTS or newer is needed")
    return version
