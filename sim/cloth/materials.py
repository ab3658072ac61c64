"""Cloth materials by name: defaults that keys of a job override."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

Material = Literal["cotton", "silk", "denim", "rubber"]

RUBBER_MODULUS, RUBBER_POISSON, RUBBER_DENSITY, RUBBER_THICKNESS = 1.5e6, 0.5, 1000.0, 1.0e-3
"""Young's modulus [Pa], Poisson's ratio [-], density [kg/m³] and thickness [m] of a sheet of soft natural rubber (Gent
2012, "Engineering with Rubber", ch. 3: 1-2 MPa, incompressible, 910-1200 kg/m³ with fillers)."""

MATERIAL_UNITS: Mapping[str, str] = {
    "mass_per_area": "kg/m²",
    "stretch_stiffness": "N/m",
    "shear_stiffness": "N/m",
    "poisson_ratio": "-",
    "bend_stiffness": "N m",
    "thickness": "m",
    "friction": "-",
}
"""Keys that a material gives."""

_STIFFNESS = RUBBER_MODULUS * RUBBER_THICKNESS  # [N/m]

_NUMBERS: Mapping[Material, tuple[float, ...]] = {
    "cotton": (0.15, 4.0e3, 50.0, 0.0, 8.0e-6, 0.5e-3, 0.5),
    "silk": (0.07, 3.0e3, 20.0, 0.0, 2.5e-6, 0.2e-3, 0.25),
    "denim": (0.40, 10.0e3, 150.0, 0.0, 60.0e-6, 0.9e-3, 0.6),
    "rubber": (
        RUBBER_DENSITY * RUBBER_THICKNESS,
        _STIFFNESS,
        _STIFFNESS / (2.0 * (1.0 + RUBBER_POISSON)),
        RUBBER_POISSON,
        _STIFFNESS * RUBBER_THICKNESS**2 / (12.0 * (1.0 - RUBBER_POISSON**2)),
        RUBBER_THICKNESS,
        0.9,
    ),
}

MATERIALS: Mapping[Material, Mapping[str, float]] = {
    material: dict(zip(MATERIAL_UNITS, numbers, strict=True)) for material, numbers in _NUMBERS.items()
}
"""Mass per area [kg/m²], stretch and shear stiffness [N/m], Poisson's ratio [-], bending rigidity [N m], thickness [m],
friction [-].

Woven cloths lie within the ranges that Kawabata's instruments find at small loads (Kawabata 1980, "The standardization
and analysis of hand evaluation"; Hu 2004, "Structure and mechanics of woven fabrics", ch. 4-6), here for a shirting of
plain cotton, a light habotai silk and a 12 oz denim. His units convert so:

- bending rigidity B: 1 gf cm²/cm = 98.1 uN m; cotton 0.05-0.1, silk 0.02-0.04, denim 0.4-1
- shear G: 1 gf/(cm deg) = 56 N/m; cotton 0.5-1.5, silk 0.3-0.5, denim 2-4
- tension: 500 gf/cm = 490 N/m at a strain of 3-15 %, as yarns straighten before they stretch: 3 to 16 kN/m

Rubber is an isotropic elastic sheet: stretch E h, shear E h / (2 (1 + nu)), bending E h³ / (12 (1 - nu²)).
"""

_WOVEN = "within Kawabata's ranges at small loads (Kawabata 1980; Hu 2004, ch. 4-6)"

SOURCES: Mapping[Material, str] = {
    "cotton": f"a shirting of plain cotton, {_WOVEN}",
    "silk": f"a light habotai, {_WOVEN}",
    "denim": f"12 oz, {_WOVEN}",
    "rubber": "1 mm of soft natural rubber of 1.5 MPa, incompressible, an isotropic elastic sheet (Gent 2012, ch. 3)",
}
"""What each is, and where its numbers are from, for people."""
