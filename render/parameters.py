"""Parameters of surfaces, volumes, pictures and films, as a job file names them. No heavy import."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from blender_scripts.look_table import LOOK_TABLE

Vector3 = tuple[float, float, float]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Color = tuple[Fraction, Fraction, Fraction]
Quality = Literal["draft", "preview", "final"]

if TYPE_CHECKING:
    Look = str
    GroundLook = str
else:
    # Names of the table's rows; type checkers see texts, as a Literal of theirs can only be spelled out.
    Look = Literal[tuple(name for name, row in LOOK_TABLE.items() if row.bodies)]
    GroundLook = Literal[tuple(name for name, row in LOOK_TABLE.items() if row.paves)]


class Parameters(BaseModel):
    """Frozen, strict about unknown keys and about NaN; units stand in each field's description."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class SurfaceParameters(Parameters):
    """How particles become a surface and spray (Löschner et al. 2023, splashsurf)."""

    smoothing_length_in_radii: Positive = Field(default=2.0, description="SPH smoothing length [particle radii].")
    cube_size_in_radii: Positive = Field(default=0.75, description="Edge of a marching-cubes cell [particle radii].")
    threshold: Positive = Field(default=0.6, description="Iso-value of the density, relative to the rest density [-].")
    mesh_smoothing_iterations: int = Field(default=25, ge=0, description="Weighted Laplacian smoothing passes [-].")
    normals_smoothing_iterations: int = Field(default=10, ge=0, description="Smoothing passes on the normals [-].")
    drop_diameter: Positive = Field(
        default=2.7e-3,
        description="Mean diameter of the drops that spray breaks up into [m]; the capillary length of water.",
    )
    drops_per_particle: int = Field(
        default=16,
        ge=0,
        le=1000,
        description="Most drops that a particle of spray is drawn as, and twice what a usual one is; they are larger "
        "than `drop_diameter` where it would take more. 0: nothing breaks up, and lone particles are drawn as balls. "
        "[-]",
    )

    @property
    def of_meshes(self) -> dict[str, Any]:
        """The keys that decide a surface, as JSON values: all but those of drops."""
        return self.model_dump(mode="json", exclude={"drop_diameter", "drops_per_particle"})


class VolumeParameters(Parameters):
    """How smoke is written to OpenVDB."""

    tolerance: NonNegative = Field(default=1.0e-4, description="Densities below this are empty space [-].")
    half_precision: bool = Field(default=True, description="Store 16-bit floats.")


class CameraKeyframeParameters(Parameters):
    """Where the camera is at one time."""

    time_s: NonNegative = Field(description="Time [s]; later than that of the keyframe before.")
    position: Vector3 = Field(description="Where it is [m].")
    look_at: Vector3 | None = Field(default=None, description="What it looks at [m]; as without keyframes if omitted.")
    focal_length_mm: Positive | None = Field(default=None, description="Focal length [mm]; the camera's if omitted.")


class CameraParameters(Parameters):
    """The camera: still, along keyframes, around what it looks at, or with a body.

    Without a position it frames the whole domain, or all that happens, from the front.
    """

    position: Vector3 | None = Field(
        default=None, description="Where it stands [m]; where it sees all that `framing` names if omitted."
    )
    framing: Literal["domain", "action"] = Field(
        default="domain",
        description="What it frames without a position. domain: the whole domain, and bodies and smoke beside it; "
        "action: all that moves or stands there over the whole film, without a few outlying particles. Then pictures "
        "wait for the simulation's end.",
    )
    look_at: Vector3 | str | None = Field(
        default=None,
        description="What it looks at: a point [m], or a rigid body by its name; the domain's middle if omitted.",
    )
    focal_length_mm: Positive = Field(default=50.0, description="Focal length on a 36 mm sensor [mm].")
    f_stop: Positive | None = Field(default=None, description="Aperture; everything is in focus if omitted.")
    focus: Vector3 | str | None = Field(
        default=None,
        description="What is in focus: a point [m], or a rigid body by its name; the point that it looks at if "
        "omitted.",
    )
    follow: str | None = Field(default=None, description="Name of the moving body that it travels along with.")
    orbit_deg_per_s: float = Field(
        default=0.0,
        description="How fast it goes around what it looks at, counter-clockwise from above if positive [degrees/s].",
    )
    keyframe: tuple[CameraKeyframeParameters, ...] = Field(
        default=(), description="Where it is at which time; it stands still before the first and after the last."
    )
    easing: Literal["smooth", "linear"] = Field(
        default="smooth",
        description="Between keyframes. smooth: starts and stops gently, without overshoot; linear: at constant speed.",
    )

    @property
    def moves(self) -> bool:
        """Whether its view differs from frame to frame."""
        with_body = self.follow is not None or isinstance(self.focus, str) or isinstance(self.look_at, str)
        return bool(self.keyframe) or self.orbit_deg_per_s != 0.0 or with_body

    @property
    def frames(self) -> bool:
        """Whether it stands where it sees all of something."""
        return self.position is None and not self.keyframe

    @property
    def frames_action(self) -> bool:
        """Whether its place depends on what happens in the film."""
        return self.framing == "action"

    @model_validator(mode="after")
    def _is_one_motion(self) -> Self:
        if self.frames_action and (self.keyframe or self.position is not None):
            place = "keyframes" if self.keyframe else "a position"
            raise ValueError(
                f'framing = "action" has no meaning beside {place}, which say where the camera is; remove one of them, '
                'or set framing = "domain"'
            )
        if self.frames_action and (self.follow is not None or self.look_at is not None):
            key = "look_at" if self.follow is None else "follow"
            raise ValueError(
                f'framing = "action" has no meaning beside {key}, which turns the view away from what it frames; '
                'remove one of them, or set framing = "domain"'
            )
        if self.keyframe and self.orbit_deg_per_s:
            raise ValueError("orbit_deg_per_s has no meaning beside keyframes; remove one of them")
        if self.keyframe and self.position is not None:
            raise ValueError("position has no meaning beside keyframes, which say where the camera is; remove it")
        if isinstance(self.look_at, str) and any(key.look_at is not None for key in self.keyframe):
            raise ValueError(
                "look_at of a keyframe has no meaning beside a body that the camera looks at; remove one of them"
            )
        if not self.keyframe and self.easing != "smooth":
            raise ValueError("easing has no meaning without keyframes; remove it or add [[camera.keyframe]]")
        if self.focus is not None and self.f_stop is None:
            raise ValueError("focus has no effect without f_stop, such as f_stop = 2.8")
        for number, (before, after) in enumerate(pairwise(self.keyframe), start=1):
            if after.time_s <= before.time_s:
                raise ValueError(
                    f"keyframe[{number}].time_s must be after {before.time_s:g} s, that of the keyframe before, "
                    f"got {after.time_s:g} s"
                )
        return self


LightType = Literal["area", "point", "sun"]

MOST_SUN_DEG = 180.0
USUAL_POWER: dict[LightType, float] = {"area": 100.0, "point": 100.0, "sun": 5.0}
"""Of a light that the job gives none [W], of a sun [W/m²]: that of the set `outdoor` has 5.5."""


class LightParameters(Parameters):
    """An extra light."""

    type: LightType = Field(default="area", description="Kind of light.")
    position: Vector3 = Field(description="Where it stands [m]; of a sun only the direction counts.")
    look_at: Vector3 = Field(default=(0.0, 0.0, 0.0), description="What it shines at [m].")
    power: Positive | None = Field(
        default=None, description="Power [W]; for a sun, irradiance [W/m²]. 100 W if omitted, 5 W/m² for a sun."
    )
    size: Positive = Field(
        default=0.5, description="Edge of an area light, radius of a point light [m]; angle across a sun [degrees]."
    )
    color: Color = Field(default=(1.0, 1.0, 1.0), description="Linear RGB.")

    @property
    def power_that_counts(self) -> float:
        """Power, or what is usual for its type [W]; for a sun [W/m²]."""
        return USUAL_POWER[self.type] if self.power is None else self.power

    def with_power(self) -> Self:
        """The same light with a power that is said."""
        return self.model_copy(update={"power": self.power_that_counts})

    @model_validator(mode="after")
    def _is_no_larger_than_the_sky(self) -> Self:
        if self.type == "sun" and self.size > MOST_SUN_DEG:
            raise ValueError(f"size of a sun is an angle of at most {MOST_SUN_DEG:g} degrees, got {self.size:g}")
        return self


class SetParameters(Parameters):
    """The set: ground, background and the lights that come with them."""

    name: Literal["studio", "outdoor", "night", "window"] = Field(
        default="studio",
        description="studio: cyclorama with key, fill and rim lights; outdoor: ground, sky and sun; night: ground, "
        "a dark sky and a moon behind the domain; window: a room with soft light from a large window at the left.",
    )
    strength: Positive = Field(default=1.0, description="Factor on all of its lights [-].")
    sun_elevation_deg: Annotated[float, Field(gt=0.0, le=90.0)] = Field(
        default=38.0, description="Outdoor: how high the sun stands above the horizon [degrees]."
    )
    sun_azimuth_deg: float | None = Field(
        default=None,
        description="Outdoor: where the sun stands, counter-clockwise from above [degrees]: 0 towards +x, 90 towards "
        "+y; at the left and behind the scene, as the camera sees it at first, if omitted.",
    )
    color: Color | None = Field(
        default=None,
        description="Colour of the ground and backdrop, linear RGB; the set's own if omitted, or that of the look in "
        "ground.",
    )
    ground: GroundLook | None = Field(
        default=None, description="Look of the ground, and of a backdrop that it curves up into; matt if omitted."
    )
    background: Literal["set", "plain", "transparent"] = Field(
        default="set",
        description="set: as it is; plain: exactly the set's colour behind everything; transparent: frames have an "
        "alpha channel, and the film, which can have none, is laid over black. Of the ground only the shadows on it "
        "are seen in the last two.",
    )
    hdri: str | None = Field(
        default=None,
        description="Picture of the whole sphere around the scene, .hdr or .exr, relative to the job file: light and "
        "sky come from it, above the ground, in place of those of name.",
    )
    rotation_deg: float = Field(
        default=0.0, description="How far the hdri is turned, counter-clockwise from above [degrees]."
    )
    backplate: str | None = Field(
        default=None,
        description="Picture behind everything, .jpg or .png, relative to the job file: the camera alone sees it, as "
        "it is, as large as fills the frame. Of the ground only the shadows are seen; light and reflections are the "
        "set's.",
    )
    tank: bool = Field(
        default=False, description="Show the domain's walls as a glass tank; its open_faces have no pane."
    )

    @property
    def is_seen(self) -> bool:
        """Whether ground and sky themselves are in the picture."""
        return self.background == "set" and self.backplate is None

    @model_validator(mode="after")
    def _has_one_background(self) -> Self:
        if self.backplate is not None and self.background != "set":
            raise ValueError(f'background = "{self.background}" leaves no place for backplate; remove one of them')
        return self


class MaterialParameters(Parameters):
    """What a body looks like: a look, or a material of one's own.

    Without either, the keys that are given change what the body looks like by itself.
    """

    look: Look | None = Field(default=None, description="Name of the look; the body's own if omitted, or blend.")
    blend: str | None = Field(
        default=None,
        description='Material of a .blend file, relative to the job file: "materials.blend:Old gold". Its pictures '
        "must be packed into the file; drivers and key frames of it are left out.",
    )
    color: Color | None = Field(default=None, description="Base colour or tint, linear RGB; the look's own if omitted.")
    roughness: Fraction | None = Field(default=None, description="Roughness [-]; the look's own if omitted.")
    density: Positive | None = Field(
        default=None,
        description="Smoke and fire: extinction per metre at density 1 [1/m]. Factor on the absorption of water, wine, "
        "oil, coffee and ink, on the absorption and scattering of honey, on the scattering of milk, juice and muddy "
        "water [-]. By the body's size if omitted.",
    )
    caustics: bool = Field(
        default=False,
        description="Clear liquids, honey and glass: bend the light of lamps onto what lies around, instead of letting "
        "it straight through; docs/guide/rendering.md has what it costs.",
    )
    thread_spacing: Positive | None = Field(
        default=None, description="Woven cloth: distance of its threads [m]; the look's own if omitted."
    )
    anisotropy: Annotated[float, Field(ge=-0.95, le=0.95)] | None = Field(
        default=None,
        description="Smoke and fire: mean cosine of the angle that light is scattered by [-]; 0.3 if omitted.",
    )
    edge_fade: NonNegative | None = Field(
        default=None,
        description="Smoke and fire: width over which they fade out at the open faces of their box [m]; 0 shows the "
        "cut, 8 % of the box's shortest edge if omitted.",
    )
    emission: NonNegative | None = Field(
        default=None,
        description="Fire: radiance of flames so thick that nothing shines through, at flame_temperature [-], where a "
        "white wall in full light has 1; the look's own if omitted.",
    )
    flame_temperature: Annotated[float, Field(ge=800.0, le=4000.0)] | None = Field(
        default=None,
        description="Fire: temperature that glows as emission says [K]; 1500 if omitted. What is hotter or colder "
        "glows more or less as a black body does.",
    )

    dye_color: Color | None = Field(
        default=None,
        description="Liquids and soft matter: colour where dye has the concentration 1, linear RGB, beside color, "
        "that of the concentration 0. In clear liquids dye takes light away by how much of it lies behind; everywhere "
        "else they mix evenly on the surface, and on grains.",
    )

    @field_validator("blend")
    @classmethod
    def _names_a_material(cls, blend: str | None) -> str | None:
        file, separator, name = (blend or "").partition(".blend:")
        if blend is not None and not (file and separator and name):
            raise ValueError('must name a file and a material in it, such as "materials.blend:Old gold"')
        return blend

    @model_validator(mode="after")
    def _is_one_material(self) -> Self:
        if self.look is not None and self.blend is not None:
            raise ValueError("give look or blend, one of them")
        if not self.model_fields_set:
            raise ValueError('says nothing; give a key, such as look = "metal"')
        return self

    @property
    def is_whole(self) -> bool:
        """Whether it says what to draw, and not only how that differs from something else."""
        return self.look is not None or self.blend is not None

    def upon(self, usual: MaterialParameters) -> MaterialParameters:
        """This material, or another one with the keys of this where this names none itself."""
        if self.is_whole:
            return self
        return usual.model_copy(update={key: getattr(self, key) for key in self.model_fields_set})


RenderDevice = Literal["auto", "cpu", "gpu", "optix", "cuda", "hip", "oneapi", "metal"]

RenderPass = Literal["depth", "vector", "normal", "cryptomatte", "denoising"]


class RenderParameters(Parameters):
    """How frames are made."""

    resolution: tuple[Annotated[int, Field(ge=16, le=16384)], Annotated[int, Field(ge=16, le=16384)]] = Field(
        default=(1280, 720), description="Width and height [pixels]; even numbers, as video needs them."
    )
    quality: Quality = Field(default="preview", description="Preset for samples, noise threshold and denoising.")
    samples: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="Most samples per pixel; the preset's if omitted."
    )
    denoise: bool = Field(default=True, description="Denoise with OpenImageDenoise.")
    motion_blur: bool = Field(default=True, description="Blur what moves while the shutter is open.")
    shutter: Fraction = Field(default=0.5, description="Time the shutter is open [frames].")
    exposure: float = Field(default=0.0, description="Exposure [stops].")
    seed: int = Field(default=0, ge=0, lt=2**31, description="Seed of the sampling pattern.")
    device: RenderDevice = Field(
        default="auto",
        description="What Cycles renders on. auto: GPUs where there are any, else the processor; gpu: GPUs of whatever "
        "kind; optix and cuda: NVIDIA's, hip: AMD's, oneapi: Intel's, metal: Apple's.",
    )
    format: Literal["png", "png16", "exr"] = Field(
        default="png",
        description="png: 8 bits a channel, as the display shows them; png16: the same in 16 bits; exr: an OpenEXR "
        "master of half floats, linear light without the view's transform, beside the PNG that the film is made of.",
    )
    passes: tuple[RenderPass, ...] = Field(
        default=(),
        description="Of the EXR: depth [m], vector: motion to the frames before and after [pixels], normal, "
        "cryptomatte of objects and materials, denoising: the noisy picture, its albedo and normals.",
    )
    order: Literal["film", "spread"] = Field(
        default="film",
        description="Which frames go first. film: from the first to the last; spread: the first, the last, the middle, "
        "then between these, to see all of a film early. Changes no frame.",
    )
    blender: str | None = Field(
        default=None,
        description="Path of a Blender executable; the bpy module if omitted. Counts only with --set or "
        "PIPELINE_BLENDER, as a job file runs no program.",
    )

    @property
    def has_master(self) -> bool:
        """Whether there is an EXR beside each PNG."""
        return self.format == "exr"

    @property
    def reach_of_motion(self) -> float:
        """How far before and after a frame it matters where things are [frames]: for blur, or vectors."""
        if "vector" in self.passes:
            return 1.0
        return 0.5 * self.shutter if self.motion_blur else 0.0

    @model_validator(mode="after")
    def _passes_have_a_place(self) -> Self:
        if self.passes and not self.has_master:
            raise ValueError('passes need format = "exr"; a PNG holds the picture alone')
        if len(set(self.passes)) < len(self.passes):
            raise ValueError("passes names one of them twice")
        if "vector" in self.passes and self.motion_blur:
            raise ValueError('the pass "vector" needs motion_blur = false: what is blurred moves in many ways at once')
        return self


Codec = Literal["h264", "h265", "av1", "prores"]

USUAL_CRF = {"h264": 16, "h265": 18, "av1": 20}
"""Within 2 dB of each other on the quickstart; docs/guide/rendering.md has the table."""
HIGHEST_CRF = {"h264": 51, "h265": 51, "av1": 63}
HIGHEST_FPS: dict[Codec, float] = {"av1": 240.0}
"""Frames a second that a codec's encoder takes; the others take whatever a job may have [1/s]."""


class MovieParameters(Parameters):
    """How frames become a film."""

    codec: Codec = Field(
        default="h264",
        description="h264: plays everywhere; h265: 10 bits, smaller; av1: 10 bits, free of licences; prores: 422 HQ, "
        "10 bits, a large .mov for editing.",
    )
    crf: Annotated[int, Field(ge=0, le=63)] | None = Field(
        default=None,
        description="Constant rate factor; smaller is better and larger. h264 and h265: up to 51, av1: up to 63; "
        "16, 18 and 20 if omitted. prores has none.",
    )
    preset: Literal["ultrafast", "veryfast", "fast", "medium", "slow", "veryslow"] = Field(
        default="medium", description="Speed against size; prores has none."
    )
    playback_fps: Annotated[float, Field(ge=0.01, le=1000.0)] | None = Field(
        default=None,
        description="Frames a second of the film [1/s]; the job's fps if omitted (less is slow motion). av1 has 240 at "
        "most.",
    )
    so_far: bool = Field(
        default=True,
        description="While frames are drawn, keep a small film of those that are there, movie-so-far.mp4.",
    )

    @property
    def suffix(self) -> str:
        """Of the film's file."""
        return ".mov" if self.codec == "prores" else ".mp4"

    @property
    def rate_factor(self) -> int | None:
        """The constant rate factor that counts; None for a codec that has none."""
        return USUAL_CRF.get(self.codec) if self.crf is None else self.crf

    @model_validator(mode="after")
    def _codec_has_these_keys(self) -> Self:
        if self.codec == "prores":
            for key in ("crf", "preset"):
                if key in self.model_fields_set:
                    raise ValueError(f"{key} has no meaning for prores, which has one quality; remove it")
        elif self.crf is not None and self.crf > HIGHEST_CRF[self.codec]:
            raise ValueError(f"crf of {self.codec} is at most {HIGHEST_CRF[self.codec]}, got {self.crf}")
        return self
