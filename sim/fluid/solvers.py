"""Fluid solvers by the name that a job gives them; a new one has its file, its `sim.fluid.traits`, and a line here."""

from collections.abc import Mapping

from sim.fluid.dfsph import DFSPHSolver
from sim.fluid.fluid import SPHFluid
from sim.fluid.pcisph import PCISPHSolver
from sim.fluid.wcsph import WCSPHSolver

SOLVERS: Mapping[str, type[SPHFluid]] = {"wcsph": WCSPHSolver, "dfsph": DFSPHSolver, "pcisph": PCISPHSolver}
