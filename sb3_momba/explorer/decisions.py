"""The mathematics of choosing a preference: what it will return, what a trade costs, which preference keeps a bound.

Shapes: P evaluated preferences, (P, n_objectives), with their returns, (P, n_objectives); n wanted ones. Returns are in the
units of the rewards.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

Array = NDArray[np.float64]
Predict = Callable[[Array], Array]  # preferences (n, n_objectives) -> returns (n, n_objectives)

TOLERANCE = 1e-6  # of weights, which come as float32
N_NEAREST = 4  # evaluated preferences whose errors speak for a place between them
STEP = 0.05  # of a weight, over which slopes are taken: below that, one sees the noise of single policies
SMALLEST_TRADE = 1e-3  # of the front's range: less is no change that a price could be named for
N_ALTERNATIVES = 3
LEAST_DIFFERENCE = 0.5  # of an average pair's: what counts as moving differently


def predict_returns(wanted: Array, preferences: Array, returns: Array) -> Array:
    """Returns between evaluated preferences, linear within each cell of their Delaunay triangulation; outside of them all,
    those of the nearest one.

    :param wanted: (n, n_objectives)
    :param preferences: (P, n_objectives)
    :param returns: (P, k), any k quantities
    :return: (n, k)
    """
    weights = barycentric_weights(wanted, preferences)
    outside = np.isnan(weights[:, 0])
    if outside.any():
        distances = np.linalg.norm(wanted[outside, None] - preferences, axis=-1)
        weights[outside] = np.eye(len(preferences))[distances.argmin(axis=1)]
    return weights @ returns


def barycentric_weights(wanted: Array, preferences: Array) -> Array:
    """Each wanted preference as a mean of evaluated ones, those around it: weights (n, P) of at least 0 that sum to 1 and
    whose mean it is, with the least sum of weight times squared distance. These are the corners of its Delaunay cell; as a
    linear programme they cost no triangulation, which in many dimensions is large.

    :return: (n, P); NaN where a preference lies outside of all
    """
    n, n_evaluated = len(wanted), len(preferences)
    weights = np.full((n, n_evaluated), np.nan)
    if preferences.shape[1] == 2:
        order = preferences[:, 0].argsort(kind="stable")
        corners, x = preferences[order, 0], wanted[:, 0]
        inside = (x >= corners[0] - TOLERANCE) & (x <= corners[-1] + TOLERANCE)
        right = np.clip(np.searchsorted(corners, x), 1, n_evaluated - 1) if n_evaluated > 1 else np.zeros(n, dtype=np.int64)
        left = np.maximum(right - 1, 0)
        gap = corners[right] - corners[left]
        share = np.clip((x - corners[left]) / np.where(gap > 0, gap, 1), 0, 1)
        rows = np.arange(n)
        weights[inside] = 0
        weights[rows[inside], order[left[inside]]] = 1 - share[inside]
        weights[rows[inside], order[right[inside]]] += share[inside]
        return weights
    equations = np.vstack([preferences.T, np.ones(n_evaluated)])
    for i, w in enumerate(wanted):
        squares = ((preferences - w) ** 2).sum(axis=1)
        nearest = squares.argmin()
        if squares[nearest] < TOLERANCE**2:
            weights[i] = np.eye(n_evaluated)[nearest]
            continue
        solved = linprog(squares, A_eq=equations, b_eq=np.append(w, 1), bounds=(0, None), method="highs")
        if solved.status == 0:
            weights[i] = solved.x / solved.x.sum()
    return weights


def leave_one_out_errors(preferences: Array, returns: Array) -> Array:
    """What the interpolation of all others says of each evaluated preference, less what it returned.

    :return: (P, k); NaN where the others do not lie around it, as at the ends of the front
    """
    errors = np.full(returns.shape, np.nan)
    for i in range(len(preferences)):
        others = np.arange(len(preferences)) != i
        if others.any():
            weights = barycentric_weights(preferences[i : i + 1], preferences[others])
            errors[i] = (weights @ returns[others])[0] - returns[i]
    return errors


def local_error(wanted: Array, preferences: Array, errors: Array) -> Array:
    """Root mean square of the errors known at the nearest evaluated preferences, (n, k); NaN if none is known.

    :param errors: (P, k), NaN where not known
    """
    known = np.isfinite(errors).all(axis=1)
    if not known.any():
        return np.full((len(wanted), errors.shape[1]), np.nan)
    distances = np.linalg.norm(wanted[:, None] - preferences[known], axis=-1)
    nearest = distances.argsort(axis=1, kind="stable")[:, :N_NEAREST]
    return np.asarray(np.sqrt((errors[known][nearest] ** 2).mean(axis=1)))


def exchange_rates(predict: Predict, preference: Array, ranges: Array) -> Array:
    """What one unit less of an objective buys, where a little weight goes from it to another one: the slope of the front
    between the policies on both sides of the preference, in every objective.

    :param preference: (n_objectives,)
    :param ranges: how far each objective's return reaches over the front, (n_objectives,)
    :return: (n_objectives, n_objectives, n_objectives): [i, j] is the change for one less of i where weight goes to j, -1 at
        i; NaN where such a shift does not take from i and give to j
    """
    n = len(preference)
    rates = np.full((n, n, n), np.nan)
    for given, gained in ((i, j) for i in range(n) for j in range(n) if i != j):
        direction = np.eye(n)[gained] - np.eye(n)[given]
        ahead, back = min(STEP, preference[given]), min(STEP, preference[gained])
        ends = predict(np.stack([preference - back * direction, preference + ahead * direction]))
        change = ends[1] - ends[0]
        if -change[given] > SMALLEST_TRADE * ranges[given] and change[gained] > SMALLEST_TRADE * ranges[gained]:
            rates[given, gained] = change / -change[given]
    return rates


@dataclass(frozen=True)
class Bound:
    """At least so much of an objective's return.

    :param objective: its number
    """

    objective: int
    at_least: float

    def is_met(self, returns: Array) -> NDArray[np.bool_]:
        """Of returns (..., n_objectives)."""
        return np.asarray(returns[..., self.objective] >= self.at_least)


def rank_for_bound(bound: Bound, preference: Array, candidates: Array, returns: Array) -> NDArray[np.int64]:
    """The candidates that keep a bound, the best first: the most of the other objectives, in the proportions of the present
    preference (equal ones where it has no weight on them); of equal ones the nearest to it.

    :param preference: the present one, (n_objectives,)
    :param candidates: (n, n_objectives)
    :param returns: of them, (n, n_objectives)
    """
    others = np.arange(len(preference)) != bound.objective
    weights = np.where(others, preference, 0)
    if weights.sum() < TOLERANCE:
        weights = others.astype(np.float64)
    met = np.flatnonzero(bound.is_met(returns))
    worth = returns[met] @ (weights / weights.sum())
    distances = np.linalg.norm(candidates[met] - preference, axis=1)
    return met[np.lexsort([distances, -worth])]


@dataclass(frozen=True)
class Alternative:
    """Another policy with like returns.

    :param index: among those that were compared
    :param distance: between the behaviours, in units of that of an average pair
    :param feature: in which they differ most
    """

    index: int
    distance: float
    feature: int


def find_alternatives(
    returns: Array, behaviour: Array, others_returns: Array, others_behaviour: Array, tolerance: Array
) -> list[Alternative]:
    """Of the policies whose returns lie within a tolerance in every objective, those that move differently, the most different
    first: at least half as far away as an average pair of the policies.

    A behaviour is a row of statistics, such as the mean of each action; each statistic is divided by its standard deviation
    over all policies, and two behaviours are as far apart as the root mean square of their differences.

    :param returns: of the present policy, (n_objectives,)
    :param behaviour: likewise, (F,)
    :param others_returns: (n, n_objectives)
    :param others_behaviour: (n, F)
    :param tolerance: (n_objectives,)
    """
    scale = others_behaviour.std(axis=0)
    scale = np.where(scale > 1e-9, scale, np.inf)  # What is the same everywhere tells nothing apart.
    scaled, here = others_behaviour / scale, behaviour / scale
    pairs = np.sqrt(((scaled[:, None] - scaled) ** 2).mean(axis=-1))
    n = len(scaled)
    average = pairs.sum() / max(n * (n - 1), 1)
    distances = np.sqrt(((scaled - here) ** 2).mean(axis=1)) / (average if average > 0 else 1)
    alike = np.flatnonzero((np.abs(others_returns - returns) <= tolerance).all(axis=1) & (distances >= LEAST_DIFFERENCE))
    order = alike[(-distances[alike]).argsort(kind="stable")][:N_ALTERNATIVES]
    return [Alternative(int(i), float(distances[i]), int(np.abs(scaled[i] - here).argmax())) for i in order]
