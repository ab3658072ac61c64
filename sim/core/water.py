"""Water, at 20 degrees C."""

TENSION_OF_WATER = 0.0728
"""Surface tension against air (IAPWS R1-76) [N/m]."""

CAPILLARY_LENGTH = 2.7e-3
"""sqrt(sigma/(rho g)) on Earth, below which a surface is shaped by tension as much as by weight [m]."""
