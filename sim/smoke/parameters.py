"""Smoke as a job file names it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from sim.core.domain import DomainParameters, Face, Faces
from sim.core.motion.parameters import (
    KeyframeParameters,
    RampPointParameters,
    placed_at_first_keyframe,
    require_ascending_times,
    strength_at,
)
from sim.core.parameters import BodyName, Fraction, KeyRefusedError, NonNegative, Parameters, Positive, Vector3
from sim.shapes.parameters import Placement

WHOLE = 1.0e-6  # part of a cell by which a box may be longer than its cells: 1 m / 0.02 m are 50, not 50.00000000000001
MOST_CELLS = 2**30  # of one smoke, 1024 along each edge: a job with more is refused, a file of more was never written
MOST_UPRES = 4  # cells of a guide over those of its smoke: coarser ones have hardly any motion of the film's
SEA_LEVEL_PRESSURE = 101325.0  # [Pa]
GAS_CONSTANT_OF_AIR = 287.05  # dry [J/(kg K)]
CELLS_PER_EDDY = 2.0  # eddies of gusts are at least so many cells wide: the grid carries nothing finer

Seed = Annotated[int, Field(ge=0, le=1_000_000_000)]


class SmokeSourceParameters(Placement):
    """A region that emits: inside it, each step brings the fields at least to these values, from the air's.

    It drives air and creates none. One that moves emits all along its way, whatever the steps.
    """

    density: Fraction = Field(default=1.0, description="Smoke density inside the source [-].")
    temperature: Positive = Field(default=450.0, description="Temperature inside the source [K].")
    fuel: Fraction = Field(
        default=0.0, description="Part of the gas inside that is fuel [-]; it burns as [smoke.fire] says."
    )
    fluctuation: Fraction = Field(
        default=0.2,
        description="How far its heat falls short of that, at random in space and time [-]; "
        "0 makes a plume as symmetric as its source.",
    )
    flicker: Fraction = Field(
        default=0.0, description="How far all of it falls short of its strength now and then, as a fire does [-]."
    )
    flicker_rate: Positive = Field(default=8.0, description="How often it flickers [1/s].")
    seed: Seed = Field(default=0, description="Of the random numbers of fluctuation and flicker.")
    velocity: Vector3 | None = Field(
        default=None,
        description="Velocity inside the source [m/s]; left to the flow if omitted. Of a source that moves: relative "
        "to it and turned with it; its own motion comes on top.",
    )
    start_s: NonNegative = Field(default=0.0, description="When it starts to emit [s].")
    end_s: Positive | None = Field(default=None, description="When it stops [s]; never if omitted.")
    ramp: tuple[RampPointParameters, ...] = Field(
        default=(),
        description="Its strength over time: linear between these points, and constant before and after them; "
        "1 if omitted.",
    )
    keyframe: tuple[KeyframeParameters, ...] = Field(
        default=(), description="Path of the source; it rests before the first and after the last keyframe."
    )
    interpolation: Literal["cubic", "linear"] = Field(
        default="cubic",
        description="Between keyframes. cubic: velocities are continuous; linear: they are constant and jump.",
    )
    follow: str | None = Field(
        default=None,
        description="Name of the rigid body that it is fixed to: position, rotation_deg and velocity are then along "
        "the body's own axes, from its shape's centre.",
    )

    @property
    def moves(self) -> bool:
        """Whether it may be elsewhere later."""
        return bool(self.keyframe) or self.follow is not None

    @model_validator(mode="before")
    @classmethod
    def _start_at_first_keyframe(cls, data: Any) -> Any:
        return placed_at_first_keyframe(data, "source")

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        if self.end_s is not None and self.end_s <= self.start_s:
            raise ValueError(f"end_s must be after start_s = {self.start_s:g} s, got {self.end_s:g} s")
        require_ascending_times(self.keyframe)
        if self.keyframe and self.follow is not None:
            raise ValueError(f'it follows "{self.follow}" and has keyframes; remove one of them')
        if "interpolation" in self.model_fields_set and not self.keyframe:
            raise ValueError(
                "interpolation has no meaning without keyframes; remove it or add [[smoke.source.keyframe]]"
            )
        require_ascending_times(self.ramp, "ramp")
        if "flicker_rate" in self.model_fields_set and not self.flicker:
            raise ValueError("flicker_rate has no meaning without flicker; remove it or give flicker")
        return self

    def emits_during(self, begin_s: float, end_s: float) -> bool:
        """Whether it emits in some part of a span of time [s]: no short source falls between two steps."""
        return self.start_s < end_s and (self.end_s is None or begin_s < self.end_s)

    def span_of(self, begin_s: float, end_s: float) -> tuple[float, float]:
        """The part of a span of time in which it emits [s]; there must be one."""
        return max(begin_s, self.start_s), end_s if self.end_s is None else min(end_s, self.end_s)

    def largest_strength(self, begin_s: float, end_s: float) -> float:
        """Largest strength by the ramp within a span of time [s]: what emission in ever shorter steps comes to."""
        inner = [point.strength for point in self.ramp if begin_s < point.time_s < end_s]
        return max(strength_at(self.ramp, begin_s), strength_at(self.ramp, end_s), *inner)


class TurbulenceParameters(Parameters):
    """Gusts that stir all air of the box: random accelerations that neither spread nor squeeze the air."""

    strength: NonNegative = Field(default=0.0, description="Root mean square of the acceleration [m/s²]; 0: none.")
    size: Positive = Field(default=0.2, description="Distance of neighbouring eddies [m].")
    rate: NonNegative = Field(default=2.0, description="How often they change [1/s]; 0: never.")
    seed: Seed = Field(default=0, description="Of their random numbers.")


class FireParameters(Parameters):
    """How the fuel burns that sources emit: what it heats, how much soot is left, how far the gas expands."""

    ignition_temperature: Positive = Field(
        default=600.0, description="Temperature from which on fuel burns [K]; wood gas takes fire at 550 to 700 K."
    )
    burn_rate: Positive = Field(
        default=2.0,
        description="Fuel that burns in a second [1/s]: pure fuel is burnt after 1 / burn_rate, so flames are as long "
        "as gas gets in that time.",
    )
    heat: NonNegative = Field(
        default=1500.0, description="By how much pure fuel is hotter once it is burnt [K]; in part, by that part."
    )
    soot: NonNegative = Field(default=0.5, description="Smoke that burning pure fuel makes: its density [-].")
    expansion: Fraction = Field(
        default=1.0,
        description="How much of the expansion of an ideal gas the heat of burning gives [-]: 1: volume grows with "
        "the temperature, 0: not at all, as in a closed box.",
    )


class SmokeParameters(Parameters):
    """Hot smoke in a box of cells: its sources, its physics and its numerics."""

    name: BodyName = Field(description="Name of the smoke, unique in the job.")
    source: tuple[SmokeSourceParameters, ...] = Field(min_length=1, description="Where the smoke comes from.")
    min: Vector3 | None = Field(default=None, description="Lower corner of its grid [m]; the domain's if omitted.")
    max: Vector3 | None = Field(default=None, description="Upper corner of its grid [m]; the domain's if omitted.")
    cell_size: Positive = Field(
        default=0.02,
        description="Edge of a cubic cell [m]; air passes through walls of bodies that are thinner than one.",
    )
    upres: Annotated[int, Field(ge=1, le=MOST_UPRES)] = Field(
        default=1,
        description="How many times longer the cells of a simulation are that guides it [-]: what goes where is as "
        "there, and this one adds what is smaller. 1: none does.",
    )
    open_faces: Faces = Field(
        default=("x-", "x+", "y-", "y+", "z+"), description="Sides through which air and smoke may pass."
    )
    grid: Literal["box", "window", "open"] = Field(
        default="box",
        description="Which cells are computed. box: all of its box. window: those around smoke, heat, sources and air "
        "in motion, within the box. open: the same, and only closed sides end the box: it is as large as it needs.",
    )
    ambient_temperature: Positive = Field(default=293.0, description="Temperature of the air [K].")
    buoyancy_density: NonNegative = Field(
        default=0.1, description="Weight alpha of the smoke: downward acceleration per density [m/s²]."
    )
    buoyancy_temperature: NonNegative | None = Field(
        default=None,
        description="Lift beta of heat: upward acceleration per kelvin [m/(s² K)]; if omitted that of an ideal gas, "
        "strength of gravity / ambient_temperature.",
    )
    vorticity_confinement: NonNegative = Field(
        default=0.3, description="Strength epsilon of the vorticity confinement [1/s]; 0 switches it off."
    )
    density_dissipation: NonNegative = Field(default=0.0, description="Rate at which smoke thins out [1/s].")
    cooling: NonNegative = Field(default=0.2, description="Rate at which it cools to the air's temperature [1/s].")
    radiative_cooling: NonNegative = Field(
        default=0.0,
        description="Rate at which gas as hot as the hottest source or flame cools by radiation, on top [K/s]; it "
        "falls with the fourth power of the excess over the air (Nguyen et al. 2002). Fires have some thousands.",
    )
    fire: FireParameters | None = Field(
        default=None, description="How the fuel of its sources burns; none has any if omitted."
    )
    wind: Vector3 = Field(
        default=(0.0, 0.0, 0.0),
        description="Velocity of the air at the start, and of what flows in through the open sides that it blows onto "
        "[m/s].",
    )
    turbulence: TurbulenceParameters = Field(default=TurbulenceParameters(), description="Gusts in the air.")
    advection: Literal["maccormack", "semi_lagrangian"] = Field(
        default="maccormack",
        description="maccormack: velocity to second order, clamped (Selle et al. 2008), smoke and heat by limited "
        "fluxes (Zalesak 1979); or semi_lagrangian, with smoke and heat by donor cells: both of first order.",
    )
    projection_tolerance: Positive = Field(
        default=1.0e-5, description="Largest divergence after the projection: max|div u| dx / max|u| [-]."
    )
    projection_max_iterations: int = Field(default=100, ge=1, description="Most iterations of the projection [-].")
    cfl: Positive = Field(default=2.0, le=10.0, description="Most cells that smoke may cross in a substep [-].")

    @model_validator(mode="after")
    def _has_open_sides(self) -> Self:
        if self.grid == "open" and not self.open_faces:
            raise KeyRefusedError(
                ("grid",), '"open" has no meaning where all sides are walls; name some in open_faces, or leave it out'
            )
        return self

    @model_validator(mode="after")
    def _can_burn(self) -> Self:
        fuelled = [number for number, source in enumerate(self.source) if source.fuel > 0.0]
        if self.fire is None:
            if fuelled:
                raise KeyRefusedError(
                    ("source", fuelled[0], "fuel"), "has no meaning without a fire; add [smoke.fire], or leave it out"
                )
            return self
        ignition = self.fire.ignition_temperature
        if not fuelled:
            raise KeyRefusedError(("fire",), "has nothing to burn; give a source fuel")
        if ignition <= self.ambient_temperature:
            raise KeyRefusedError(
                ("fire", "ignition_temperature"),
                f"{ignition:g} K is no more than the air's {self.ambient_temperature:g} K: fuel would burn at once",
            )
        if max(source.temperature for source in self.source) < ignition:
            raise KeyRefusedError(
                ("fire", "ignition_temperature"),
                f"{ignition:g} K is more than any source has: nothing takes fire; give one a higher temperature",
            )
        if self.fire.expansion > 0.0 and not self.open_faces:
            raise KeyRefusedError(
                ("fire", "expansion"),
                "has no room in a box without open faces, as its air cannot be compressed; set it to 0, or open a side",
            )
        return self

    @property
    def guide(self) -> SmokeParameters:
        """The smoke that guides it: in larger cells, with gusts that these can carry; as `--preview` draws it."""
        cell_size, gusts = self.upres * self.cell_size, self.turbulence
        if gusts.strength > 0.0:
            gusts = gusts.model_copy(update={"size": max(gusts.size, CELLS_PER_EDDY * cell_size)})
        return self.model_copy(update={"upres": 1, "cell_size": cell_size, "turbulence": gusts})

    @property
    def air_density(self) -> float:
        """Of the air without smoke, an ideal gas at sea level [kg/m³]."""
        return SEA_LEVEL_PRESSURE / (GAS_CONSTANT_OF_AIR * self.ambient_temperature)

    @property
    def hottest_excess(self) -> float:
        """Of the hottest source, or of what burns, over the air's temperature [K]; 0 if nothing is hotter than that."""
        hottest = [source.temperature for source in self.source]
        if self.fire is not None:
            fire = self.fire
            hottest += [
                max(source.temperature, fire.ignition_temperature) + fire.heat * source.fuel
                for source in self.source
                if source.fuel > 0.0
            ]
        return max(0.0, max(hottest) - self.ambient_temperature)

    def lift_per_kelvin(self, gravity: Vector3) -> float:
        """Upward acceleration beta for each kelvin of excess [m/(s² K)], under a gravity [m/s²]."""
        if self.buoyancy_temperature is not None:
            return self.buoyancy_temperature
        return math.hypot(*gravity) / self.ambient_temperature

    @property
    def windward_faces(self) -> tuple[Face, ...]:
        """Sides of the box that the wind blows onto from outside, open or not."""
        faces: tuple[tuple[Face, Face], ...] = (("x-", "x+"), ("y-", "y+"), ("z-", "z+"))
        return tuple(
            upper if speed < 0.0 else lower
            for (lower, upper), speed in zip(faces, self.wind, strict=True)
            if speed != 0.0
        )

    def wind_problem(self) -> str | None:
        """Why air that cannot be compressed cannot take this wind, with a remedy; None if it can."""
        for face in self.windward_faces:
            if face not in self.open_faces:
                return f'blows in through the side "{face}", which is closed; add it to open_faces, or turn the wind'
        if self.windward_faces and not set(self.open_faces) - set(self.windward_faces):
            return (
                f"lets air in through {', '.join(self.windward_faces)}, and no other side is open: as much must flow "
                "out, for air of constant density cannot be compressed; add a side on the lee to open_faces"
            )
        return None

    @staticmethod
    def cut_off_problem(faces: Sequence[Face]) -> str:
        """Why wind cannot blow in through sides behind which static solids shut air in, with a remedy."""
        return (
            f"blows in through {', '.join(faces)}, but solids that stand still cut air there off from every other open "
            "side: as much must flow out, for air of constant density cannot be compressed; leave a way around them, "
            "close the side, or turn the wind"
        )

    def corners(self, domain: DomainParameters) -> tuple[Vector3, Vector3]:
        """Lower and upper corner of its box [m]: its own, or the domain's where it names none.

        A box that is no whole number of cells long is rounded up, keeping its lower corner.
        """
        low, high = self.min or domain.min, self.max or domain.max
        ends = [a + n * self.cell_size for a, n in zip(low, self.cell_counts(domain), strict=True)]
        # What is whole but for rounding ends where it is said to, so that boxes side by side do not overlap.
        x, y, z = (b if end - b < WHOLE * self.cell_size else end for b, end in zip(high, ends, strict=True))
        return low, (x, y, z)

    def limits(self, domain: DomainParameters) -> tuple[Vector3, Vector3]:
        """Lower and upper corner of where it can be [m]: of its box, but without end at open sides of an open grid."""
        low, high = self.corners(domain)
        if self.grid != "open":
            return low, high
        a, b, c = (-math.inf if f"{n}-" in self.open_faces else end for n, end in zip("xyz", low, strict=True))
        d, e, f = (math.inf if f"{n}+" in self.open_faces else end for n, end in zip("xyz", high, strict=True))
        return (a, b, c), (d, e, f)

    def cell_counts(self, domain: DomainParameters) -> tuple[int, int, int]:
        """How many cells its box has along x, y, z; 1 where it has no length."""
        low, high = self.min or domain.min, self.max or domain.max
        x, y, z = (max(1, math.ceil((b - a) / self.cell_size - WHOLE)) for a, b in zip(low, high, strict=True))
        return x, y, z


def boxes_overlap(a: tuple[Vector3, Vector3], b: tuple[Vector3, Vector3]) -> bool:
    """Whether two boxes, given by their corners [m], have a volume in common."""
    (a_low, a_high), (b_low, b_high) = a, b
    return all(max(p, q) < min(r, s) for p, q, r, s in zip(a_low, b_low, a_high, b_high, strict=True))
