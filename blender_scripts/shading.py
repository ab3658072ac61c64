"""Building blocks of looks: a material's node tree, the context of a look, and the registry of their functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from blender_scripts.compatibility import node_tree_of
from blender_scripts.look_table import LOOK_TABLE, MATERIAL_KEYS

Color = tuple[float, float, float]
Value = TypeVar("Value")

SurfaceKind = Literal["body", "sheet", "ground"]
"""What a texture is fixed to, so that it does not swim: a body's axes, a sheet's coordinates at rest, or the ground."""


@dataclass(frozen=True)
class SmokeBox:
    """Box and air of a volume.

    Attributes:
        box_min: lower corner of the smoke's grid [m].
        box_max: upper corner [m].
        open_faces: sides that smoke may leave by, of `x-`, `x+` to `z+`.
        ambient_temperature: of the air, which the `temperature` grid is counted from [K].
    """

    box_min: tuple[float, float, float]
    box_max: tuple[float, float, float]
    open_faces: tuple[str, ...]
    ambient_temperature: float


@dataclass(frozen=True)
class LookContext:
    """Context of a look; values from the job are None where the job leaves them to the look.

    Attributes:
        domain_size: diagonal of the domain [m].
        pixel_angle: width of a pixel at a distance of 1 m [m/m].
        smoke_box: of a volume; None for everything else.
        surface: what a texture hangs on; see `SurfaceKind`.
        edges: of the box around a body at rest, in its own axes [m]; None for what is no body.
        wets: whether the mesh tells where it touches solids, as a fluid's does (`wetting`).
        color: base colour or tint from the job, linear RGB.
        roughness: from the job [-].
        caustics: whether light of lamps is bent, from the job.
        density: from the job; see `render.parameters.MaterialParameters`.
        thread_spacing: of woven cloth, from the job [m].
        anisotropy: of smoke, from the job [-].
        edge_fade: of smoke, from the job [m].
        emission: of fire, from the job [-].
        flame_temperature: of fire, from the job [K].
    """

    domain_size: float
    pixel_angle: float
    smoke_box: SmokeBox | None
    surface: SurfaceKind
    edges: tuple[float, float, float] | None
    wets: bool
    color: Color | None
    roughness: float | None
    caustics: bool | None
    density: float | None
    thread_spacing: float | None
    anisotropy: float | None
    edge_fade: float | None
    emission: float | None
    flame_temperature: float | None

    @classmethod
    def of(
        cls,
        parameters: dict[str, Any],
        *,
        domain_size: float,
        pixel_angle: float,
        smoke_box: SmokeBox | None = None,
        surface: SurfaceKind = "body",
        edges: tuple[float, float, float] | None = None,
        wets: bool = False,
    ) -> LookContext:
        """The context for a material of the specification; keys that it does not have are left to the look."""
        own = {name: parameters.get(name) for name in _FROM_THE_JOB}
        if own["color"] is not None:
            own["color"] = tuple(own["color"])
        return cls(
            domain_size=domain_size,
            pixel_angle=pixel_angle,
            smoke_box=smoke_box,
            surface=surface,
            edges=edges,
            wets=wets,
            **own,
        )


_FROM_THE_JOB = ("color", *MATERIAL_KEYS)


class NodeBuilder:
    """A material's node tree, with the steps that looks take made short."""

    def __init__(self, material: Any) -> None:
        self.material = material
        self.tree = node_tree_of(material)
        self.output = self.tree.nodes.new("ShaderNodeOutputMaterial")

    def node(self, kind: str, **inputs: float | Color) -> Any:
        """A new node; inputs by socket name with underscores for blanks, colours as three numbers."""
        node = self.tree.nodes.new(kind)
        for name, value in inputs.items():
            socket = node.inputs[name.replace("_", " ")]
            socket.default_value = (*value, 1.0) if isinstance(value, tuple) and socket.type == "RGBA" else value
        return node

    def link(self, source: Any, target: Any) -> None:
        """Connect an output socket to an input socket."""
        self.tree.links.new(source, target)

    def math(self, operation: str, *operands: Any) -> Any:
        """The output socket of a calculation; operands are numbers and output sockets."""
        node = self.tree.nodes.new("ShaderNodeMath")
        node.operation = operation
        for operand, socket in zip(operands, node.inputs, strict=False):
            if isinstance(operand, int | float):
                socket.default_value = operand
            else:
                self.link(operand, socket)
        return node.outputs[0]

    def vector_math(self, operation: str, *operands: Any) -> Any:
        """The output socket of a calculation with vectors; operands are tuples and output sockets."""
        node = self.tree.nodes.new("ShaderNodeVectorMath")
        node.operation = operation
        for operand, socket in zip(operands, node.inputs, strict=False):
            if isinstance(operand, tuple):
                socket.default_value = operand
            else:
                self.link(operand, socket)
        return node.outputs[0]

    def mix_colors(self, factor: Any, first: Any, second: Any) -> Any:
        """The output socket of the first colour where the factor is 0, the second where it is 1."""
        node = self.tree.nodes.new("ShaderNodeMix")
        node.data_type = "RGBA"
        # The node has a socket for every type of data, with equal names.
        first_socket, second_socket = (socket for socket in node.inputs if socket.type == "RGBA")
        for value, socket in ((factor, node.inputs[0]), (first, first_socket), (second, second_socket)):
            if isinstance(value, tuple):
                socket.default_value = (*value, 1.0)
            else:
                self.link(value, socket)
        return next(socket for socket in node.outputs if socket.type == "RGBA")

    def surface(self, shader: Any) -> None:
        """Use a node's first output as the surface."""
        self.link(shader.outputs[0], self.output.inputs["Surface"])

    def volume(self, shader: Any) -> None:
        """Use a node's first output as the inside."""
        self.link(shader.outputs[0], self.output.inputs["Volume"])


DrawLook = Callable[[NodeBuilder, LookContext], None]

LOOKS: dict[str, DrawLook] = {}
"""The function that builds each look, by its name."""


def draws(name: str) -> Callable[[DrawLook], DrawLook]:
    """Register a function as the one that builds a look, which has a row in the table."""
    if name not in LOOK_TABLE:
        raise KeyError(f'the look "{name}" has no row in blender_scripts/look_table.py')

    def register(function: DrawLook) -> DrawLook:
        LOOKS[name] = function
        return function

    return register


def or_default(value: Value | None, default: Value) -> Value:
    """The value, or a look's own where the job gives none."""
    return default if value is None else value


def mix_shaders(builder: NodeBuilder, factor: Any, first: Any, second: Any) -> Any:
    """The first shader where the factor is 0, the second where it is 1."""
    mix = builder.node("ShaderNodeMixShader")
    builder.link(factor, mix.inputs[0])
    builder.link(first.outputs[0], mix.inputs[1])
    builder.link(second.outputs[0], mix.inputs[2])
    return mix
