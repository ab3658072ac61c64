"""Quantities of the solvers' diagnostics: names, units, plots.

The solvers name their diagnostics (`sim.core.solver.Diagnostics`); a name that is not known here is shown as it is.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

SHARE = "%"  # unit of numbers that are stored as fractions of 1 and shown in per cent


@dataclass(frozen=True, slots=True)
class Quantity:
    """Presentation of a number of the diagnostics."""

    name: str  # as the solvers write it
    label: str  # in words, without the unit
    unit: str  # in which it is stored, `SHARE` for fractions; empty for counts
    panel: str  # title of the plot that it belongs on, with others of its kind
    counted: bool = False  # it is a whole number

    @property
    def scale(self) -> float:
        """What a stored number is multiplied by to be in its unit."""
        return 100.0 if self.unit == SHARE else 1.0

    def text(self, value: float) -> str:
        """The number with its unit, to four digits."""
        if self.counted:
            return f"{value:,.0f}"
        if self.unit == SHARE:
            return f"{100.0 * value:.3g} %"
        return f"{value:.4g} {self.unit}".rstrip()


def quantity(name: str, *, of_kind: str | None = None) -> Quantity:
    """The quantity of a name in the diagnostics of a kind of body.

    The mass of smoke is an integral of its density, which has no unit.
    """
    found = _KNOWN.get(name)
    if found is None and name.startswith(COUNT_OF_FLUID):
        return Quantity(name, f"particles of {name.removeprefix(COUNT_OF_FLUID)}", "", _COUNT, counted=True)
    if found is None and name.startswith(APART_OF_JOINT):
        joint = name.removeprefix(APART_OF_JOINT)
        return Quantity(name, f'steps with "{joint}" apart', "", "Joints apart", counted=True)
    if found is None:
        label = name.replace("_", " ")
        return Quantity(name, label, "", label.capitalize())
    if of_kind == "smoke" and found.unit == "kg":
        return Quantity(name, found.label, "m³", "Smoke")
    return found


COUNT_OF_FLUID = "particle_count_"
"""Begins the name of the number of particles of one fluid among several in a tank; its name follows."""

MECHANICAL_ENERGY = "mechanical_energy"  # sum of `PARTS_OF_ENERGY`; not written by any solver
PARTS_OF_ENERGY = ("kinetic_energy", "potential_energy", "elastic_energy")

_ENERGY, _MOMENTUM, _ANGULAR, _MASS, _SPEED = "Energy", "Momentum", "Angular momentum", "Mass", "Largest speed"
_ITERATIONS, _ERROR, _COUNT = "Solver iterations", "Density and divergence error", "Particles"

_KNOWN = {
    each.name: each
    for each in (
        Quantity("substeps", "substeps", "", "Substeps per frame", counted=True),
        Quantity("smallest_dt_s", "smallest time step", "s", "Smallest time step"),
        Quantity("iterations", "iterations", "", _ITERATIONS),
        Quantity("divergence_iterations", "divergence iterations", "", _ITERATIONS),
        Quantity("viscosity_iterations", "viscosity iterations", "", _ITERATIONS),
        Quantity("density_error", "density error", SHARE, _ERROR),
        Quantity("divergence_error", "divergence error", SHARE, _ERROR),
        Quantity("viscosity_error", "viscosity error", SHARE, "Error of the viscosity solve"),
        Quantity("max_compression", "largest compression", SHARE, _ERROR),
        Quantity("residual", "residual", "", "Residual"),
        Quantity("divergence", "largest divergence", "1/s", "Divergence"),
        Quantity("compression", "compression of closed air", "1/s", "Compression of closed air"),
        Quantity("guide_correlation", "correlation with the guide", SHARE, "Correlation with the guide"),
        Quantity("cells", "cells of the window", "", "Cells of the window", counted=True),
        Quantity("not_converged", "solves at their iteration limit", "", "Solves at their limit", counted=True),
        Quantity("squeezed", "squeezed beyond 20 %", "", "Frames with squeezed particles", counted=True),
        Quantity("linear_solves", "solves made linear", "", "Solves made linear", counted=True),
        Quantity("particle_count", "particles", "", _COUNT, counted=True),
        Quantity("whitewater_particles", "whitewater particles", "", "Whitewater particles", counted=True),
        Quantity("whitewater_capped", "whitewater capped", "", "Particles not emitted", counted=True),
        Quantity("particles_removed", "particles that left the domain", "", "Particles that left", counted=True),
        Quantity("node_count", "nodes", "", "Cloth nodes", counted=True),
        Quantity("nodes_lost", "nodes out of sight", "", "Cloth nodes out of sight", counted=True),
        Quantity("bodies_lost", "bodies out of sight", "", "Bodies out of sight", counted=True),
        Quantity("joint_gap", "largest gap of a joint", "m", "Gap of joints"),
        Quantity("joints_apart", "steps with joints apart", "", "Joints apart", counted=True),
        Quantity("joints_broken", "joints broken", "", "Joints broken", counted=True),
        Quantity("particles_emitted", "particles emitted", "", _COUNT, counted=True),
        Quantity("emission_blocked", "emission blocked", "", "Particles not emitted", counted=True),
        Quantity("emission_capped", "emission capped", "", "Particles not emitted", counted=True),
        Quantity("contacts", "contacts", "", "Contacts", counted=True),
        Quantity("repaired_crossings", "crossings repaired", "", "Cloth crossings repaired", counted=True),
        Quantity("crossings_left", "crossings left", "", "Cloth crossings left", counted=True),
        Quantity("impact_zone_vertices", "nodes moved as one", "", "Cloth nodes moved as one", counted=True),
        Quantity("jammed", "cloth jammed", "", "Frames with jammed cloth", counted=True),
        Quantity("bodies_show", "bodies show through", "", "Frames with bodies in cloth", counted=True),
        Quantity("overlong_springs", "springs too long", "", "Cloth springs too long", counted=True),
        Quantity("max_strain", "largest strain", SHARE, "Strain"),
        Quantity("wall_contacts", "wall contacts", "", "Contacts", counted=True),
        Quantity("max_penetration", "deepest penetration", "m", "Penetration"),
        Quantity("neighbor_searches", "neighbour searches", "", "Neighbour searches per frame", counted=True),
        Quantity("max_speed", "largest speed", "m/s", _SPEED),
        Quantity("sound_speed", "numerical speed of sound", "m/s", "Numerical speed of sound"),
        Quantity("max_temperature", "highest temperature", "K", "Temperature"),
        Quantity(MECHANICAL_ENERGY, "mechanical energy", "J", _ENERGY),
        Quantity("kinetic_energy", "kinetic energy", "J", _ENERGY),
        Quantity("potential_energy", "potential energy", "J", _ENERGY),
        Quantity("elastic_energy", "elastic energy", "J", _ENERGY),
        Quantity("mass", "mass", "kg", _MASS),
        Quantity("emitted_mass", "emitted", "kg", _MASS),
        *(Quantity(f"momentum_{axis}", f"momentum {axis}", "kg m/s", _MOMENTUM) for axis in "xyz"),
        *(Quantity(f"angular_momentum_{axis}", f"angular momentum {axis}", "kg m²/s", _ANGULAR) for axis in "xyz"),
    )
}
"""In the order in which they are shown."""


def in_order(names: Iterable[str]) -> list[str]:
    """Names as they are shown: those that are known first."""
    known = list(_KNOWN)

    def place(name: str) -> tuple[int, str]:
        of_all = "particle_count" if name.startswith(COUNT_OF_FLUID) else name
        return known.index(of_all) if of_all in _KNOWN else len(known), name

    return sorted(names, key=place)


def with_energy(numbers: Mapping[str, float]) -> dict[str, float]:
    """A solver's numbers, and its mechanical energy where it tells its parts."""
    if not {"kinetic_energy", "potential_energy"} <= set(numbers):
        return dict(numbers)
    return {**numbers, MECHANICAL_ENERGY: sum(numbers.get(part, 0.0) for part in PARTS_OF_ENERGY)}


APART_OF_JOINT = "joints_apart_"
"""Begins the name of the number of steps in which one joint was apart; its name follows."""


@dataclass(frozen=True, slots=True)
class CountedEvent:
    """A number of the diagnostics that counts what should not happen."""

    name: str  # as the solvers write it
    one: str  # what has happened once
    many: str  # what has happened several times
    and_so: str = ""  # what follows either
    running_total: bool = False  # counted since the start; else in every frame by itself
    # what it means for the film and what helps, by kind of body
    means: Mapping[str, str] = field(default_factory=dict, hash=False)
    # the number that tells how bad it was, by kind of body: {worst} in what it means
    measured_by: Mapping[str, str] = field(default_factory=dict, hash=False)
    named_by: str = ""  # begins the names of numbers that are not 0 for whom it happened to; their names follow

    def text(self, count: int) -> str:
        """Count in words: `3 solves hit their iteration limit`."""
        return (f"1 {self.one}" if count == 1 else f"{count:,} {self.many}") + self.and_so


WARNINGS = (
    CountedEvent(
        "not_converged",
        "solve hit its iteration limit",
        "solves hit their iteration limit",
        means={
            "fluid": "it is denser there than density_tolerance asks, which shows as lost volume if it goes on; give "
            "more max_iterations or a smaller cfl",
            "smoke": "some air appears or vanishes, which hardly shows; give more projection_max_iterations",
            "rigid": "forces in a pile were not quite in balance there, so that it may tremble; bodies sank into each "
            "other by up to {worst}, which shows from about a hundredth of their size on. If it does, start them "
            "nearer to where they rest, set a restitution of 0, or densities less far apart",
        },
        measured_by={"rigid": "max_penetration"},
    ),
    CountedEvent(
        "squeezed",
        "frame has",
        "frames have",
        " particles squeezed by more than 20 %",
        means={
            "fluid": "where bodies or walls press fluid together, it bursts out a frame later; leave it a way out, or "
            "give a smaller particle_radius or cfl",
        },
    ),
    CountedEvent(
        "emission_blocked",
        "particle was not emitted, as its place was taken",
        "particles were not emitted, as their places were taken, or outside the domain",
    ),
    CountedEvent("emission_capped", "particle was", "particles were", " not emitted, as there are max_particles"),
    CountedEvent("whitewater_capped", "particle was", "particles were", " not made, as there are max_particles"),
    CountedEvent(
        "joints_apart",
        "step left joints apart",
        "steps left joints apart",
        means={
            "rigid": "joints ask for what no motion gives, by the largest gap that is told: bodies shake there; remove "
            "a joint of the loop, let a hinge be a ball, or move limits and motors so that they agree",
        },
        named_by=APART_OF_JOINT,
    ),
    CountedEvent("crossings_left", "crossing", "crossings", " of cloth could not be prevented"),
    CountedEvent(
        "jammed",
        "frame has",
        "frames have",
        " cloth so jammed that much of it moves as one, which is slow: give weaker wind, slower pins and bodies, or a "
        "larger thickness",
    ),
    CountedEvent(
        "bodies_show",
        "frame has",
        "frames have",
        " cloth deeper in a body than it is thick: give more substeps, a lighter body, fewer layers or a finer sheet",
    ),
    CountedEvent(
        "overlong_springs",
        "spring of a cloth is",
        "springs of cloth are",
        " half too long: give more substeps or iterations, or pin more nodes",
    ),
    CountedEvent(
        "nodes_lost",
        "node of a cloth fell out of sight and was stopped",
        "nodes of cloths fell out of sight and were stopped",
        running_total=True,
    ),
    CountedEvent(
        "bodies_lost",
        "body fell out of sight and was stopped",
        "bodies fell out of sight and were stopped",
        running_total=True,
    ),
)
"""Each is told when it first happens, and counted in `status` and in the report."""
