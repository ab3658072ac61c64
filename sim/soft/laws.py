"""Stresses of soft matter, and how it yields.

The elastic strain of a particle is kept as e = b - 1, b its elastic left Cauchy-Green tensor: in single precision small
strains are lost in b itself. In principal directions, which plastic flow of isotropic materials keeps,

    b_i = 1 + e_i,   Hencky strain h_i = ln(b_i)/2,   Kirchhoff stress tau = J sigma

Sources: Simo & Hughes 1998 (return mappings), Klár et al. 2016 (sand), Stomakhin et al. 2013 (snow), Tampubolon et al.
2017 (volume that sand gained in tension). The cone of sand goes through a slope that is about to slide, shear
tan(phi) p, as in Jop et al. 2006; that of Klár et al. touches Mohr and Coulomb's in compression, and lets sand of 33
degrees stand at 50 in plane strain.
"""

import math
from typing import NamedTuple

import taichi as ti

from sim.core.arrays import Floats, Integers
from sim.core.bundles import bundle, func
from sim.soft.materials import Law

Matrix = ti.math.mat3
Vector = ti.math.vec3

SWEEPS = 4  # of Jacobi's rotations, which converge quadratically: off-diagonals vanish in single precision
SMALL = 0.3  # up to which series of log1p and expm1 are taken, whose next terms are below 1e-7
NEWTON = 6  # steps of Newton's method: the root is within twice of where it starts
APART = math.log(8.0)
"""Hencky strain of volume from which on sand has come apart: its grains are at twice their distance [-]."""

DENSE = 0.95
"""Density over that at rest from which on sand that was apart presses again [-]; below 1, as particles lie anyhow."""

MOST_CRUSHED = 0.56
"""Part of its volume that snow lost for good up to which it gets harder: that of snow of 400 kg/m³ that became ice."""

LEAST_HARDENED = -2.0
"""Least exponent of snow's hardening, where it came apart."""


@bundle
class Laws(NamedTuple):
    """Materials of the soft bodies, (bodies,) each."""

    law: Integers
    dense: Floats  # SAND: density from which on it presses once it was apart [kg/m³]
    mu: Floats  # Lamé's [Pa]
    lam: Floats
    slope: Floats  # SAND: of the cone, |s| over 3 p, sqrt(2)/3 tan(phi) [-]
    tip: Floats  # SAND: Hencky strain of volume that cohesion bears [-]
    yielding: Floats  # CLAY: norm of the deviatoric Hencky strain at which it yields [-]
    flowing: Floats  # CLAY: sqrt(2)^(1 - power) (K/mu)^power [s]; what is beyond, d, decays as d' = -d^power/flowing
    power: Floats  # CLAY: 1 over Herschel and Bulkley's exponent, 1 or more [-]
    least: Floats  # SNOW: least and largest stretch [-]
    most: Floats
    hardening: Floats  # SNOW [-]
    tearing: Floats  # SNOW: strain beyond its stretch in which cohesion decays to 1/e [-]; 0: it keeps it


@ti.func
def log1p(x: ti.f32) -> ti.f32:
    """ln(1 + x), by the series of 2 artanh(x/(2 + x)) where x is small."""
    s = x / (2.0 + x)
    q = s * s
    series = 2.0 * s * (1.0 + q * (1.0 / 3.0 + q * (0.2 + q * (1.0 / 7.0 + q / 9.0))))
    return ti.select(ti.abs(x) < SMALL, series, ti.log(ti.max(1.0 + x, 1.0e-6)))


@ti.func
def expm1(x: ti.f32) -> ti.f32:
    """exp(x) - 1, by its series where x is small."""
    series = x * (1.0 + x / 2.0 * (1.0 + x / 3.0 * (1.0 + x / 4.0 * (1.0 + x / 5.0 * (1.0 + x / 6.0)))))
    return ti.select(ti.abs(x) < SMALL, series, ti.exp(x) - 1.0)


@ti.func
def principal(symmetric: Matrix):
    """Eigenvalues and eigenvectors (columns) of a symmetric matrix, by cyclic Jacobi rotations (Golub & Van Loan)."""
    a = symmetric
    axes = Matrix(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    for _ in range(SWEEPS):
        for pair in ti.static(((0, 1, 2), (0, 2, 1), (1, 2, 0))):
            p, q, r = ti.static(pair)
            apq = a[p, q]
            if ti.abs(apq) > 1.0e-12 * (ti.abs(a[p, p]) + ti.abs(a[q, q])):
                theta = 0.5 * (a[q, q] - a[p, p]) / apq
                t = ti.select(theta >= 0.0, 1.0, -1.0) / (ti.abs(theta) + ti.sqrt(theta * theta + 1.0))
                c = 1.0 / ti.sqrt(t * t + 1.0)
                s = t * c
                arp, arq = a[r, p], a[r, q]
                a[p, p] -= t * apq
                a[q, q] += t * apq
                a[p, q] = 0.0
                a[q, p] = 0.0
                a[r, p] = c * arp - s * arq
                a[p, r] = a[r, p]
                a[r, q] = s * arp + c * arq
                a[q, r] = a[r, q]
                for row in ti.static(range(3)):
                    vp, vq = axes[row, p], axes[row, q]
                    axes[row, p] = c * vp - s * vq
                    axes[row, q] = s * vp + c * vq
    return Vector(a[0, 0], a[1, 1], a[2, 2]), axes


@ti.func
def recomposed(axes: Matrix, values: Vector) -> Matrix:
    """The symmetric matrix with these eigenvectors (columns) and eigenvalues."""
    scaled = axes
    for row in ti.static(range(3)):
        for column in ti.static(range(3)):
            scaled[row, column] = axes[row, column] * values[column]
    return scaled @ axes.transpose()


@ti.func
def spherical(value: ti.f32) -> Matrix:
    """A multiple of the identity."""
    return Matrix(value, 0.0, 0.0, 0.0, value, 0.0, 0.0, 0.0, value)


@ti.func
def moved_strain(e: Matrix, change: Matrix) -> Matrix:
    """b' - 1 of b' = (1 + D) b (1 + D)', where D is the displacement gradient of a step."""
    carried = e + change @ e
    return carried + change + change.transpose() + (carried + change) @ change.transpose()


@func
def volume_strain(e: Matrix) -> ti.f32:
    """ln J."""
    trace = e.trace()
    squares = (e @ e).trace()
    return 0.5 * log1p(trace + 0.5 * (trace * trace - squares) + e.determinant())


@func
def neo_hookean(e: Matrix, mu: ti.f32, lam: ti.f32) -> Matrix:
    """tau = mu (b - 1) + lambda ln J (Simo & Hughes 1998, 9.2)."""
    return mu * e + spherical(lam * volume_strain(e))


@func
def is_apart(b: ti.i32, history: ti.f32, laws: Laws) -> ti.i32:
    """Whether a particle is of sand that has come apart."""
    return int(laws.law[b] == ti.static(int(Law.SAND)) and history >= APART)


@func
def yielded_sand(strain: Vector, b: ti.i32, gained: ti.f32, laws: Laws) -> Vector:
    """Hencky strains on or within the Drucker-Prager cone, once the volume gained before is taken back."""
    mu, lam = laws.mu[b], laws.lam[b]
    volume = strain.sum() + gained
    deviator = strain - strain.sum() / 3.0
    norm = deviator.norm()
    excess = norm + (3.0 * lam + 2.0 * mu) / (2.0 * mu) * (volume - laws.tip[b]) * laws.slope[b]
    return volume / 3.0 + deviator * (1.0 - ti.max(excess, 0.0) / ti.max(norm, 1.0e-20))


@func
def kept_beyond(beyond: ti.f32, b: ti.i32, dt: ti.f32, laws: Laws) -> ti.f32:
    """Share x of the deviator d beyond the yield strain that is left after dt [s].

    x + dt/flowing d^(power - 1) x^power = 1; Newton's method from above on a convex curve, within twice the root.
    """
    flowing, power = laws.flowing[b], laws.power[b]
    kept = flowing / (flowing + dt)
    if power > 1.0 and flowing > 0.0 and beyond > 0.0:
        rate = dt / flowing * beyond ** (power - 1.0)
        start = ti.min(1.0, rate ** (-1.0 / power))
        steep = ti.min(1.0, rate)
        part = 1.0
        for _ in range(NEWTON):
            high = part ** (power - 1.0)
            part -= (start * part + steep * high * part - 1.0) / (start + steep * power * high)
        kept = start * part
    return kept


@func
def yielded_clay(strain: Vector, b: ti.i32, dt: ti.f32, laws: Laws) -> Vector:
    """Hencky strains of a solid of Herschel and Bulkley after dt [s] (Simo & Hughes 1998, 2.7, implicit).

    What of the deviator is beyond von Mises' cylinder decays, at once without viscosity. A shear stress of tau flows at
    the rate ((tau - yield)/K)^(1/n) (Yue et al. 2015); |s| = sqrt(2) tau = 2 mu |d|.
    """
    mean = strain.sum() / 3.0
    deviator = strain - mean
    norm = deviator.norm()
    beyond = ti.max(norm - laws.yielding[b], 0.0)
    kept = kept_beyond(beyond, b, dt, laws)
    return strain - (1.0 - kept) * beyond / ti.max(norm, 1.0e-20) * deviator


@func
def stress_of_hencky(strain: Vector, mu: ti.f32, lam: ti.f32) -> Vector:
    """Principal tau = 2 mu h + lambda tr h."""
    return 2.0 * mu * strain + lam * strain.sum()


@func
def hardened(hardening: ti.f32, plastic: ti.f32) -> ti.f32:
    """Factor on the moduli of snow whose plastic Hencky strain of volume is given (Stomakhin et al. 2013, 6)."""
    return ti.exp(ti.max(hardening * ti.min(-expm1(plastic), MOST_CRUSHED), LEAST_HARDENED))


@func
def respond(trial: Matrix, b: ti.i32, history: ti.f32, cohesion: ti.f32, dt: ti.f32, laws: Laws):
    """What becomes of a trial strain e in a step of dt [s]: elastic strain, Kirchhoff stress [Pa], history, cohesion.

    The history is the Hencky strain of volume that sand in tension has gained, or that snow lost for good. Cohesion is
    the share of its critical stretch that snow still bears: a crack, smeared over a cell, takes as much energy in cells
    of any size (Bazant & Oh 1983), and what is crushed denser than at rest sticks again.
    """
    law, mu, lam = laws.law[b], laws.mu[b], laws.lam[b]
    e, stress, told, left = trial, Matrix(0.0), history, cohesion
    gained = -1.0
    if law == ti.static(int(Law.SAND)):
        gained = volume_strain(trial) + history - laws.tip[b]
    if law == ti.static(int(Law.ELASTIC)):
        stress = neo_hookean(trial, mu, lam)
    elif gained >= 0.0:
        # Its strain goes to the tip of the cone; it presses again only once it is that much denser.
        tip = laws.tip[b]
        e, stress, told = spherical(expm1(2.0 / 3.0 * tip)), spherical((2.0 / 3.0 * mu + lam) * tip), gained
    else:
        values, axes = principal(trial)
        strain = Vector(0.0)
        for k in ti.static(range(3)):
            strain[k] = 0.5 * log1p(values[k])
        after = strain
        if law == ti.static(int(Law.SAND)):
            after, told = yielded_sand(strain, b, history, laws), 0.0
        elif law == ti.static(int(Law.CLAY)):
            after = yielded_clay(strain, b, dt, laws)
        else:
            least, most = 0.5 * log1p(laws.least[b] ** 2 - 1.0), 0.5 * log1p(laws.most[b] ** 2 - 1.0)
            if history < 0.0 and strain.min() < least:
                left = 1.0
            most *= left
            after = ti.min(ti.max(strain, least), most)
            if laws.tearing[b] > 0.0:
                left *= ti.exp(-ti.max(strain - most, 0.0).sum() / laws.tearing[b])
            told = history + (strain - after).sum()
        tau = stress_of_hencky(after, mu, lam)
        if law == ti.static(int(Law.SNOW)):
            volume = after.sum()
            j = expm1(volume)
            factor = hardened(laws.hardening[b], told)
            for k in ti.static(range(3)):
                stretch = expm1(after[k])
                tau[k] = factor * (2.0 * mu * stretch * (1.0 + stretch) + lam * j * (1.0 + j))
        stress = recomposed(axes, tau)
        if (after != strain).any():
            for k in ti.static(range(3)):
                values[k] = expm1(2.0 * after[k])
            e = recomposed(axes, values)
    return e, stress, told, left
