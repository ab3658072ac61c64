"""Cycles settings: what each quality preset means."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import bpy
from mathutils import Vector

from blender_scripts.compatibility import set_file_format

QUALITIES = ("draft", "preview", "final")
_CYCLES_BY_QUALITY: dict[str, tuple[float | str, float | str, float | str]] = {
    "samples": (6, 48, 256),
    # A pixel whose estimated error is below this gets no more samples.
    "adaptive_threshold": (0.1, 0.05, 0.02),
    "denoising_quality": ("FAST", "BALANCED", "HIGH"),
    # Choosing lights by what they contribute pays for itself from some dozen samples on.
    "use_light_tree": (False, True, True),
    "volume_step_rate": (2.0, 2.0, 1.0),
    "volume_bounces": (0, 1, 3),
    "max_bounces": (6, 10, 24),
    "diffuse_bounces": (1, 2, 4),
    "transmission_bounces": (6, 10, 16),
}
"""Cycles' settings that trade time for quality; docs/guide/rendering.md has what each was measured to give."""

_CLEAN_SAMPLES = 16  # of an empty set, which is smooth

_FAR_DISC = 300.0
"""Distance of what stands for a sun, in diagonals of the domain: its light falls off by 1 % across two of them."""


def apply_render_settings(parameters: dict[str, Any], *, fps: float, threads: int) -> None:
    """Set all that `render` of the specification says for the current scene, whose colours are AgX's."""
    scene = bpy.context.scene
    render = scene.render
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y = parameters["resolution"]
    render.resolution_percentage = 100
    # Blender's fps is a whole number over a real base.
    render.fps = math.ceil(fps)
    render.fps_base = math.ceil(fps) / fps
    render.threads_mode = "FIXED"
    render.threads = threads
    render.use_motion_blur = parameters["motion_blur"]
    render.motion_blur_shutter = parameters["shutter"]
    render.motion_blur_position = "CENTER"
    render.use_compositing = False
    render.use_sequencer = False
    _enable_passes(bpy.context.view_layer, frozenset(parameters["passes"]))
    scene.display_settings.display_device = "sRGB"
    scene.view_settings.view_transform = "AgX"
    scene.view_settings.look = "AgX - Medium High Contrast"
    scene.view_settings.exposure = parameters["exposure"]
    _apply_cycles_settings(scene.cycles, parameters)


def choose_png(picture_format: str, *, with_alpha: bool) -> None:
    """Save the next picture as a PNG in display values; of 16 bits if that is the format that the job asks for."""
    image = bpy.context.scene.render.image_settings
    set_file_format(image, "PNG")
    image.color_mode = "RGBA" if with_alpha else "RGB"
    image.color_depth = "16" if picture_format == "png16" else "8"
    image.compression = 15


def choose_exr(*, with_passes: bool, with_alpha: bool) -> None:
    """Save the next picture as an EXR of half floats; passes are layers in it, in full precision where they are data.

    DWAA is made for pictures: of normals and vectors it would change the Y alone, so passes are kept without loss.
    """
    image = bpy.context.scene.render.image_settings
    set_file_format(image, "OPEN_EXR_MULTILAYER" if with_passes else "OPEN_EXR")
    if not with_passes:
        image.color_mode = "RGBA" if with_alpha else "RGB"
    image.color_depth = "16"
    image.exr_codec = "ZIP" if with_passes else "DWAA"


def _enable_passes(view_layer: Any, passes: frozenset[str]) -> None:
    view_layer.use_pass_z = "depth" in passes
    view_layer.use_pass_vector = "vector" in passes
    view_layer.use_pass_normal = "normal" in passes
    view_layer.use_pass_cryptomatte_object = "cryptomatte" in passes
    view_layer.use_pass_cryptomatte_material = "cryptomatte" in passes
    view_layer.cycles.denoising_store_passes = "denoising" in passes


def _apply_cycles_settings(cycles: Any, parameters: dict[str, Any]) -> None:
    for name, values in _CYCLES_BY_QUALITY.items():
        setattr(cycles, name, values[QUALITIES.index(parameters["quality"])])
    if parameters["samples"] is not None:
        cycles.samples = parameters["samples"]
    cycles.use_adaptive_sampling = True
    # The same pattern in every frame: with a still camera, what noise is left stands still instead of boiling.
    cycles.seed = parameters["seed"]
    cycles.use_animated_seed = False
    cycles.use_denoising = parameters["denoise"]
    cycles.denoiser = "OPENIMAGEDENOISE"
    # At few samples noisy guides print their noise into the picture, and cleaning them is cheap.
    cycles.denoising_prefilter = "ACCURATE"
    cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
    # Unbiased tracking takes a third of the time a sample, but cuts the blur of fast smoke off
    # (docs/guide/rendering.md), and prepares each frame for up to a minute of processor time.
    cycles.volume_biased = True
    cycles.glossy_bounces = 4
    cycles.transparent_max_bounces = 16
    # Looks let light through refracting bodies themselves; sampled caustics would only add fireflies.
    cycles.caustics_reflective = False
    cycles.caustics_refractive = False
    cycles.blur_glossy = 1.0
    cycles.sample_clamp_direct = 0.0
    cycles.sample_clamp_indirect = 6.0


@contextmanager
def small_and_clean(resolution: tuple[int, int]) -> Iterator[None]:
    """Draw in another size [pixels], with few samples that are denoised and without blur; then as before."""
    render, cycles = bpy.context.scene.render, bpy.context.scene.cycles
    changes = [
        (render, "resolution_x", resolution[0]),
        (render, "resolution_y", resolution[1]),
        (render, "use_motion_blur", False),
        (cycles, "samples", _CLEAN_SAMPLES),
        (cycles, "use_denoising", True),
    ]
    before = [getattr(owner, name) for owner, name, _ in changes]
    for owner, name, value in changes:
        setattr(owner, name, value)
    try:
        yield
    finally:
        for (owner, name, _), value in zip(changes, before, strict=True):
            setattr(owner, name, value)


def cast_caustics(caster_names: set[str], *, domain_size: float, domain_middle: tuple[float, ...]) -> None:
    """Let bodies bend the light of all lamps onto everything else in the scene.

    Cycles walks from what is lit to a lamp through surfaces that are marked (manifold next event estimation, Hanika et
    al. 2015), from lamps and not from the world. Through a single surface it does not reach a lamp at infinity, so what
    lies in water would be black under a sun: a far disc of the same light takes the sun's place.
    """
    scene = bpy.context.scene
    scene.cycles.caustics_refractive = True
    for each in scene.objects:
        if each.type == "LIGHT":
            if each.data.type == "SUN":
                _become_far_disc(each, _FAR_DISC * domain_size, Vector(domain_middle))
            each.data.cycles.is_caustics_light = True
        elif each.name in caster_names:
            each.cycles.is_caustics_caster = True
        else:
            each.cycles.is_caustics_receiver = True


def _become_far_disc(sun: Any, distance: float, middle: Vector) -> None:
    """Replace a sun by a disc of its direction, size and light, so far from the middle of what it lights [m]."""
    disc = bpy.data.lights.new(sun.name, "AREA")
    disc.shape, disc.size = "DISK", 2.0 * distance * math.tan(0.5 * max(sun.data.angle, 1e-3))
    disc.color = sun.data.color
    # A lamp of power P that shines as Lambert's law says gives P / (pi d²) in front of it; a sun says what it gives.
    disc.energy = sun.data.energy * math.pi * distance**2
    sun.data = disc
    sun.location = middle + distance * (sun.rotation_quaternion @ Vector((0.0, 0.0, 1.0)))
