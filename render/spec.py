"""RenderSpec: all that Blender needs to draw a job's frames, as a JSON document.

The specification is the boundary between the project and Blender: `blender_scripts/render_frames.py` reads it with
the standard library alone. Paths are relative to the folder that holds the document; `{frame}` in a path stands for
the six-digit frame number.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, field_validator

from blender_scripts.optics import INSIDES
from render.camera_path import CameraPath
from render.parameters import (
    LightParameters,
    MaterialParameters,
    Parameters,
    RenderParameters,
    SetParameters,
    Vector3,
)

SPEC_VERSION: Literal[4] = 4


def _whole(material: MaterialParameters) -> MaterialParameters:
    if not material.is_whole:
        raise ValueError("an object needs a look or a material of a .blend file")
    if material.look in INSIDES and material.density is None:
        raise ValueError(f'an object of the look "{material.look}" needs a density')
    return material


Material = Annotated[MaterialParameters, AfterValidator(_whole)]


class MeshObject(Parameters):
    """A mesh that stays: one PLY file, placed once."""

    type: Literal["mesh"] = "mesh"
    name: str
    file: str
    position: Vector3 = (0.0, 0.0, 0.0)
    orientation: tuple[float, float, float, float] = Field(
        default=(1.0, 0.0, 0.0, 0.0), description="Unit quaternion w, x, y, z."
    )
    material: Material
    shade_smooth_angle_deg: float = Field(default=40.0, description="Edges sharper than this stay sharp [degrees].")


class MovingMeshObject(Parameters):
    """A mesh that moves as a whole: one PLY file, placed by the poses of each frame."""

    type: Literal["moving_mesh"] = "moving_mesh"
    name: str
    file: str
    body: str = Field(description="Name of the body in the poses; parts of one body share it.")
    poses: str = Field(description="Path with {frame} of a JSON document; see docs/guide/formats.md.")
    material: Material
    shade_smooth_angle_deg: float = Field(default=40.0, description="Edges sharper than this stay sharp [degrees].")


class MeshSequenceObject(Parameters):
    """A mesh that changes every frame: one PLY file a frame with `vx vy vz` [m/s] and `nx ny nz` per vertex.

    Looks of woven cloth need `s t` too.
    """

    type: Literal["mesh_sequence"] = "mesh_sequence"
    name: str
    file: str = Field(description="Path with {frame}.")
    material: Material
    wets_within: float | None = Field(
        default=None,
        gt=0.0,
        description="A fluid: how near its surface comes to the floor, bodies and cloths where it touches them [m].",
    )
    edges: Vector3 | None = Field(default=None, description="A cloth: of the box around it at rest [m].")


class PointSequenceObject(Parameters):
    """Points that change every frame: one kind of a whitewater PLY file a frame."""

    type: Literal["point_sequence"] = "point_sequence"
    name: str
    file: str = Field(description="Path with {frame}.")
    kind: Literal["spray", "foam", "bubbles"] = Field(description="Which of the file's points are drawn.")
    material: Material


class VolumeSequenceObject(Parameters):
    """A volume that changes every frame: one VDB file a frame with `density`, `temperature`, `velocity` [m/s]."""

    type: Literal["volume_sequence"] = "volume_sequence"
    name: str
    file: str = Field(description="Path with {frame}.")
    box_min: Vector3 = Field(description="Lower corner of the smoke's grid [m].")
    box_max: Vector3 = Field(description="Upper corner of the smoke's grid [m].")
    open_faces: tuple[str, ...] = Field(description="Sides that smoke may leave by: x-, x+, y-, y+, z-, z+.")
    ambient_temperature: float = Field(description="What the temperature grid is counted from [K].")
    material: Material


SceneObject = Annotated[
    MeshObject | MovingMeshObject | MeshSequenceObject | PointSequenceObject | VolumeSequenceObject,
    Field(discriminator="type"),
]


class Camera(Parameters):
    """The camera; if it moves, at its first frame, and documents say where it goes."""

    position: Vector3
    look_at: Vector3
    focal_length_mm: float = Field(gt=0.0)
    focus_distance: float = Field(gt=0.0, description="[m]")
    f_stop: float | None = Field(default=None, gt=0.0)
    longest_focal_length_mm: float = Field(gt=0.0, description="Of all frames.")
    views: str | None = Field(
        default=None, description="Path with {frame} of a JSON document; see docs/guide/formats.md."
    )
    distance_all_round: float | None = Field(
        default=None,
        ge=0.0,
        description="How far from the domain's middle it gets, if it sees what lies behind its first place [m].",
    )

    @classmethod
    def on(cls, path: CameraPath, *, f_stop: float | None, views: str) -> Camera:
        """The camera on a path; `views` is the path of the documents of one that moves."""
        return cls(
            **asdict(path.first()),
            f_stop=f_stop,
            longest_focal_length_mm=path.longest_focal_length(),
            views=views if path.moves else None,
            distance_all_round=path.distance_all_round(),
        )


class RenderSpec(Parameters):
    """Everything in front of the camera, and the camera."""

    version: Literal[4] = SPEC_VERSION
    fps: float = Field(gt=0.0)
    domain_min: Vector3
    domain_max: Vector3
    open_faces: tuple[str, ...] = Field(
        default=(),
        description="Sides of the domain without a wall: x-, x+, y-, y+, z-, z+; the tank has no pane there.",
    )
    camera: Camera
    set: SetParameters
    lights: tuple[LightParameters, ...] = ()
    objects: tuple[SceneObject, ...]
    render: RenderParameters
    engine: Literal["cycles", "workbench"] = Field(
        default="cycles", description="workbench: plain pictures at once, for animatics."
    )

    @field_validator("lights")
    @classmethod
    def _say_their_power(cls, lights: tuple[LightParameters, ...]) -> tuple[LightParameters, ...]:
        return tuple(light.with_power() for light in lights)

    def document(self) -> str:
        """The JSON document; the same specification gives the same text."""
        return self.model_dump_json(indent=1) + "\n"

    def write(self, path: Path) -> None:
        """Write the document."""
        path.write_text(self.document(), encoding="utf-8")
