"""Physics: arrays, kernels and parameters. No files, no jobs, no HDF5.

Importing this package, or any `parameters` module in it, does not load Taichi.
"""

import os

# Read by Taichi when it is imported: no banner, no chatter, no version check over the network.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("TI_LOG_LEVEL", "error")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")
