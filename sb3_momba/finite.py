"""Whether numbers are finite, cheaply enough to be asked at every step."""

import math

import numpy as np


def all_finite(x: np.ndarray) -> bool:
    """Whether nothing is NaN or infinite. A finite sum of squares proves it; where that overflows, each number is looked at."""
    return math.isfinite(np.vdot(x, x)) or bool(np.isfinite(x).all())
