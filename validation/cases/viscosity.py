"""A shear wave that viscosity damps: it decays at the rate nu k² (Morris, Fox & Zhu 1997 use such flows).

Monaghan's viscosity is a sum over neighbours, and a cubic lattice of 26 of them is no isotropic fluid: a wave along its
axes is damped less than one along its diagonals. In disorder all directions mix. A cubic lattice has two shear
viscosities, mu_a (wave along an axis) and mu_d (wave and motion along diagonals of a face), and (3 mu_a + 2 mu_d)/5 is
their mean over all directions.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sim.core.domain import DomainParameters
from validation.cases import Case, Found
from validation.checks import CaseResult, Check, fitted_order
from validation.figures import COLOURS, THEORY, draw_refinement, label_axes, make_panels, refinement_of, style_of
from validation.scenes import EVERY_FACE, WEIGHTLESS, advance, lattice, make_fluid, state_of, turn_about_y

WAVELENGTH, AMPLITUDE, VISCOSITY = 0.2, 1.0e-3, 1.0e-3  # [m], [m/s], [m²/s]: a Reynolds number of 0.2
SOUND_SPEED = 0.1  # a hundred times the amplitude [m/s]; the solver's own choice takes ten times the steps
DECAY = 0.06  # share of a decay time 1/(nu k²): the free sides have not come to the middle by then
CORE = 0.25  # half side of the middle that is measured, in wavelengths
IMPLICIT_RESOLUTION = 12  # at which the implicit solve is compared
TILTS_DEG = {"axis": 0.0, "diagonal": 45.0}  # of the lattice about y


def decay(solver: str, resolution: int, tilt_deg: float, viscosity_solver: str = "explicit") -> dict[str, Any]:
    """The wave's amplitude over time in the middle of a block with free sides."""
    spacing = WAVELENGTH / resolution
    # Viscosity spreads the fault of a free side by sqrt(2 nu t) = 0.06 wavelengths.
    half = WAVELENGTH * np.array([0.45 + CORE, 0.45 + CORE, 1.0])
    particles = _tilted_block(half, spacing, tilt_deg)
    k = 2.0 * np.pi / WAVELENGTH
    wave = np.cos(k * particles[:, 2].astype(np.float64))
    velocity = np.zeros(particles.shape)
    velocity[:, 0] = AMPLITUDE * wave
    space = DomainParameters(min=(-1.0,) * 3, max=(1.0,) * 3, open_faces=EVERY_FACE)
    material = {"viscosity": VISCOSITY, "viscosity_solver": viscosity_solver, "artificial_viscosity": 0.0}
    if solver == "wcsph":
        material["sound_speed"] = SOUND_SPEED
    fluid = make_fluid(solver, space, particles, spacing=spacing, velocities=velocity, gravity=WEIGHTLESS, **material)
    core = (np.abs(particles[:, :2]) < CORE * WAVELENGTH).all(axis=1) & (np.abs(particles[:, 2]) < 0.5 * WAVELENGTH)
    weight = wave[core] / (wave[core] ** 2).sum()
    duration = DECAY / (VISCOSITY * k**2)
    times, amplitudes = [0.0], [1.0]
    for time in advance(fluid, duration, cuts=10):
        _, moved = state_of(fluid)
        times.append(time / duration * DECAY)
        amplitudes.append(float(weight @ moved[core, 0]) / AMPLITUDE)
    rate = -float(np.polyfit(times, np.log(amplitudes), 1)[0])
    return {"times": times, "amplitudes": amplitudes, "rate": rate}


def lattice_rate(resolution: float, tilt_deg: float) -> float:
    """Rate on an infinite lattice over nu k²: the sum that a solver computes, in float64, at the crest of the wave.

    2 (d+2) sum_j V (1 - cos(k n.x_j)) (e.x_j)² (-W'(r_j)/r_j) / (r_j² + 0.01 h²) / k², in units of the spacing,
    with the wave along n and the motion along e.
    """
    from sim.fluid.kernels import SUPPORT_IN_SPACINGS, evaluate, lattice_offsets, particle_volume
    from sim.fluid.viscosity import LAPLACIAN_FACTOR, SOFTENING

    support, step = float(SUPPORT_IN_SPACINGS), 1e-6
    offsets = lattice_offsets()
    offsets = offsets[np.linalg.norm(offsets, axis=1) > 0.0] @ turn_about_y(tilt_deg)
    distance = np.linalg.norm(offsets, axis=1)
    slope = (evaluate(distance + step, support) - evaluate(distance - step, support)) / (2.0 * step)
    k = 2.0 * np.pi / resolution
    terms = (1.0 - np.cos(k * offsets[:, 2])) * offsets[:, 0] ** 2 * slope / distance
    total = LAPLACIAN_FACTOR * particle_volume(1.0) * (terms / (distance**2 + SOFTENING * support**2)).sum()
    return -float(total) / k**2


def _tilted_block(half: np.ndarray, spacing: float, tilt_deg: float) -> np.ndarray:
    """Lattice points, the lattice turned about y, inside a box of these half sides, (n, 3)."""
    reach = np.ceil(np.linalg.norm(half) / spacing) * spacing
    points = lattice((-reach,) * 3, (reach,) * 3, spacing) @ turn_about_y(tilt_deg).astype(np.float32)
    return np.ascontiguousarray(points[(np.abs(points) < half).all(axis=1)])


def find(solver: str, resolutions: Sequence[int]) -> Found:
    """The wave along an axis and along a diagonal, at several resolutions, in particles to the wavelength."""
    runs = {name: [decay(solver, count, tilt) for count in resolutions] for name, tilt in TILTS_DEG.items()}
    rates = {name: [each["rate"] for each in several] for name, several in runs.items()}
    on_lattice = {name: [lattice_rate(count, tilt) for count in resolutions] for name, tilt in TILTS_DEG.items()}
    means = [(3.0 * along + 2.0 * across) / 5.0 for along, across in zip(*rates.values(), strict=True)]
    long_waves = lattice_rate(1e3, TILTS_DEG["axis"])
    errors = [abs(rate - long_waves) for rate in rates["axis"]]
    implicit = decay(solver, IMPLICIT_RESOLUTION, TILTS_DEG["axis"], "implicit")
    second_order = 0.05 * (12 / resolutions[-1]) ** 2
    checks = [
        Check("rate of decay over nu k², mean over directions", means[-1], 1.0, 0.03 + second_order,
              "the lattice sum of long waves is 0.99; 12 particles to the wavelength cost 2 % along axis and diagonal"),
        *(
            Check(f"rate over that of the operator's lattice sum, wave along the {name}",
                  rates[name][-1] / on_lattice[name][-1], 1.0, 0.03,
                  "the middle feels the free sides a little, and a tilted block has rough ones")
            for name in TILTS_DEG
        ),
        Check("the same with the implicit solve", implicit["rate"] / lattice_rate(IMPLICIT_RESOLUTION, 0.0), 1.0, 0.03,
              "backward Euler with steps of 1/160 of the decay time errs by 0.3 %; the rest is as above"),
        Check("order of the rate's error under refinement, wave along the axis",
              fitted_order([1.0 / n for n in resolutions], errors), 2.0, 0.5,
              "the operator is even in k; free sides and pressure solves leave 0.3 % of the rate, half of the error on "
              "the finest lattice: 0.3 to 0.5 in the order"),
    ]  # fmt: skip
    series: dict[str, Any] = {
        "resolutions": list(resolutions),
        "means": means,
        "errors": errors,
        "times": runs["axis"][-1]["times"],
    }
    for name in TILTS_DEG:
        series |= {f"rates_{name}": rates[name], f"lattice_rates_{name}": on_lattice[name]}
        series[f"amplitudes_{name}"] = runs[name][-1]["amplitudes"]
    return checks, series


def draw(results: Sequence[CaseResult]) -> Figure:
    """Decay of the wave along an axis and along a diagonal, refinement."""
    figure, (decay, order) = make_panels(2)
    for result in results:
        times = result.series["times"]
        for name, dash in (("axis", "-"), ("diagonal", "--")):
            decay.semilogy(times, result.series[f"amplitudes_{name}"], dash, color=COLOURS[result.solver])
        decay.plot([], [], **style_of(result))
    decay.semilogy(times, np.exp(np.negative(times)), ":", color=THEORY, label="exp(-nu k² t)")
    decay.minorticks_off()
    decay.set_yticks([0.92, 0.94, 0.96, 0.98, 1.0], ["0.92", "0.94", "0.96", "0.98", "1"])
    label_axes(decay, "nu k² t", "amplitude", "axis (solid), diagonal (dashed)")
    draw_refinement(order, refinement_of(results, "resolutions"), 2, "spacing / wavelength", "error of the rate")
    return figure


CASE = Case(find, draw, sizes={"resolutions": ((6, 12, 24), (6, 12))})
