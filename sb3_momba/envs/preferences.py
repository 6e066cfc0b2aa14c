"""Preferences on the probability simplex (Definition 3): checks, samplers and grids.

A sampler is any callable `rng -> (n_objectives,)`, where rng is a `numpy.random.Generator`. One with a true attribute
`per_step` is asked for a new preference after every step instead of every episode. One with a whole number
`remembered_episodes` is called as `sampler(rng, preferences, returns)`, with those of so many of the environment's latest
episodes, the newest last: both (n, n_objectives), the returns undiscounted.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from itertools import combinations
from math import comb
from typing import Any

import numpy as np

from sb3_momba.finite import all_finite

PreferenceSampler = Callable[..., np.ndarray]
SamplerSpec = str | dict[str, Any] | Sequence[float]

SIMPLEX_TOLERANCE = 1e-5

logger = logging.getLogger(__name__)


def preference_dim(n_objectives: int) -> int:
    """How many numbers of an observation are the preference: none with one objective, where there is nothing to prefer."""
    return n_objectives if n_objectives > 1 else 0


def check_preference(preference: Sequence[float] | np.ndarray, n_objectives: int) -> np.ndarray:
    """A preference, or a batch of them, as float32 on the simplex; rounding errors are normalised away.

    :param preference: (n_objectives,) or (batch, n_objectives), not negative, each summing to 1
    :raises ValueError: names what is wrong with it
    """
    try:
        w = np.asarray(preference, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"The preference {preference!r} is not an array of {n_objectives} numbers.") from error
    if w.ndim not in (1, 2) or w.shape[-1] != n_objectives:
        raise ValueError(f"The preference {preference!r} has shape {w.shape}: give {n_objectives} weights, one per objective.")
    if not all_finite(w):
        raise ValueError(f"The preference {preference!r} has a weight that is not finite.")
    if (w < -SIMPLEX_TOLERANCE).any():
        raise ValueError(f"The preference {preference!r} has a negative weight: weights are at least 0 and sum to 1.")
    total = w.sum(axis=-1, keepdims=True)
    if (np.abs(total - 1) > SIMPLEX_TOLERANCE).any():
        raise ValueError(f"The preference {preference!r} sums to {total.squeeze()}, not to 1: divide it by its sum.")
    w = w.clip(min=0.0)
    return (w / w.sum(axis=-1, keepdims=True)).astype(np.float32)


@dataclass(frozen=True)
class UniformSampler:
    """w ~ Dirichlet(1_d), uniform on the simplex (Algorithm 1)."""

    n_objectives: int

    def __call__(self, rng: np.random.Generator) -> np.ndarray:
        return rng.dirichlet(np.ones(self.n_objectives))


@dataclass(frozen=True)
class FixedSampler:
    """Always the same preference (section 4.2.4)."""

    preference: tuple[float, ...]

    def __call__(self, rng: np.random.Generator) -> np.ndarray:
        return np.asarray(self.preference)


@dataclass(frozen=True)
class PerStepSampler:
    """Another sampler, asked for a new preference after every step, as CAPQL does."""

    sampler: PreferenceSampler
    per_step: bool = True

    def __call__(self, rng: np.random.Generator) -> np.ndarray:
        return self.sampler(rng)


@dataclass(frozen=True)
class ConeSampler:
    """Preferences within an angle of the simplex's centre, as CAPQL's code draws them: an angle uniform in [0, angle], a
    direction uniform around the axis (1, ..., 1).

    :param angle: in degrees
    """

    n_objectives: int
    angle: float = 22.5

    def __call__(self, rng: np.random.Generator) -> np.ndarray:
        axis = np.full(self.n_objectives, self.n_objectives**-0.5)
        direction = rng.standard_normal(self.n_objectives)
        direction -= (direction @ axis) * axis
        direction /= np.linalg.norm(direction)
        w = np.clip(axis + np.tan(np.deg2rad(self.angle) * rng.random()) * direction, 0, None)
        return w / w.sum()


@dataclass(frozen=True)
class GainSampler:
    """Of some preferences from the uniform distribution, the one at which there is most to gain: where the latest answer to the
    nearest preference earns least beside the best of all latest answers (as GPI-LS chooses by its critics' values; Alegre et
    al., 2023). Each choice looks at other candidates, so that every preference's turn comes.

    :param candidates: that one is chosen of
    :param remembered_episodes: latest ones that are looked back on; of several environments each has its own
    """

    n_objectives: int
    candidates: int = 8
    remembered_episodes: int = 50

    def __post_init__(self) -> None:
        for name, number in (("candidates", self.candidates), ("remembered_episodes", self.remembered_episodes)):
            if not isinstance(number, int) or isinstance(number, bool) or number < 1:
                raise ValueError(f"{name}={number!r}: it must be a whole number of at least 1")

    def __call__(
        self, rng: np.random.Generator, preferences: np.ndarray | None = None, returns: np.ndarray | None = None
    ) -> np.ndarray:
        w = rng.dirichlet(np.ones(self.n_objectives), self.candidates)
        if preferences is None or returns is None or len(preferences) == 0:
            return w[0]
        preferences, returns = preferences[::-1], returns[::-1]  # Of equally near ones the latest counts.
        utilities = w @ returns.T  # (candidates, n)
        nearest = np.abs(w[:, None] - preferences).sum(axis=-1).argmin(axis=1)
        return w[(utilities.max(axis=1) - utilities[np.arange(len(w)), nearest]).argmax()]


def make_sampler(spec: PreferenceSampler | SamplerSpec, n_objectives: int) -> PreferenceSampler:
    """A sampler from a literal, as configuration files write it; a callable is returned as it is.

    :param spec: "uniform"; "cone"; "gain"; weights to keep; or a dictionary with `name`, for "cone" the `angle` in degrees, for
        "gain" its `candidates` and `remembered_episodes`, for "fixed" the `preference`, and for all but "gain" `per_step`, a
        new preference after every step
    :raises ValueError: for anything else
    """
    if callable(spec):
        return spec
    if isinstance(spec, str):
        options: dict[str, Any] = {"name": spec}
    else:
        options = dict(spec) if isinstance(spec, dict) else {"name": "fixed", "preference": spec}
    name, per_step = options.pop("name", None), options.pop("per_step", False)
    try:
        if n_objectives == 1:
            sampler: PreferenceSampler = UniformSampler(1)
        elif name == "uniform":
            sampler = UniformSampler(n_objectives, **options)
        elif name == "cone":
            sampler = ConeSampler(n_objectives, **options)
        elif name == "gain" and not per_step:
            sampler = GainSampler(n_objectives, **options)
        elif name == "gain":
            raise ValueError("it compares the returns of episodes: leave per_step out")
        elif name == "fixed":
            w = check_preference(options.pop("preference"), n_objectives)
            sampler = FixedSampler(tuple(w.tolist()), **options)
        else:
            raise ValueError(f"its name must be uniform, cone, gain or fixed, not {name!r}")
    except (TypeError, KeyError, ValueError) as error:
        raise ValueError(f"preference_sampler={spec!r} is not understood: {str(error).rstrip('.')}.") from error
    return PerStepSampler(sampler) if per_step else sampler


def simplex_lattice(n_objectives: int, divisions: int) -> np.ndarray:
    """All preferences whose weights are multiples of 1 / divisions (Das & Dennis, 1998), in lexicographic order.

    :return: (C(divisions + n_objectives - 1, n_objectives - 1), n_objectives)
    """
    bars = combinations(range(divisions + n_objectives - 1), n_objectives - 1)
    edges = np.array([[-1, *bar, divisions + n_objectives - 1] for bar in bars])
    return (np.diff(edges, axis=1) - 1) / divisions


def corner_weights(values: np.ndarray) -> np.ndarray:
    """The preferences at which the best of some solutions changes, the corners of the simplex among them: where new solutions
    can gain most (linear support; Roijers, 2016; Alegre et al., 2023).

    They are the corners (w, u) of the region above the utilities, u >= w.v for every v, with w on the simplex.

    :param values: v of each solution, (n, n_objectives), in any unit
    :return: (n_corners, n_objectives), in no order
    :raises ValueError: for fewer than two objectives, no solution, or values that are not finite
    """
    from scipy.spatial import HalfspaceIntersection  # A fifth of a second that only this function needs.

    if values.ndim != 2 or values.shape[0] < 1 or values.shape[1] < 2 or not all_finite(values):
        raise ValueError(f"values of shape {values.shape}: give finite ones of one solution or more, two objectives or more.")
    n_objectives = values.shape[1]
    size = np.abs(values).max() + 1e-12
    # The last weight is 1 less the others. Rows (a, b) of a.x + b <= 0 with x = (w_1 ... w_{d-1}, u).
    others = n_objectives - 1
    scaled = np.unique((values / size).round(9), axis=0)  # Qhull stumbles over solutions that are nearly the same.
    below = np.column_stack([scaled[:, :-1] - scaled[:, -1:], -np.ones(len(scaled)), scaled[:, -1]])
    not_negative = np.column_stack([-np.eye(others), np.zeros((others, 2))])
    sum_at_most_1 = np.r_[np.ones(others), 0, -1]
    top = np.r_[np.zeros(others), 1, -2]  # scaled utilities are at most 1
    inside = np.r_[np.full(others, 1 / n_objectives), 1.5]
    corners = HalfspaceIntersection(np.vstack([below, not_negative, sum_at_most_1, top]), inside).intersections
    weights = corners[corners[:, -1] < 1.75, :-1]
    weights = np.column_stack([weights, 1 - weights.sum(axis=1)]).clip(0, None)
    return np.unique((weights / weights.sum(axis=1, keepdims=True)).round(9), axis=0)


@lru_cache
def _riesz_grids() -> dict[str, np.ndarray]:
    with resources.files("sb3_momba.envs").joinpath("riesz.npz").open("rb") as file, np.load(file) as grids:
        return dict(grids)


def preference_grid(n_objectives: int, n_preferences: int = 100) -> np.ndarray:
    """Equally spaced preferences on the simplex (section 4.1.2).

    Two objectives: `linspace`, exactly n. Three to six: 100 points of least Riesz energy (Blank et al., 2021), and for three
    also 50 (section 4.2.4), computed with pymoo's `get_reference_directions("energy", d, n, seed=1)`. Any other n: the
    smallest simplex lattice with at least n points, said in the log.

    :return: float64 (n, n_objectives)
    """
    if n_objectives < 1 or n_preferences < 1:
        raise ValueError(f"n_objectives={n_objectives}, n_preferences={n_preferences}: both must be at least 1.")
    if n_objectives == 1:
        return np.ones((1, 1))
    if n_objectives == 2:
        first = np.linspace(0, 1, n_preferences) if n_preferences > 1 else np.array([0.5])
        return np.stack([first, 1 - first], axis=1)
    if (size := f"{n_objectives}x{n_preferences}") in _riesz_grids():
        return _riesz_grids()[size].copy()
    divisions = 1
    while comb(divisions + n_objectives - 1, n_objectives - 1) < n_preferences:
        divisions += 1
    grid = simplex_lattice(n_objectives, divisions)
    if len(grid) != n_preferences:
        logger.warning(
            "%d preferences asked for %d objectives: the smallest simplex lattice with as many has %d.",
            n_preferences,
            n_objectives,
            len(grid),
        )
    return grid
