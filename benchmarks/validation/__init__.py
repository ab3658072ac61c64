"""Every number that theory or an experiment gives us, computed by the solvers that a job uses.

python -m benchmarks.validation [CASE ...] [--solver wcsph] [--quick]
"""
