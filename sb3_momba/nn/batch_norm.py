"""Batch normalisation (Ioffe and Szegedy, 2015) for networks that learn from a replay buffer.

While training, a layer normalises with the mean and variance of the batch that it is given; acting, evaluating and exported,
with running averages of them, so that an action depends on nothing but its own observation. Each member of an ensemble has
its own. Which pass is which, and when the averages move, the update says:

- `without_batch_statistics`: a pass of a network in training mode that only asks it, as the environment's side would
- `follow_batch_statistics`: after a good step; a forward pass alone changes nothing that is saved
"""

import contextlib
from collections.abc import Iterator

import torch as th
from torch import nn

from sb3_momba.nn.layers import in_float32

MOMENTUM = 0.01  # of the running averages, of XQC and FlashSAC alike


class BatchNorm(nn.Module):
    """(x - mean) / sqrt(variance + eps) * gain + shift over the batch dimension, in float32.

    Shapes: (batch, features), seen by every member alike, or (n_members, batch, features) -> as `dense`.
    """

    running_mean: th.Tensor
    running_variance: th.Tensor
    batch_mean: th.Tensor
    batch_variance: th.Tensor

    def __init__(self, features: int, eps: float, n_members: int | None = None):
        super().__init__()
        self.eps = eps
        # Ensembles need the batch dimension between member and feature.
        shape = (features,) if n_members is None else (n_members, 1, features)
        self.gain = nn.Parameter(th.ones(shape))
        self.shift = nn.Parameter(th.zeros(shape))
        self.register_buffer("running_mean", th.zeros(shape))
        self.register_buffer("running_variance", th.ones(shape))
        self.register_buffer("batch_mean", th.zeros(shape), persistent=False)
        self.register_buffer("batch_variance", th.ones(shape), persistent=False)

    def forward(self, x: th.Tensor) -> th.Tensor:
        x = in_float32(x)
        if not self.training:
            return self.scaled(x - self.running_mean, self.running_variance)
        members = x.dim() == 3
        mean = x.mean(dim=-2, keepdim=members)
        centred = x - mean
        variance = centred.square().mean(dim=-2, keepdim=members)
        with th.no_grad():
            self.batch_mean.copy_(mean)
            self.batch_variance.copy_(variance)
        return self.scaled(centred, variance)

    def scaled(self, centred: th.Tensor, variance: th.Tensor) -> th.Tensor:
        return th.addcmul(self.shift, centred, (variance + self.eps).rsqrt() * self.gain)

    def follow(self) -> None:
        """Move the running averages towards the last batch's mean and variance (1/n, as in Flax, not 1/(n - 1))."""
        self.running_mean.lerp_(self.batch_mean, MOMENTUM)
        self.running_variance.lerp_(self.batch_variance, MOMENTUM)


def follow_batch_statistics(network: nn.Module) -> None:
    """Move the running averages of every batch norm of a network towards what its last pass in training mode has seen."""
    for module in network.modules():
        if isinstance(module, BatchNorm):
            module.follow()


@contextlib.contextmanager
def without_batch_statistics(network: nn.Module) -> Iterator[None]:
    """Inside, batch norm normalises with its running averages, also in training mode."""
    layers = [module for module in network.modules() if isinstance(module, BatchNorm) and module.training]
    for layer in layers:
        layer.training = False
    try:
        yield
    finally:
        for layer in layers:
            layer.training = True
