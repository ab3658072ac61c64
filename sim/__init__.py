"""Physics: arrays, kernels and parameters. No files, no jobs, no HDF5.

Importing this package, or any `parameters` module in it, does not load Taichi.
"""
