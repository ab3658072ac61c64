"""How many threads libraries take that count cores for themselves, by the environment: it is read once, at import."""

BLAS_THREADS = {"OPENBLAS_NUM_THREADS": "1"}
"""Of every process. Products here are small, and with threads of its own OpenBLAS may wait for ever, spinning, for one
that has missed its signal (docs/decisions/0003-spawned-workers.md)."""


def thread_variables(threads: int) -> dict[str, str]:
    """Variables of the environment by which libraries take so many threads, and BLAS one."""
    return {**dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"), str(threads)), **BLAS_THREADS}
