"""Blender in the warm Python, in the place of the processes that jobs and questions would start: seconds of each."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from warm_python import run_python

from render.blender import FrameRenderError

OPEN = """
    import json, sys
    from pathlib import Path
    import render.blender
    renderer = render.blender.opened = render.blender.open_renderer(Path(sys.argv[1]), threads=2, blender=None)
    print("OPENED", json.dumps([renderer.device, sorted(renderer.pictures_by_uv)]))
"""
DRAW = """
    import json, sys
    from pathlib import Path
    import render.blender
    name, frame, options, *paths = sys.argv[1:]
    try:
        draw = getattr(render.blender.opened, name)
        draw(int(frame), *(Path(path) for path in paths), **json.loads(options))
    except render.blender.FrameRenderError as error:
        print("REFUSED", json.dumps(error.reason))
"""
RUN_SCRIPT = """
    import runpy, sys
    sys.argv = sys.argv[1:]
    try:
        runpy.run_path(sys.argv[0], run_name="__main__")
    except SystemExit as end:
        print("ENDED", end.code)
"""


def told(printed: str, word: str) -> Any:
    """The JSON behind a word at the beginning of a line; None without such a line."""
    lines = [line for line in printed.splitlines() if line.startswith(f"{word} ")]
    return json.loads(lines[-1].partition(" ")[2]) if lines else None


class WarmRenderer:
    """A renderer as `render.blender.open_renderer` makes them; the next one takes its place."""

    def __init__(self, spec_path: Path, **_options: Any) -> None:
        self.device, by_uv = told(run_python(OPEN, str(spec_path)), "OPENED")
        self.pictures_by_uv = frozenset(by_uv)

    def render(self, frame: int, output_path: Path, master_path: Path | None = None) -> None:
        self._draw("render", frame, [output_path, *([] if master_path is None else [master_path])])

    def render_set(self, frame: int, output_path: Path, *, resolution: tuple[int, int]) -> None:
        self._draw("render_set", frame, [output_path], resolution=resolution)

    def _draw(self, name: str, frame: int, paths: Sequence[Path], **options: Any) -> None:
        reason = told(run_python(DRAW, name, str(frame), json.dumps(options), *map(str, paths)), "REFUSED")
        if reason is not None:
            raise FrameRenderError(frame, reason)

    def close(self) -> None:
        pass


def run_script(argv: Sequence[str], **_options: Any) -> subprocess.CompletedProcess[str]:
    """`render.blender.run_script` for a script of the bpy module."""
    printed = run_python(RUN_SCRIPT, *argv[1:])
    return subprocess.CompletedProcess(argv, told(printed, "ENDED") or 0, printed, "")
