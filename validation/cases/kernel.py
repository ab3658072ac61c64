"""The kernel integrates to one, its gradients cancel, and a filled lattice is at rest density."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from sim.core.domain import DomainParameters
from sim.fluid.kernels import SUPPORT_IN_SPACINGS, evaluate, lattice_offsets, particle_volume
from validation.cases import Case, Found
from validation.checks import CaseResult, Check, fitted_order
from validation.figures import COLOURS, draw_refinement, label_axes, make_panels
from validation.scenes import EVERY_FACE, WATER, WEIGHTLESS, lattice, make_fluid

SPACING = 0.02
REFINEMENTS = (8, 16, 32)  # spacings to the wavelength of a sine that the kernel smooths


def find(solver: str) -> Found:
    """Sums over the kernel on the host, and the density that a solver finds in a lattice."""
    support = SUPPORT_IN_SPACINGS * SPACING
    # Gauss-Legendre on each side of the kink at h/2: exact for the kernel's polynomials.
    nodes, weights = np.polynomial.legendre.leggauss(8)
    integral = sum(
        float((4.0 * np.pi * radius**2 * evaluate(radius, support)) @ weights) * support / 4.0
        for radius in (support / 4.0 * (nodes + 1.0), support / 4.0 * (nodes + 3.0))
    )
    offsets = lattice_offsets() * SPACING
    distance = np.linalg.norm(offsets, axis=1)
    step = 1e-6 * SPACING
    slope = (evaluate(distance + step, support) - evaluate(np.abs(distance - step), support)) / (2.0 * step)
    gradients = slope[:, None] * offsets / np.maximum(distance, 1e-12)[:, None]
    cancelled = float(np.linalg.norm(gradients.sum(axis=0)) / np.linalg.norm(gradients, axis=1).sum())
    density = _lattice_density(solver)
    smoothing = [_smoothing_error(spacings) for spacings in REFINEMENTS]
    checks = [
        Check("integral of W", integral, 1.0, 1e-12, "exact quadrature in float64"),
        Check("sum of grad W over a lattice, over the sum of its sizes", cancelled, 0.0, 1e-9,
              "symmetry; the slope is a difference quotient with eight digits"),
        Check("volume of a particle over d³", particle_volume(SPACING) / SPACING**3, 1.0, 1e-3,
              "the cubic spline integrates a lattice to 0.03 %"),
        Check("density inside a filled lattice over rho0", density, 1.0, 1e-3, "the required 0.1 %"),
        Check("order of the smoothing error of a sine", fitted_order([1.0 / n for n in REFINEMENTS], smoothing), 2.0,
              0.1, "an even kernel errs with the square of its width"),
    ]  # fmt: skip
    radius = np.linspace(0.0, 1.2, 121)
    series = {
        "q": radius.tolist(),
        "w": (evaluate(radius, 1.0) * np.pi / 8.0).tolist(),
        "spacings": list(REFINEMENTS),
        "smoothing": smoothing,
    }
    return checks, series


def _lattice_density(solver: str) -> float:
    """Worst density of the particles that have all their neighbours, over rho0."""
    domain = DomainParameters(min=(-1.0,) * 3, max=(1.0,) * 3, open_faces=EVERY_FACE)
    particles = lattice((-0.1,) * 3, (0.1,) * 3, SPACING)
    fluid = make_fluid(solver, domain, particles, spacing=SPACING, gravity=WEIGHTLESS)
    arrays = fluid.snapshots()["water"].arrays
    inside = (np.abs(arrays["position"]) < 0.1 - 2.0 * SPACING).all(axis=1)
    ratio = arrays["density"][inside].astype(np.float64) / WATER
    return float(ratio[np.argmax(np.abs(ratio - 1.0))])


def _smoothing_error(spacings: int) -> float:
    """Relative error of sum_j V sin(k x_j) W_ij at the crest of a sine so many spacings long."""
    offsets = lattice_offsets()
    weights = evaluate(np.linalg.norm(offsets, axis=1), SUPPORT_IN_SPACINGS) * particle_volume(1.0)
    return 1.0 - float(weights @ np.cos(2.0 * np.pi / spacings * offsets[:, 0]))


def draw(results: Sequence[CaseResult]) -> Figure:
    """Shape of the kernel, and the order of smoothing."""
    figure, (shape, order) = make_panels(2)
    series = results[0].series
    shape.plot(series["q"], series["w"], color=COLOURS["wcsph"])
    label_axes(shape, "|x| / h", "W pi h³ / 8", "cubic spline", legend=False)
    smoothed = {"color": COLOURS["wcsph"], "label": "smoothed sine"}
    spacings = [1.0 / count for count in series["spacings"]]
    draw_refinement(order, [(spacings, series["smoothing"], smoothed)], 2, "spacing / wavelength", "relative error")
    return figure


CASE = Case(find, draw)
