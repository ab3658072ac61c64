"""What soft matter can be made of: laws, and the parameters that materials have by themselves.

Elastic laws are isotropic, of the left Cauchy-Green tensor; plastic ones yield in its principal directions
(`sim.soft.laws`).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Law(IntEnum):
    """How a material answers to being strained."""

    ELASTIC = 0  # neo-Hookean
    SAND = 1  # Hencky strains, Drucker-Prager
    SNOW = 2  # fixed corotated, breaks beyond critical stretches, hardens
    CLAY = 3  # Hencky strains, von Mises, flows as Herschel and Bulkley say


@dataclass(frozen=True)
class MaterialRow:
    """A material by name: its law, and usual values of the parameters that a job may give instead."""

    law: Law
    density: float  # at rest [kg/m³]
    young_modulus: float  # [Pa]
    poisson_ratio: float  # [-]
    friction_angle_deg: float | None = None  # SAND [degrees]
    cohesion: float | None = None  # SAND: shear stress that it bears without pressure [Pa]
    yield_stress: float | None = None  # CLAY [Pa]
    viscosity: float | None = None  # CLAY, beyond its yield stress [Pa s^n], n its
    flow_exponent: float | None = None  # CLAY [-]
    critical_compression: float | None = None  # SNOW: shortening, and
    critical_stretch: float | None = None  # SNOW: lengthening beyond which it breaks [-]
    hardening: float | None = None  # SNOW [-]
    fracture_energy: float | None = None  # SNOW: that tears it apart, a face [J/m²]; never torn without
    about: str = ""


MATERIALS: dict[str, MaterialRow] = {
    "sand": MaterialRow(
        Law.SAND, 1600.0, 3.5e5, 0.3, friction_angle_deg=33.0, cohesion=0.0, about="dry sand (Klár et al. 2016)"
    ),
    "wet_sand": MaterialRow(
        *(Law.SAND, 1900.0, 3.5e5, 0.3),
        friction_angle_deg=35.0,
        cohesion=1500.0,
        about="sand that keeps the shape of its bucket",
    ),
    "snow": MaterialRow(
        *(Law.SNOW, 400.0, 1.4e5, 0.2),
        critical_compression=2.5e-2,
        critical_stretch=7.5e-3,
        hardening=10.0,
        about="dense snow (Stomakhin et al. 2013, table 2)",
    ),
    "packed_snow": MaterialRow(
        *(Law.SNOW, 400.0, 1.4e6, 0.2),
        critical_compression=2.5e-2,
        critical_stretch=7.5e-3,
        hardening=10.0,
        fracture_energy=1.0,
        about="snow of the same density whose grains have bonded, ten times as strong: it bursts where it hits",
    ),
    "jelly": MaterialRow(Law.ELASTIC, 1050.0, 1.0e4, 0.45, about="gelatine of 3 % by mass"),
    "rubber": MaterialRow(Law.ELASTIC, 1100.0, 5.0e5, 0.45, about="soft foam of rubber"),
    "clay": MaterialRow(Law.CLAY, 1700.0, 5.0e5, 0.4, yield_stress=5.0e3, viscosity=0.0, about="potter's clay"),
    "dough": MaterialRow(Law.CLAY, 1200.0, 2.0e4, 0.4, yield_stress=400.0, viscosity=100.0, about="bread dough"),
    "cream": MaterialRow(Law.CLAY, 500.0, 5.0e3, 0.4, yield_stress=40.0, viscosity=3.0, about="whipped cream"),
}
"""The materials, by name. Elastic moduli of grains and clays are those of bulk, lowered as far as shapes bear: real
sand of some 1e7 Pa needs a third of the step. Packed snow bears E times its critical stretch in tension, 10 kPa, as
Jamieson & Johnston 1990 found at its density, 79.7 kPa (rho/917)^2.39; its energy is within what breaking layers of
snow took, 0.08 to 2.7 J/m² (van Herwijnen et al. 2016)."""


LAW_KEYS: dict[str, Law] = {
    "friction_angle_deg": Law.SAND,
    "cohesion": Law.SAND,
    "yield_stress": Law.CLAY,
    "viscosity": Law.CLAY,
    "flow_exponent": Law.CLAY,
    "critical_compression": Law.SNOW,
    "critical_stretch": Law.SNOW,
    "hardening": Law.SNOW,
    "fracture_energy": Law.SNOW,
}
"""The law that each key belongs to."""
