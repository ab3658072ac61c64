"""The job file's schema: the scene's physics, and what is made of it."""

from typing import Annotated, Literal, Self

from pydantic import Field, PrivateAttr, model_validator

from pipeline.model.limits import LimitParameters
from pipeline.model.problems import unknown_name
from render.parameters import (
    CameraParameters,
    LightParameters,
    MaterialParameters,
    MovieParameters,
    RenderParameters,
    SetParameters,
    SurfaceParameters,
    VolumeParameters,
)
from sim.core.parameters import KeyRefusedError
from sim.scene import SceneParameters
from sim.whitewater.parameters import WhitewaterParameters

DEFAULT_FRAMES = 120
MAX_FRAMES = 1_000_000
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"


class Job(SceneParameters):
    """One film: what happens in it, and how it is shown."""

    version: Literal[1] = Field(default=1, description="Version of the job file's keys [-]; this program knows 1.")
    name: str = Field(pattern=NAME_PATTERN, description="Name of the job and of its folder under renders/.")
    fps: Annotated[int, Field(ge=1, le=1000)] = Field(default=60, description="Frames per second [1/s].")
    frames: Annotated[int, Field(ge=1, le=MAX_FRAMES)] | None = Field(
        default=None, description="Number of frames [-]; give this or duration."
    )
    duration: Annotated[float, Field(gt=0.0)] | None = Field(
        default=None, description="Length of the film [s]; give this or frames."
    )
    recorded: Annotated[str, Field(pattern=NAME_PATTERN)] | None = Field(
        default=None,
        description="The recording that its simulated frames are, as `pipeline live` writes it: nothing can compute "
        "them anew, and nothing tries.",
    )
    whitewater: dict[str, WhitewaterParameters] = Field(
        default_factory=dict,
        description="Spray, foam and bubbles of a fluid, by its name: [whitewater.water]; none if omitted.",
    )
    surface: SurfaceParameters = Field(default=SurfaceParameters(), description="Fluid surfaces.")
    volume: VolumeParameters = Field(default=VolumeParameters(), description="Smoke volumes.")
    material: dict[str, MaterialParameters] = Field(
        default_factory=dict,
        description='What each body looks like, by its name: [material.duck]; a part of one: [material."duck.bill"]; '
        'several at once: [material."ball*"], of which [material.ball7] may differ.',
    )
    set: SetParameters = Field(default=SetParameters(), description="The set: ground, background and their lights.")
    light: tuple[LightParameters, ...] = Field(default=(), description="Extra lights.")
    camera: CameraParameters = Field(default=CameraParameters(), description="The camera.")
    render: RenderParameters = Field(default=RenderParameters(), description="How frames are made.")
    movie: MovieParameters = Field(default=MovieParameters(), description="How frames become a film.")
    limits: dict[str, LimitParameters] = Field(
        default_factory=dict,
        description="When a stage's tasks are ended and tried again, by its name: [limits.render].",
    )

    _groups: dict[str, str] = PrivateAttr(default_factory=dict)

    @property
    def frame_count(self) -> int:
        """Number of frames; frame k shows t = k / fps, and frame 0 the start."""
        if self.frames is not None:
            return self.frames
        if self.duration is not None:
            return max(1, round(self.duration * self.fps))
        return DEFAULT_FRAMES

    @property
    def film_s(self) -> float:
        """Length of the film [s]."""
        return self.frame_count / self.fps

    @property
    def _named(self) -> frozenset[str]:
        """Names of all bodies, of whatever kind."""
        tables = (getattr(self, key) for key in type(self).model_fields if key != "joint")
        lists = (table for table in tables if isinstance(table, tuple))
        return frozenset(body.name for bodies in lists for body in bodies if hasattr(body, "name"))

    def limits_of(self, stage: str) -> LimitParameters:
        """Limits of the tasks of a stage: from the job file, else as is usual."""
        return self.limits.get(stage, LimitParameters())

    @property
    def has_panes(self) -> bool:
        """Whether there is a tank of glass to be seen: a side of the domain that is open has no pane."""
        return self.set.tank and not {"x-", "x+", "y-", "y+"} <= set(self.domain.open_faces)

    @property
    def moving_bodies(self) -> tuple[str, ...]:
        """Names of the rigid bodies whose pose changes from frame to frame."""
        return tuple(body.name for body in self.rigid if body.kind != "static")

    @property
    def groups(self) -> dict[str, str]:
        """The group of each body that is of one, by its name."""
        return self._groups

    @model_validator(mode="after")
    def _know_groups(self) -> Self:
        self._groups = {body.name: body.group for body in self.rigid if body.group != body.name}
        return self

    @property
    def placed_camera(self) -> CameraParameters:
        """The camera, with places for the bodies that stand still: what it sees of them never changes."""
        stands = {body.name: body.position for body in self.rigid if body.kind == "static"}
        named = {key: getattr(self.camera, key) for key in ("look_at", "focus")}
        places = {key: stands[name] for key, name in named.items() if isinstance(name, str) and name in stands}
        return self.camera.model_copy(update=places) if places else self.camera

    @model_validator(mode="after")
    def _camera_knows_its_bodies(self) -> Self:
        for key in ("look_at", "follow", "focus"):
            name = getattr(self.camera, key)
            if isinstance(name, str):
                self._require_body_of_camera(key, name)
        return self

    def _require_body_of_camera(self, key: str, name: str) -> None:
        path, rigid = ("camera", key), tuple(body.name for body in self.rigid)
        if name not in rigid and name in self._named:
            raise KeyRefusedError(path, f'"{name}" is no rigid body; its shape changes, so it has no one place')
        if key == "follow" and name in rigid and name not in self.moving_bodies:
            raise KeyRefusedError(path, f'"{name}" is static; set camera.look_at to look at it')
        known = self.moving_bodies if key == "follow" else rigid
        if name not in known:
            kind, plural = "rigid body", "rigid bodies"
            if key == "follow":
                kind, plural = "dynamic or kinematic rigid body", "moving bodies"
            raise KeyRefusedError(path, unknown_name(name, known, kind, plural=plural))

    @model_validator(mode="after")
    def _frames_or_duration(self) -> Self:
        if self.frames is not None and self.duration is not None:
            raise KeyRefusedError(("duration",), "give frames or duration, not both")
        if self.duration is not None and self.duration * self.fps > MAX_FRAMES:
            raise KeyRefusedError(
                ("duration",), f"{self.duration:g} s at {self.fps} fps are more than {MAX_FRAMES:,} frames"
            )
        return self
