"""Which return distributions no other one dominates."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def dominates(one: Array, other: Array) -> bool:
    """Whether one distribution of vector returns dominates another: every non-decreasing utility expects at least as much of
    it, and some utility more. (First-order stochastic dominance of vectors.)

    By Strassen's theorem that is so if and only if the samples can be paired so that each sample of the one is at least, in
    every objective, the sample of the other that it is paired with: a perfect matching of a bipartite graph.

    :param one: samples, equally likely, (n_samples, n_objectives)
    :param other: as many
    :raises ValueError: for different shapes
    """
    if one.shape != other.shape or one.ndim != 2:
        raise ValueError(f"Samples have the shapes {one.shape} and {other.shape}: give (n_samples, n_objectives) for both.")
    from scipy.sparse import csr_matrix  # They take a fifth of a second to import.
    from scipy.sparse.csgraph import maximum_bipartite_matching

    def is_at_least(a: Array, b: Array) -> bool:
        at_least = (a[:, None] >= b[None]).all(axis=2)
        return bool((maximum_bipartite_matching(csr_matrix(at_least)) >= 0).all())

    return is_at_least(one, other) and not is_at_least(other, one)


def non_dominated_distributions(returns: Array) -> list[int]:
    """The indices of the distributions that no other one dominates; equal ones all stay.

    :param returns: (n, n_samples, n_objectives)
    """
    return [i for i, one in enumerate(returns) if not any(dominates(other, one) for other in returns)]
