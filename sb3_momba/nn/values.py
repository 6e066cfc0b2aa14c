"""What a critic's outputs mean: a distribution trained by cross-entropy, or an expected value trained by squared error.

Both have one signature, so that the update reads the same for either. Shapes: outputs and targets are
(batch, n_critics, n_values, n_outputs); a value or a loss has the last dimension summed away.
"""

from typing import Protocol

import torch as th
from torch import nn

from sb3_momba.nn.distributional import cross_entropy, expectation, make_support, project


class ValueRepresentation(Protocol):
    n_outputs: int

    def mean(self, outputs: th.Tensor) -> th.Tensor:
        """Q, the expected return that a critic's outputs stand for, (batch, n_critics, n_values)."""

    def bootstrap(self, next_outputs: th.Tensor, rewards: th.Tensor, discounts: th.Tensor, bonus: th.Tensor) -> th.Tensor:
        """Targets r + discount * (next return + bonus), (batch, n_critics, n_values, n_outputs).

        :param next_outputs: of the target critics at (s', a', w)
        :param rewards: (batch, n_values)
        :param discounts: gamma^n, 0 where the return ends, (batch,)
        :param bonus: the entropy term -alpha log pi(a' | s', w), (batch,)
        """

    def target_mean(self, targets: th.Tensor) -> th.Tensor:
        """What targets expect, (batch, n_critics, n_values)."""

    def loss(self, outputs: th.Tensor, target: th.Tensor) -> th.Tensor:
        """Of each critic and value, (batch, n_critics, n_values)."""

    def end_mass(self, targets: th.Tensor) -> th.Tensor:
        """The larger of the masses that targets put on the two ends of the support, (batch, n_critics, n_values)."""


class DistributionalValue(nn.Module):
    """Outputs are the logits of a categorical distribution on fixed atoms (C51; section 3.2)."""

    support: th.Tensor

    def __init__(self, v_min: float, v_max: float, n_atoms: int):
        super().__init__()
        self.n_outputs = n_atoms
        self.register_buffer("support", make_support(v_min, v_max, n_atoms))

    def mean(self, outputs: th.Tensor) -> th.Tensor:
        """Eqs. (3.6), (3.12) and (3.15)."""
        return expectation(outputs.softmax(dim=-1), self.support)

    def bootstrap(self, next_outputs: th.Tensor, rewards: th.Tensor, discounts: th.Tensor, bonus: th.Tensor) -> th.Tensor:
        """Phi(r + gamma (1 - delta) (Z - alpha log pi)), eqs. (3.11), (3.14) and section 3.4.2: the entropy term shifts
        the atoms."""
        atoms = discounts[:, None] * (self.support + bonus[:, None])  # (batch, n_atoms)
        atoms = rewards[:, None, :, None] + atoms[:, None, None, :]  # (batch, 1, n_values, n_atoms)
        return project(next_outputs.softmax(dim=-1), atoms, self.support)

    def target_mean(self, targets: th.Tensor) -> th.Tensor:
        return expectation(targets, self.support)

    def loss(self, outputs: th.Tensor, target: th.Tensor) -> th.Tensor:
        """Eqs. (3.10), (3.13)."""
        return cross_entropy(target, outputs)

    def end_mass(self, targets: th.Tensor) -> th.Tensor:
        return th.maximum(targets[..., 0], targets[..., -1])


class ExpectedValue(nn.Module):
    """The output is the expected return itself (SAC, CAPQL)."""

    def __init__(self) -> None:
        super().__init__()
        self.n_outputs = 1

    def mean(self, outputs: th.Tensor) -> th.Tensor:
        return outputs.squeeze(-1)

    def bootstrap(self, next_outputs: th.Tensor, rewards: th.Tensor, discounts: th.Tensor, bonus: th.Tensor) -> th.Tensor:
        """r + gamma (1 - delta) (Q - alpha log pi), eqs. (2.8) and (3.3)."""
        discounts, bonus = discounts[:, None, None, None], bonus[:, None, None, None]
        return rewards[:, None, :, None] + discounts * (next_outputs + bonus)

    def target_mean(self, targets: th.Tensor) -> th.Tensor:
        return targets.squeeze(-1)

    def loss(self, outputs: th.Tensor, target: th.Tensor) -> th.Tensor:
        """(target - Q)^2, eqs. (2.4) and (3.2)."""
        return (target - outputs).squeeze(-1).square()

    def end_mass(self, targets: th.Tensor) -> th.Tensor:
        """An expected value has no support to leave."""
        return th.zeros_like(targets[..., 0])
