"""Every channel of an EXR, read by the library that Blender writes it with: FFmpeg knows R, G and B only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from warm_python import run_python

_READ = """
    import sys
    import bpy
    import numpy as np
    python = "/python/lib/python%d.%d/site-packages" % sys.version_info[:2]
    sys.path.insert(0, bpy.utils.resource_path("LOCAL") + python)
    import OpenImageIO
    sys.path.pop(0)
    picture = OpenImageIO.ImageInput.open(sys.argv[1])
    pixels = picture.read_image()
    np.savez(sys.argv[2], **{name: pixels[..., i] for i, name in enumerate(picture.spec().channelnames)})
"""


def exr_channels(path: Path, scratch: Path) -> dict[str, np.ndarray]:
    """The channels of a file of one part, each (height, width), by name; `scratch` is a folder to work in."""
    run_python(_READ, str(path), str(scratch / "channels.npz"))
    with np.load(scratch / "channels.npz") as channels:
        return dict(channels)
