"""What the tests of Blender share: small meshes, a small scene, and how it is drawn in a process of its own."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from PIL import Image
from warm_python import run_python

from render.camera_path import CameraPath
from render.meshes import write_ply
from render.parameters import CameraParameters, MaterialParameters, RenderParameters, SetParameters
from render.spec import Camera, MeshSequenceObject, RenderSpec

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Of linear red, green and blue after BT.709."""

# Fully rough, so that no highlight hides the colour.
RED = MaterialParameters(look="plastic", color=(0.8, 0.02, 0.02), roughness=1.0)
BALL = MeshSequenceObject(name="ball", file="ball/{frame}.ply", material=RED)

RESOLUTION = (64, 36)
PIXELS_PER_METRE = RESOLUTION[0] * 50.0 / 36.0 / 2.5
"""In the plane y = 0: a lens of 50 mm on a sensor of 36 mm, seen from 2.5 m."""

HALF_A_PIXEL = 0.5 / PIXELS_PER_METRE
"""What the centroid of a ball of 7 pixels, weighed by redness, is good to [m]; its shaded lower half is paler."""


def sphere(center: tuple[float, float, float], radius: float, *, rings: int = 24, segments: int = 48):
    """A closed sphere: positions (n, 3) and outward triangles (m, 3)."""
    theta = np.linspace(0, np.pi, rings + 1)[1:-1]
    phi = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    ring = np.stack(
        [
            np.outer(np.sin(theta), np.cos(phi)),
            np.outer(np.sin(theta), np.sin(phi)),
            np.outer(np.cos(theta), np.ones(segments)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    positions = np.concatenate([ring, [(0, 0, 1), (0, 0, -1)]])
    triangles = []
    for i in range(rings - 2):
        for j in range(segments):
            a, b = i * segments + j, i * segments + (j + 1) % segments
            triangles += [(a, a + segments, b + segments), (a, b + segments, b)]
    last, north, south = (rings - 2) * segments, len(ring), len(ring) + 1
    for j in range(segments):
        k = (j + 1) % segments
        triangles += [(north, j, k), (south, last + k, last + j)]
    return positions * radius + np.array(center), np.array(triangles)


def write_mesh(path: Path, positions: np.ndarray, triangles: np.ndarray, velocity=None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    velocities = None if velocity is None else np.broadcast_to(velocity, positions.shape)
    write_ply(path, positions, triangles, velocities=velocities)


def still_camera(parameters: CameraParameters) -> Camera:
    """A camera on the unit cube."""
    path = CameraPath(parameters, (-0.5, -0.5, 0.0), (0.5, 0.5, 1.0), aspect=16 / 9, starts={})
    return Camera.on(path, f_stop=parameters.f_stop, views="views/{frame}.json")


def spec_of(*objects, **render) -> RenderSpec:
    """The unit cube seen straight from the front at 2 m; a red ball on grey."""
    settings = {"resolution": RESOLUTION, "quality": "draft", "samples": 4, "denoise": False, "device": "cpu"} | render
    return RenderSpec(
        fps=60.0,
        domain_min=(-0.5, -0.5, 0.0),
        domain_max=(0.5, 0.5, 1.0),
        camera=still_camera(CameraParameters(position=(0.0, -2.5, 0.5), look_at=(0.0, 0.0, 0.5))),
        set=SetParameters(),
        objects=objects,
        render=RenderParameters(**settings),
    )


RENDER_FRAMES = """
    import sys
    from pathlib import Path
    from render.blender import FrameRenderError, open_renderer
    folder = Path(sys.argv[1])
    threads = int(sys.argv[4]) if len(sys.argv) > 4 else 1
    renderer = open_renderer(folder / "spec.json", threads=threads, blender=None)
    print("DEVICE", renderer.device)
    for frame in map(int, sys.argv[3].split(",")):
        try:
            renderer.render(frame, folder / sys.argv[2].format(frame=frame))
        except FrameRenderError as error:
            print("REFUSED", error)
    renderer.close()
"""


def draw_all(folder: Path, spec: RenderSpec, frames: Iterable[int] = (0,)) -> list[np.ndarray]:
    """Display values of frames from 0 to 255, (rows, columns, 3), drawn one after the other in the warm Python."""
    spec.write(folder / "spec.json")
    run_python(RENDER_FRAMES, str(folder), "{frame}.png", ",".join(map(str, frames)), "2")
    return [read(folder / f"{frame}.png") for frame in frames]


def read(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")).astype(float)


def redness(picture: np.ndarray) -> np.ndarray:
    return picture[..., 0] / (picture.sum(axis=2) + 1.0)


def weight(folder: Path, frame: int) -> np.ndarray:
    """How much of each pixel is ball: redness beyond that of the grey stage, which is up to 0.33."""
    return np.clip(redness(read(folder / f"{frame}.png")) - 0.36, 0.0, None)


def centroid(folder: Path, frame: int) -> np.ndarray:
    """Where the ball is [m] in the plane y = 0, x and z."""
    red = weight(folder, frame)
    rows, columns = np.indices(red.shape)
    x = (red * (columns + 0.5 - RESOLUTION[0] / 2)).sum() / red.sum()
    z = (red * (RESOLUTION[1] / 2 - rows - 0.5)).sum() / red.sum()
    return np.array([x, z]) / PIXELS_PER_METRE + [0.0, 0.5]


def spread(folder: Path, frame: int) -> np.ndarray:
    """Standard deviations of the ball's pixels [m] along x and z."""
    red = weight(folder, frame)
    rows, columns = np.indices(red.shape)
    return (
        np.array([np.sqrt(np.cov(axis.ravel(), aweights=red.ravel())) for axis in (columns, rows)]) / PIXELS_PER_METRE
    )
