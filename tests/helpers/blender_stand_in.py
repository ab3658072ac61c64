"""An external Blender for tests of machines that have the bpy module only."""

from __future__ import annotations

import stat
import sys
import textwrap
from pathlib import Path


def write_blender_stand_in(folder: Path) -> Path:
    """An executable with Blender's command line around this environment's own Blender, the bpy module."""
    script = folder / "stand in" / "blender"
    script.parent.mkdir()
    script.write_text(
        f"#!{sys.executable}\n"
        + textwrap.dedent(
            """
            import runpy, sys
            arguments = sys.argv[1:]
            if arguments == ["--version"]:
                print("Blender 5.0.1")
                sys.exit()
            print("noise that Blender prints before anything else")
            assert arguments[:2] == ["--background", "--factory-startup"], arguments
            runpy.run_path(arguments[arguments.index("--python") + 1], run_name="__main__")
            """
        )
    )
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    return script
