"""Whether numbers are finite, cheaply enough to be asked at every step."""

import math

import numpy as np


def all_finite(x: np.ndarray) -> bool:
    """Whether nothing is NaN or infinite: so where the sum of squares is not. Where that overflows, numbers are looked at one
    by one."""
    return math.isfinite(np.vdot(x, x)) or bool(np.isfinite(x).all())
