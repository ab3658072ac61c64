"""Where the project and the modules that tests share lie, whatever folder a test is in; and uv, if it is there."""

import shutil
from pathlib import Path

HELPERS = Path(__file__).resolve().parent
PROJECT = HELPERS.parents[1]

UV = shutil.which("uv") or next(PROJECT.glob(".tools/uv/bin/uv"), None)
"""On PATH, or where `./run` puts it."""
