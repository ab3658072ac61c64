"""Cycles settings: what each quality preset means."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import bpy
from mathutils import Vector

from blender_scripts.compatibility import set_file_format


@dataclass(frozen=True)
class QualityPreset:
    """The knobs that trade time for quality; docs/guide/rendering.md has what each was measured to give.

    Attributes:
        samples: most samples per pixel.
        noise_threshold: a pixel whose estimated error is below this gets no more samples.
        denoising_quality: of OpenImageDenoise.
        denoising_prefilter: how the albedo and normal guides are cleaned; at few samples noisy guides print their
            noise into the picture, and cleaning them is cheap.
        light_tree: choose lights by what they contribute; pays for itself from some dozen samples on.
        volume_step_rate: length of the steps that rays march through volumes in, as a factor on the voxel size.
        volume_bounces: scattering events inside volumes after the first.
        max_bounces: of all kinds together.
        diffuse_bounces: off matt surfaces.
        transmission_bounces: through refracting surfaces.
    """

    samples: int
    noise_threshold: float
    denoising_quality: str
    denoising_prefilter: str
    light_tree: bool
    volume_step_rate: float
    volume_bounces: int
    max_bounces: int
    diffuse_bounces: int
    transmission_bounces: int


QUALITY_PRESETS = {
    "draft": QualityPreset(6, 0.1, "FAST", "ACCURATE", False, 2.0, 0, 6, 1, 6),
    "preview": QualityPreset(48, 0.05, "BALANCED", "ACCURATE", True, 2.0, 1, 10, 2, 10),
    "final": QualityPreset(256, 0.02, "HIGH", "ACCURATE", True, 1.0, 3, 24, 4, 16),
}

_CLEAN_SAMPLES = 16
"""Of an empty set, which is smooth: what is left of the noise after denoising is below a grey level or two."""

_FAR_DISC = 300.0
"""Distance of what stands for a sun, in diagonals of the domain: its light falls off by 1 % across two of them."""


def apply_render_settings(parameters: dict[str, Any], *, fps: float, threads: int) -> None:
    """Set resolution, time, motion blur, film, colour management and Cycles for the current scene.

    Args:
        parameters: `render` of the specification.
        fps: frames per second; shutter times and velocities depend on it.
        threads: CPU threads to render with.
    """
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
    """Save the next picture as a PNG in display values.

    Args:
        picture_format: `render.format`; what an EXR accompanies has 8 bits.
        with_alpha: whether it tells where nothing of the scene is seen.
    """
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
    preset = QUALITY_PRESETS[parameters["quality"]]
    cycles.samples = preset.samples if parameters["samples"] is None else parameters["samples"]
    cycles.use_adaptive_sampling = True
    cycles.adaptive_threshold = preset.noise_threshold
    # The same pattern in every frame: with a still camera, what noise is left stands still instead of boiling.
    cycles.seed = parameters["seed"]
    cycles.use_animated_seed = False
    cycles.use_denoising = parameters["denoise"]
    cycles.denoiser = "OPENIMAGEDENOISE"
    cycles.denoising_quality = preset.denoising_quality
    cycles.denoising_prefilter = preset.denoising_prefilter
    cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
    cycles.use_light_tree = preset.light_tree
    # Unbiased tracking takes a third of the time a sample, but cuts the blur of fast smoke off
    # (docs/guide/rendering.md), and prepares each frame for up to a minute of processor time.
    cycles.volume_biased = True
    cycles.volume_step_rate = preset.volume_step_rate
    cycles.volume_bounces = preset.volume_bounces
    cycles.max_bounces = preset.max_bounces
    cycles.diffuse_bounces = preset.diffuse_bounces
    cycles.glossy_bounces = 4
    cycles.transmission_bounces = preset.transmission_bounces
    cycles.transparent_max_bounces = 16
    # Looks let light through refracting bodies themselves; sampled caustics would only add fireflies.
    cycles.caustics_reflective = False
    cycles.caustics_refractive = False
    cycles.blur_glossy = 1.0
    cycles.sample_clamp_direct = 0.0
    cycles.sample_clamp_indirect = 6.0


@contextmanager
def small_and_clean(resolution: tuple[int, int]) -> Iterator[None]:
    """Draw in another size, with few samples that are denoised and without blur; then as before.

    Args:
        resolution: width and height [pixels].
    """
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


def leave_out_background() -> None:
    """Give what is drawn an alpha channel, 0 where nothing of the scene is seen."""
    bpy.context.scene.render.film_transparent = True
