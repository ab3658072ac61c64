"""Stable time steps."""

import math

# Fraction of the particle spacing that a signal may cross in a step (Monaghan 1992).
CFL_NUMBER = 0.4

# Fraction of sqrt(d / |a|) (Monaghan 1992, section 10.3).
FORCE_NUMBER = 0.25

# Fraction of d² / nu (Morris, Fox & Zhu 1997, eq. 20).
VISCOUS_NUMBER = 0.125

# Fraction of the inverse of the highest frequency of particles against each other's pressure; symplectic Euler is
# stable up to 2. Particles that are squeezed, or pressed against boundary samples, are the stiffest.
PRESSURE_NUMBER = 1.0

# Fraction of the inverse frequency of a particle on the spring that its neighbours' cohesion is.
COHESION_NUMBER = 0.25


def stable_time_step(
    *,
    spacing: float,
    signal_speed: float,
    acceleration: float,
    viscosity: float,
    cohesion_rate: float,
    cfl: float,
    pressure_frequency: float = 0.0,
) -> float:
    """Largest stable step [s]: the smallest of the limits by signals, forces, viscosity, cohesion and pressure.

    Args:
        spacing: particle spacing d [m].
        signal_speed: speed of sound plus largest speed; the largest speed alone where pressure is implicit [m/s].
        acceleration: largest acceleration [m/s²].
        viscosity: kinematic viscosity, the artificial one included [m²/s].
        cohesion_rate: square of the frequency of a particle on the springs of its neighbours' cohesion [1/s²].
        cfl: the user's factor on the limit by signals [-].
        pressure_frequency: highest frequency of particles against each other's pressure [1/s], where it is explicit.
    """
    limits = [math.inf]
    if signal_speed > 0.0:
        limits.append(cfl * CFL_NUMBER * spacing / signal_speed)
    if acceleration > 0.0:
        limits.append(FORCE_NUMBER * math.sqrt(spacing / acceleration))
    if viscosity > 0.0:
        limits.append(VISCOUS_NUMBER * spacing * spacing / viscosity)
    if cohesion_rate > 0.0:
        limits.append(COHESION_NUMBER / math.sqrt(cohesion_rate))
    if pressure_frequency > 0.0:
        limits.append(PRESSURE_NUMBER / pressure_frequency)
    return min(limits)
