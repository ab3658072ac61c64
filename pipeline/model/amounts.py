"""Numbers in words, as the checks tell them."""

import math


def count(number: float) -> str:
    """Number in words: `1.23 million`."""
    for limit, unit in ((1e9, "billion"), (1e6, "million")):
        if number >= limit:
            return f"{number / limit:.3g} {unit}"
    return f"{number:.0f}"


def gigabytes(size_bytes: float) -> str:
    """Memory in words: `1.23 GB`."""
    return f"{size_bytes / 1e9:.3g} GB"


def rounded_up(value: float) -> float:
    """To two significant digits, upwards, so that the number is short and still fits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / step) * step:.2g}")


def rounded_down(value: float) -> float:
    """To two significant digits, downwards, for what may be that large at most."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    # The quotient of what has two digits already may fall short of a whole number by rounding.
    return float(f"{math.floor(value / step * (1.0 + 1.0e-12)) * step:.2g}")
