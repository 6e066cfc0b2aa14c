"""Hypervolume and inverted generational distance against other programs: pymoo, and what is computed here from definitions.

pymoo minimises, so it gets what is maximised here with the opposite sign. pymoo 0.6.2 asks moocore for both metrics, which is
what this package does too: agreement with it shows that signs, reference point and points that do not count are understood
alike. Programs of their own are pymoo's distances when it is told to scale them, pymoo 0.6.1.5, whose answers are stored
below, and the functions of this file.
"""

import numpy as np
import pytest
from pymoo.indicators.hv import HV
from pymoo.indicators.igd import IGD

from sb3_momba.pareto.metrics import hypervolume, inverted_generational_distance

CASES = [(n_objectives, seed) for n_objectives in (2, 3, 4, 5) for seed in range(8)]


def random_values(n_objectives: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Values and a reference point: a front, and points that add nothing to it, in random order and of unequal units."""
    rng = np.random.default_rng([n_objectives, seed])
    directions = np.abs(rng.normal(size=(8, n_objectives)))
    front = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    dominated = front[rng.integers(8, size=5)] * rng.uniform(0.5, 1, size=(5, 1))
    tied = front[:2] * np.where(np.arange(n_objectives) == 0, 1, 0.9)  # as good in one objective, behind in the others
    duplicates = front[rng.integers(8, size=3)]
    reference = np.full(n_objectives, 0.05)
    below = rng.uniform(-1, 0.05, size=(2, n_objectives))
    partly_below = np.where(np.arange(n_objectives) == n_objectives - 1, -0.5, 2.0)[None]
    on_the_bound = np.where(np.arange(n_objectives) == 0, reference, 1.5)[None]
    values = rng.permutation(np.concatenate([front, dominated, tied, duplicates, below, partly_below, on_the_bound]))
    units, origin = 10.0 ** rng.integers(-2, 4, size=n_objectives), rng.normal(size=n_objectives)
    return values * units + origin, reference * units + origin


def volume_by_slices(values: np.ndarray, reference: np.ndarray) -> float:
    """Cut along the last objective: each slice is as high as the step between two values, and its base has the volume of
    the values that reach it in the other objectives."""
    values = values[(values > reference).all(axis=1)]
    if len(values) == 0:
        return 0.0
    if values.shape[1] == 1:
        return float(values.max() - reference[0])
    volume, floor = 0.0, reference[-1]
    for level in np.unique(values[:, -1]):
        volume += (level - floor) * volume_by_slices(values[values[:, -1] >= level, :-1], reference[:-1])
        floor = level
    return volume


@pytest.mark.parametrize(("n_objectives", "seed"), CASES)
def test_hypervolumes_of_random_values(n_objectives, seed):
    values, reference = random_values(n_objectives, seed)
    volume = hypervolume(values, reference)
    assert volume > 0
    assert volume == pytest.approx(float(HV(ref_point=-reference)(-values)), rel=1e-9, abs=0)
    assert volume == pytest.approx(volume_by_slices(values, reference), rel=1e-9, abs=0)


@pytest.mark.parametrize("n_objectives", [2, 3, 4, 5])
def test_values_of_which_none_is_above_the_reference_point(n_objectives):
    values, _ = random_values(n_objectives, 0)
    best = values.max(axis=0)
    assert hypervolume(values, best) == 0 == HV(ref_point=-best)(-values)


@pytest.mark.parametrize(("n_objectives", "seed"), CASES)
def test_inverted_generational_distances_of_random_values(n_objectives, seed):
    values, _ = random_values(n_objectives, seed)
    front, _ = random_values(n_objectives, seed + 100)
    distance = inverted_generational_distance(values, front)
    zero, one = np.zeros(n_objectives), np.ones(n_objectives)
    scaled_by_one = IGD(-front, norm_by_dist=True, ideal=zero, nadir=one)
    nearest = np.linalg.norm(front[:, None] - values[None], axis=2).min(axis=1)
    assert distance > 0
    assert distance == pytest.approx(float(IGD(-front)(-values)), rel=1e-9, abs=0)
    assert distance == pytest.approx(float(scaled_by_one(-values)), rel=1e-9, abs=0)
    assert distance == pytest.approx(float(nearest.mean()), rel=1e-9, abs=0)
    assert inverted_generational_distance(values, values) == 0


# HV(ref_point=-reference)(-values) and IGD(-front)(-values) of pymoo 0.6.1.5, which has programs of its own for both.
PYMOO_0_6_1_5 = {
    2: (0.5789575637492473, 0.17038322190660737),
    3: (0.2084726894868298, 0.3123512388724896),
    4: (0.19279023282476665, 0.3520198893944139),
    5: (0.03570253553704328, 0.5323945283733605),
}


@pytest.mark.parametrize("n_objectives", PYMOO_0_6_1_5)
def test_both_metrics_against_an_older_pymoo(n_objectives):
    rng = np.random.default_rng(n_objectives)
    values, front, reference = rng.random((12, n_objectives)), rng.random((9, n_objectives)), np.full(n_objectives, 0.1)
    volume, distance = PYMOO_0_6_1_5[n_objectives]
    assert hypervolume(values, reference) == pytest.approx(volume, rel=1e-9, abs=0)
    assert inverted_generational_distance(values, front) == pytest.approx(distance, rel=1e-9, abs=0)


@pytest.mark.parametrize(
    ("values", "reference", "volume"),
    [
        ([[5, 1], [3, 4], [3, 4], [2, 2]], [0, 0], 14),  # columns of width 3 and 2, of height 4 and 1
        ([[5, 1], [3, 4], [2, 6], [9, -1]], [1, 0], 12),  # columns of width 1, 1 and 2, of height 6, 4 and 1
        ([[-1, -2], [-3, -1]], [-4, -5], 10),  # returns below zero: 3 x 3 + 1 x 4, less the common 1 x 3
        ([[2, 3, 4], [4, 3, 2]], [0, 0, 0], 36),  # 24 + 24, less the common 2 x 3 x 2
        ([[2, 1, 1, 1], [1, 2, 1, 1], [1, 1, 2, 1], [1, 1, 1, 2]], [0, 0, 0, 0], 5),  # a cube and one on each of four sides
        ([[3, 1, 1, 1, 1], [1, 1, 1, 1, 3]], [0, 0, 0, 0, 0], 5),
    ],
)
def test_hypervolumes_by_hand(values, reference, volume):
    values, reference = np.array(values, dtype=float), np.array(reference, dtype=float)
    assert volume_by_slices(values, reference) == volume
    assert hypervolume(values, reference) == pytest.approx(volume, rel=1e-12)
    assert float(HV(ref_point=-reference)(-values)) == pytest.approx(volume, rel=1e-12)


@pytest.mark.parametrize(
    ("values", "front", "distance"),
    [
        ([[3, 4], [3, 4], [0, 1]], [[0, 0], [6, 8]], 3),  # 1 and 5
        ([[-1, -1]], [[2, 3], [-1, -1], [-1, 3]], 3),  # 5, 0 and 4: a better point of the front is a distance, too
        ([[9, 9]], [[6, 5]], 5),  # and so is a worse one
        ([[1, 2, 2], [5, 5, 5]], [[0, 0, 0], [5, 5, 8]], 3),
        ([[1, 1, 1, 1], [7, 7, 7, 7]], [[0, 0, 0, 0]], 2),
    ],
)
def test_inverted_generational_distances_by_hand(values, front, distance):
    values, front = np.array(values, dtype=float), np.array(front, dtype=float)
    assert inverted_generational_distance(values, front) == pytest.approx(distance, rel=1e-12)
    assert float(IGD(-front)(-values)) == pytest.approx(distance, rel=1e-12)
