"""Standard output for a benchmark's JSON alone, where Blender writes its log as well."""

from __future__ import annotations

import os
import sys


def keep_output_for_json() -> None:
    """From now on only what this program prints gets to the standard output; libraries write to the standard error."""
    sys.stdout.flush()
    sys.stdout = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
