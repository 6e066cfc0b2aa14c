"""Non-decreasing utility functions of vector returns that differ from one another: what DPMORL optimises (Cai et al., 2023,
section 4.2).

A utility function takes returns on the unit cube, (n, n_objectives) -> (n,), is 0 at the cube's lowest corner and 1 at its
highest, and rises wherever any of its arguments rises. Numbers are float64.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch as th
from torch import nn

HIDDEN_DIM, HIDDEN_LAYERS, GAIN = 24, 3, 1.5
KINK = 0.5  # where the activations bend
N_POINTS, EDGE, REACH = 256, 0.1, 0.1
VALUE_SHARE, SLOPE_SHARE = 0.1, 0.5
EPOCHS, LEARNING_RATE = 100, 0.02


class LinearUtility(nn.Module):
    """w . x

    :param weights: w, not negative, with the sum 1, (n_objectives,)
    """

    weights: th.Tensor

    def __init__(self, weights: Sequence[float]):
        super().__init__()
        self.register_buffer("weights", th.tensor(weights, dtype=th.float64))

    def forward(self, x: th.Tensor) -> th.Tensor:
        """:param x: (n, n_objectives)"""
        return x @ self.weights


class MonotoneUtility(nn.Module):
    """A network that is non-decreasing by construction: every product has positive weights, and every activation rises.

    Each unit has a convex, a concave and a bounded activation, without which all utilities would be convex or all concave.

    :param n_objectives: d
    :param generator: of the first weights
    :param linear_share: of the mean of x, so that the utility is flat nowhere
    """

    def __init__(self, n_objectives: int, generator: th.Generator, linear_share: float = 0.1):
        super().__init__()
        sizes = [n_objectives, *[HIDDEN_DIM] * HIDDEN_LAYERS, 1]
        shapes = [(m, n if i == 0 else 3 * n) for i, (n, m) in enumerate(pairwise(sizes))]
        draws = [(th.randn(shape, generator=generator), th.rand(shape[0], generator=generator)) for shape in shapes]
        self.logits = nn.ParameterList([nn.Parameter(normal.double()) for normal, _ in draws])
        self.biases = nn.ParameterList([nn.Parameter(2 * uniform.double() - 1) for _, uniform in draws])
        self.linear_share = linear_share

    def forward(self, x: th.Tensor) -> th.Tensor:
        """:param x: (n, n_objectives)"""
        corners = th.stack([th.zeros_like(x[0]), th.ones_like(x[0])])
        low, high = self._network(corners)
        bent = (self._network(x) - low) / (high - low)
        return (1 - self.linear_share) * bent + self.linear_share * x.mean(dim=1)

    def _network(self, x: th.Tensor) -> th.Tensor:
        h = 2 * x - 1
        for layer, (logits, bias) in enumerate(zip(self.logits, self.biases, strict=True)):
            if layer > 0:
                h = th.cat([h.clamp(min=-KINK), h.clamp(max=KINK), h.clamp(-KINK, KINK)], dim=1)
            h = GAIN * h @ logits.softmax(dim=1).T + bias
        return h[:, 0]


class Probes:
    """Where utility functions are compared: points, and displacements from them, both (n, n_objectives)."""

    def __init__(self, n_objectives: int, generator: th.Generator):
        uniform = th.rand((2, N_POINTS, n_objectives), generator=generator, dtype=th.float64)
        self.points = EDGE + (1 - 2 * EDGE) * uniform[0]
        self.displacements = REACH * (2 * uniform[1] - 1)

    def __call__(self, utility: nn.Module) -> th.Tensor:
        """A utility's values, and the angles of its slopes along the displacements, (2, n)."""
        values = utility(self.points)
        slopes = (utility(self.points + self.displacements) - values) / self.displacements.norm(dim=1)
        return th.stack([values, slopes.atan()])


def distance(one: th.Tensor, other: th.Tensor) -> th.Tensor:
    """Of two utilities, as `Probes` sees them: the mean squared differences of values and of angles, weighted.

    :param one: (..., 2, n), like `other`
    :return: (...)
    """
    squared = (one - other).square().mean(dim=-1)
    return VALUE_SHARE * squared[..., 0] + SLOPE_SHARE * squared[..., 1]


def linear_utilities(n_objectives: int) -> list[nn.Module]:
    """The mean, and for each objective a weighted mean in which it counts four times as much as another."""
    weights = [[1.0 + 3.0 * (i == j) for j in range(n_objectives)] for i in range(n_objectives)]
    return [LinearUtility([w / sum(row) for w in row]) for row in [[1.0] * n_objectives, *weights]]


def generate_utilities(n: int, n_objectives: int, generator: th.Generator, linear_share: float = 0.1) -> list[nn.Module]:
    """Linear utilities first, then learned ones, each as far from the nearest of those before it as it gets.

    :param n: how many
    :param generator: of all random numbers
    :param linear_share: of the learned ones
    """
    probes = Probes(n_objectives, generator)
    utilities = linear_utilities(n_objectives)[:n]
    seen = [probes(utility) for utility in utilities]
    while len(utilities) < n:
        utility = MonotoneUtility(n_objectives, generator, linear_share)
        move_away(utility, probes, th.stack(seen))
        utilities.append(utility.requires_grad_(False))
        seen.append(probes(utility))
    return utilities


def move_away(utility: nn.Module, probes: Probes, others: th.Tensor) -> None:
    """Maximise the distance to the nearest of other utilities.

    :param others: as `probes` sees them, (n_others, 2, n)
    """
    optimizer = th.optim.Adam(utility.parameters(), lr=LEARNING_RATE)
    for _ in range(EPOCHS):
        loss = -distance(probes(utility), others).min()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()


class UtilityOfReturns:
    """A utility function of returns in their own unit: f(z) = d s u((z - lowest) / s), where s, the width of the cube, is the
    largest range of an objective, and d their number. The mean utility's differences so are the sums of rewards.

    :param utility: u, on the unit cube
    :param low: lowest returns, (n_objectives,)
    :param high: highest ones
    """

    def __init__(self, utility: nn.Module, low: th.Tensor, high: th.Tensor):
        self.utility = utility
        self.width = float((high - low).max())
        self.lowest = (low + high - self.width) / 2

    def __call__(self, z: th.Tensor) -> th.Tensor:
        """:param z: (n, n_objectives) -> (n,), both float64"""
        with th.no_grad():
            return z.shape[1] * self.width * self.utility((z - self.lowest) / self.width)
