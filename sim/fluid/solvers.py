"""The fluid solvers by the name that a job gives them."""

from sim.fluid.dfsph import DFSPHSolver
from sim.fluid.forces import SPHFluid
from sim.fluid.pcisph import PCISPHSolver
from sim.fluid.wcsph import WCSPHSolver

SOLVERS: dict[str, type[SPHFluid]] = {"wcsph": WCSPHSolver, "dfsph": DFSPHSolver, "pcisph": PCISPHSolver}
