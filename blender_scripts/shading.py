"""Building blocks of looks: node trees, the context of a look, and the registry of their functions."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import bpy

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
        box_min, box_max: corners of the smoke's grid [m].
        open_faces: sides that smoke may leave by, of `x-`, `x+` to `z+`.
        ambient_temperature: of the air, which the `temperature` grid is counted from [K].
    """

    box_min: tuple[float, float, float]
    box_max: tuple[float, float, float]
    open_faces: tuple[str, ...]
    ambient_temperature: float


@dataclass(frozen=True)
class LookContext:
    """What a look depends on; values of the job's material are None where the job leaves them to the look.

    Attributes:
        domain_size: diagonal of the domain [m].
        pixel_angle: width of a pixel at a distance of 1 m [m/m].
        smoke_box: of a volume.
        surface: what a texture hangs on.
        edges: of the box around a body at rest, in its own axes [m].
        name: of the body, whose texture and shade are its own; empty for the ground.
        wets: whether the mesh tells where it touches solids, as a fluid's does (`wetting`).
        is_covered: whether the mesh tells where a liquid covers it, as that of a vessel does.
        is_shared: whether bodies of several names have the material; each tells its own numbers (`tell_apart`).

    The others are as in `render.parameters.MaterialParameters`.
    """

    domain_size: float
    pixel_angle: float
    smoke_box: SmokeBox | None = None
    surface: SurfaceKind = "body"
    edges: tuple[float, float, float] | None = None
    name: str = ""
    wets: bool = False
    is_covered: bool = False
    is_shared: bool = False
    color: Color | None = None
    roughness: float | None = None
    caustics: bool | None = None
    density: float | None = None
    thread_spacing: float | None = None
    anisotropy: float | None = None
    edge_fade: float | None = None
    emission: float | None = None
    flame_temperature: float | None = None
    dye_color: Color | None = None

    @property
    def inner_density(self) -> float:
        """Density of a look that light goes into; a specification gives it to each object that has one."""
        assert self.density is not None, "the specification gives a density to looks that have an inside"
        return self.density

    def own_numbers(self, count: int) -> list[float]:
        """Numbers from -1 to 1 by the name of the body, its parts included: the same in every process and frame."""
        return own_numbers(self.name, count)

    def own_shade(self, color: Color, *, brightness: float, warmth: float) -> Color:
        """The body's own shade of a colour: so many stops brighter or darker at most, and warmer or cooler.

        Of a shared material the colour itself, which `NodeBuilder.own_tint` gives the shade of each body.
        """
        if self.is_shared:
            return color
        light, warm = self.own_numbers(2)
        stops = brightness * light + warmth * warm, brightness * light, brightness * light - warmth * warm
        red, green, blue = (min(1.0, channel * 2.0**each) for channel, each in zip(color, stops, strict=True))
        return red, green, blue

    @classmethod
    def of(cls, material: dict[str, Any], **scene: Any) -> LookContext:
        """The context for a material of the specification; `scene` are the fields that it does not decide."""
        own = {name: material.get(name) for name in ("color", *MATERIAL_KEYS)}
        for name in ("color", "dye_color"):
            if own[name] is not None:
                own[name] = tuple(own[name])
        return cls(**scene, **own)


OWN_NUMBERS = "own_numbers_{}"
"""Property of an object that tells so many numbers of its own."""
MOST_OWN_NUMBERS = 3


def own_numbers(name: str, count: int) -> list[float]:
    """Numbers from -1 to 1 by the name of a body, its parts included: the same in every process and frame."""
    if not name:
        return [0.0] * count
    body = name.partition(".")[0].encode()
    words = struct.unpack(f">{count}H", hashlib.blake2b(body, digest_size=2 * count).digest())
    return [word / 32767.5 - 1.0 for word in words]


def tell_apart(blender_object: Any, name: str) -> None:
    """Give an object with a shared material the numbers by which the look of its body, of this name, is its own."""
    for count in range(1, MOST_OWN_NUMBERS + 1):
        blender_object[OWN_NUMBERS.format(count)] = [*own_numbers(name, count), 0.0, 0.0][:MOST_OWN_NUMBERS]


class NodeBuilder:
    """Builds the node tree of a material or a world, or a group of nodes.

    Inputs of nodes are numbers, vectors, colours as three numbers, and output sockets of other nodes.
    """

    def __init__(self, owner: Any, output: str = "ShaderNodeOutputMaterial") -> None:
        self.tree = owner if isinstance(owner, bpy.types.NodeTree) else node_tree_of(owner)
        self._output = self.tree.nodes.new(output)

    def node(self, kind: str, **inputs: Any) -> Any:
        """A new node; inputs by socket name with underscores for blanks."""
        node = self.tree.nodes.new(kind)
        for name, value in inputs.items():
            self._set(node.inputs[name.replace("_", " ")], value)
        return node

    def link(self, source: Any, target: Any) -> None:
        """Connect an output socket to an input socket."""
        self.tree.links.new(source, target)

    def math(self, operation: str, *operands: Any) -> Any:
        """The output socket of a calculation with numbers."""
        return self._calculation("ShaderNodeMath", operation, operands).outputs[0]

    def vector_math(self, operation: str, *operands: Any) -> Any:
        """The output socket of a calculation with vectors."""
        outputs = self._calculation("ShaderNodeVectorMath", operation, operands).outputs
        return outputs["Value" if operation in ("DISTANCE", "DOT_PRODUCT", "LENGTH") else "Vector"]

    def scaled(self, vector: Any, factor: Any) -> Any:
        """The output socket of a vector or colour times a factor."""
        node = self._calculation("ShaderNodeVectorMath", "SCALE", (vector,))
        self._set(node.inputs["Scale"], factor)
        return node.outputs[0]

    def split(self, vector: Any) -> list[Any]:
        """The output sockets of a vector's three components."""
        return list(self.node("ShaderNodeSeparateXYZ", Vector=vector).outputs)

    def combined(self, x: Any, y: Any, z: Any = 0.0) -> Any:
        """The output socket of the vector of three components."""
        return self.node("ShaderNodeCombineXYZ", X=x, Y=y, Z=z).outputs[0]

    def noise(self, place: Any, **inputs: float) -> Any:
        """The output socket of a noise, about 0.5."""
        return self.node("ShaderNodeTexNoise", Vector=place, **inputs).outputs[0]

    def smoothstep(self, value: Any, low: float, high: float, *, start: float = 0.0, end: float = 1.0) -> Any:
        """The output socket of what goes smoothly from `start` at `low` to `end` at `high`."""
        node = self.node("ShaderNodeMapRange", Value=value, From_Min=low, From_Max=high, To_Min=start, To_Max=end)
        node.interpolation_type = "SMOOTHSTEP"
        return node.outputs[0]

    def ramp(self, factor: Any, *stops: tuple[float, tuple[float, ...]]) -> Any:
        """The output socket of a colour by a number: at least two places with their colours, in order."""
        node = self.tree.nodes.new("ShaderNodeValToRGB")
        elements = node.color_ramp.elements
        for place, _ in stops[1:-1]:
            elements.new(place)
        for element, (place, color) in zip(elements, stops, strict=True):
            element.position, element.color = place, (*color, 1.0)
        self._set(node.inputs[0], factor)
        return node.outputs["Color"]

    def mix_colors(self, factor: Any, first: Any, second: Any, **settings: Any) -> Any:
        """The output socket of the first colour where the factor is 0, the second where it is 1."""
        node = self.tree.nodes.new("ShaderNodeMix")
        node.data_type = "RGBA"
        for key, value in settings.items():
            setattr(node, key, value)
        # The node has a socket for every type of data, with equal names.
        colors = [socket for socket in node.inputs if socket.type == "RGBA"]
        for value, socket in zip((factor, first, second), (node.inputs[0], *colors), strict=True):
            self._set(socket, value)
        return next(socket for socket in node.outputs if socket.type == "RGBA")

    def mix_shaders(self, factor: Any, first: Any, second: Any) -> Any:
        """The node of the first shader where the factor is 0, the second where it is 1."""
        mix = self.tree.nodes.new("ShaderNodeMixShader")
        for value, socket in zip((factor, first.outputs[0], second.outputs[0]), mix.inputs, strict=True):
            self._set(socket, value)
        return mix

    def own_numbers(self, context: LookContext, count: int) -> list[Any]:
        """The numbers of a body, as `LookContext.own_numbers`; output sockets where several share the material."""
        if not context.is_shared:
            return list(context.own_numbers(count))
        node = self.tree.nodes.new("ShaderNodeAttribute")
        node.attribute_type, node.attribute_name = "OBJECT", OWN_NUMBERS.format(count)
        return self.split(node.outputs["Vector"])[:count]

    def own_tint(self, context: LookContext, color: Any, *, brightness: float, warmth: float) -> Any:
        """A colour in each body's own shade where several share the material, as `LookContext.own_shade` has it."""
        if not context.is_shared:
            return color
        light, warm = self.own_numbers(context, 2)
        middle = self.math("MULTIPLY", light, brightness)
        aside = self.math("MULTIPLY", warm, warmth)
        stops = self.math("ADD", middle, aside), middle, self.math("SUBTRACT", middle, aside)
        factors = self.combined(*(self.math("POWER", 2.0, each) for each in stops))
        return self.mix_colors(1.0, color, factors, blend_type="MULTIPLY", clamp_result=True)

    def surface(self, shader: Any) -> None:
        """Use a node's first output as the surface."""
        self.link(shader.outputs[0], self._output.inputs["Surface"])

    def volume(self, shader: Any) -> None:
        """Use a node's first output as the inside."""
        self.link(shader.outputs[0], self._output.inputs["Volume"])

    def geometry(self, node: Any) -> None:
        """Use a node's first output as what a group makes."""
        self.link(node.outputs[0], self._output.inputs["Geometry"])

    def _calculation(self, kind: str, operation: str, operands: tuple[Any, ...]) -> Any:
        node = self.tree.nodes.new(kind)
        node.operation = operation
        for operand, socket in zip(operands, node.inputs, strict=False):
            self._set(socket, operand)
        return node

    def _set(self, socket: Any, value: Any) -> None:
        if isinstance(value, bpy.types.NodeSocket):
            self.link(value, socket)
        else:
            socket.default_value = (*value, 1.0) if socket.type == "RGBA" else value


DrawLook = Callable[[NodeBuilder, LookContext], None]

LOOKS: dict[str, DrawLook] = {}  # the function that builds each look, by its name


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
