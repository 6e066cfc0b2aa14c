"""Quality of a set of value vectors (section 4.1.2). All returns are maximised.

Shapes: `values` is (n_solutions, n_objectives), `preferences` is (n_preferences, n_objectives).
"""

import moocore
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

EXACT_UP_TO = 6  # objectives: with every one more, the exact hypervolume takes many times as long, and no signal ends it
N_DIRECTIONS = 2**20  # of the approximation, which takes about a second


def as_points(values: ArrayLike, name: str = "values", at_least: int = 0) -> Array:
    """Value vectors as a finite float64 (n, n_objectives) array of at least so many rows.

    :raises ValueError: naming the array and its shape
    """
    points = np.asarray(values, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] == 0:
        raise ValueError(f"{name} has shape {points.shape}: give (n, n_objectives).")
    if len(points) < at_least:
        raise ValueError(f"{name} has no rows: give at least {at_least}.")
    if not np.isfinite(points).all():
        raise ValueError(f"{name} has an entry that is not finite.")
    return points


def hypervolume(values: ArrayLike, reference_point: ArrayLike) -> float:
    """HV, eq. (4.1): the volume between the reference point and what the values dominate, in the product of their units.

    Exact for up to six objectives. For more it is approximated, without random numbers: within 1 % for most sets of up to ten
    objectives; several % off where each value lies barely above the reference point in some objective, or with more objectives.

    :param values: (n_solutions, n_objectives); none give 0
    :param reference_point: (n_objectives,); values that are not above it in every objective count for nothing
    :raises ValueError: for another shape, or an entry that is not finite
    """
    points = as_points(values)
    reference = np.asarray(reference_point, dtype=np.float64)
    if reference.shape != (points.shape[1],):
        raise ValueError(f"The reference point {reference_point!r} has shape {reference.shape}, not ({points.shape[1]},).")
    if not np.isfinite(reference).all():
        raise ValueError(f"The reference point {reference_point!r} is not finite.")
    points = points[(points > reference).all(axis=1)]
    if len(points) == 0:
        return 0.0
    if points.shape[1] == 1:
        return float(points.max() - reference[0])
    if points.shape[1] <= EXACT_UP_TO:
        return float(moocore.hypervolume(points, ref=reference, maximise=True))
    heights = points - reference
    span = heights.max(axis=0)  # Directions that are equally spaced see nothing of objectives with small units.
    share = moocore.hv_approx(heights / span, ref=0, maximise=True, nsamples=N_DIRECTIONS, method="Rphi-FWE+")
    return float(share * span.prod())


def expected_utility(values: ArrayLike, preferences: ArrayLike) -> float:
    """EUM, eq. (4.2): the mean over preferences w of max_i w . V_i, in the unit of the scalarised return.

    :param values: V_i, (n_solutions, n_objectives)
    :param preferences: w, (n_preferences, n_objectives)
    :raises ValueError: for another shape, no rows, or an entry that is not finite
    """
    return float(_utilities(values, preferences).max(axis=1).mean())


def preference_regret(values: ArrayLike, preferences: ArrayLike) -> float:
    """The mean of `regrets`. EUM hides it. At least 0, and better when smaller.

    A metric of this project; the thesis has none like it.

    :param values: V_w for each preference, in their order, (n_preferences, n_objectives)
    :param preferences: w, (n_preferences, n_objectives)
    :raises ValueError: as `regrets`
    """
    return float(regrets(values, preferences).mean())


def regrets(values: ArrayLike, preferences: ArrayLike) -> Array:
    """max_i w . V_i - w . V_w of each w, (n_preferences,), in the unit of the scalarised return: what a user loses who asks for
    w, because the policy answers another preference better.

    :param values: V_w for each preference, in their order, (n_preferences, n_objectives)
    :param preferences: w, (n_preferences, n_objectives)
    :raises ValueError: for another shape, no rows, an entry that is not finite, or not one value per preference
    """
    utilities = _utilities(values, preferences)
    if utilities.shape[0] != utilities.shape[1]:
        raise ValueError(f"{utilities.shape[1]} values for {utilities.shape[0]} preferences: give one value per preference.")
    return np.asarray(utilities.max(axis=1) - utilities.diagonal())


def inverted_generational_distance(values: ArrayLike, reference_front: ArrayLike) -> float:
    """IGD, eq. (4.3): the mean Euclidean distance from each point of a reference front to the nearest value.

    Objectives of different units should be normalised first (section 4.4: the front's range to [0, 1]).

    :param values: (n_solutions, n_objectives)
    :param reference_front: (n_points, n_objectives)
    :raises ValueError: for another shape, no rows, or an entry that is not finite
    """
    points, front = as_points(values, at_least=1), as_points(reference_front, "reference_front", at_least=1)
    if points.shape[1] != front.shape[1]:
        raise ValueError(f"values have {points.shape[1]} objectives, the reference front {front.shape[1]}.")
    return float(moocore.igd(points, ref=front, maximise=True))


def non_dominated(values: ArrayLike) -> NDArray[np.bool_]:
    """Which values no other value exceeds in one objective without falling behind in another, (n,); of equal ones the first."""
    points = as_points(values)
    if points.shape[1] == 1:
        first_best = points.argmax() if len(points) > 0 else -1
        return np.arange(len(points)) == first_best
    return np.asarray(moocore.is_nondominated(points, maximise=True, keep_weakly=False), dtype=bool)


def convex_envelope(values: ArrayLike) -> Array:
    """The values that some preference likes best, each one once: the convex envelope of section 4.4.

    For each value v a linear programme looks for the preference w that puts it furthest ahead: max t with w.(v - u) >= t for
    all others u; v belongs to the envelope if t is not negative.

    :return: (n, n_objectives)
    """
    points = np.unique(as_points(values, at_least=1), axis=0)
    points = points[non_dominated(points)]
    span = np.ptp(points, axis=0)
    scaled = (points - points.min(axis=0)) / np.where(span > 0, span, 1)
    return points[[_largest_lead(v - np.delete(scaled, i, axis=0)) > -1e-9 for i, v in enumerate(scaled)]]


def _largest_lead(leads: Array) -> float:
    """max over preferences w of min_i w.leads_i, (n, n_objectives) -> t; infinite where there is no other."""
    n, n_objectives = leads.shape
    if n == 0:
        return np.inf
    from scipy.optimize import linprog  # It takes a fifth of a second to import.

    found = linprog(
        c=[*[0.0] * n_objectives, -1.0],
        A_ub=np.hstack([-leads, np.ones((n, 1))]),
        b_ub=np.zeros(n),
        A_eq=[[*[1.0] * n_objectives, 0.0]],
        b_eq=[1.0],
        bounds=[*[(0, 1)] * n_objectives, (None, None)],
    )
    return float(-found.fun)


def summarise(
    values: ArrayLike, preferences: ArrayLike, reference_point: ArrayLike, general_policy: bool = True
) -> dict[str, float]:
    """The numbers that describe one evaluation, under the names of logs and records.

    :param values: V_w for each preference, in their order, (n_preferences, n_objectives); any (n_solutions, n_objectives)
        without a general policy
    :param general_policy: whether one policy answers the preferences; a set of solutions answers none, and regrets nothing
    """
    regret = {"preference_regret": preference_regret(values, preferences)} if general_policy else {}
    return {
        "hypervolume": hypervolume(values, reference_point),
        "expected_utility": expected_utility(values, preferences),
        **regret,
        "n_non_dominated": float(non_dominated(values).sum()),
    }


def _utilities(values: ArrayLike, preferences: ArrayLike) -> Array:
    """w . V for each preference and value, (n_preferences, n_solutions)."""
    points, w = as_points(values, at_least=1), as_points(preferences, "preferences", at_least=1)
    if points.shape[1] != w.shape[1]:
        raise ValueError(f"values have {points.shape[1]} objectives, preferences {w.shape[1]}.")
    return w @ points.T
