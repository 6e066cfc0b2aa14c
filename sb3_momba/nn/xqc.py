"""XQC's networks (Palenicek et al., 2025, "XQC: Well-conditioned Optimization Accelerates Deep Reinforcement Learning",
arXiv 2509.25174; sizes and constants as in the authors' code)."""

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_momba.nn.batch_norm import BatchNorm
from sb3_momba.nn.layers import Film, HyperDense, UnitHead
from sb3_momba.nn.networks import Trunk

XQC_EPS = 1e-3
XQC_LOG_STD_MIN, XQC_LOG_STD_MAX = -10.0, 2.0


class XqcTrunk(Trunk):
    """Batch norm of the input, then blocks x <- ReLU(BN(W x)), W without bias and of unit-norm columns.

    Of our own: the preference beside the hidden input of a block ("all"), which batch norm does not touch, and FiLM behind
    its ReLU.
    """

    shares_batches = True

    def __init__(
        self,
        input_dim: int,
        preference_dim: int,
        hidden_dim: int,
        n_blocks: int,
        conditioning: str = "input",
        n_members: int | None = None,
    ):
        super().__init__(preference_dim, conditioning)
        self.features_dim = hidden_dim
        self.input_norm = BatchNorm(input_dim, XQC_EPS, n_members)
        # The first layer reads the preference anyway, as part of the input.
        widths = [input_dim, *[hidden_dim + self.appended_dim] * (n_blocks - 1)]
        self.layers = nn.ModuleList(HyperDense(width, hidden_dim, n_members) for width in widths)
        self.norms = nn.ModuleList(BatchNorm(hidden_dim, XQC_EPS, n_members) for _ in widths)
        self.films = nn.ModuleList(Film(preference_dim, hidden_dim, n_members) for _ in widths if self.film_dim > 0)

    def forward(self, x: th.Tensor, preference: th.Tensor) -> th.Tensor:
        x = self.input_norm(x)
        for i, (layer, norm) in enumerate(zip(self.layers, self.norms, strict=True)):
            x = F.relu(norm(layer(x if i == 0 else self.append(x, preference))))
            if self.film_dim > 0:
                x = self.films[i](x, preference)
        return x


class XqcArchitecture:
    """XQC: batch norm before every ReLU, unit-norm layers, a dense head with bias, log std clamped to [-10, 2].

    :param hidden_dim: width of every block
    :param n_blocks: number of blocks
    """

    def __init__(self, hidden_dim: int, n_blocks: int, conditioning: str):
        self.hidden_dim, self.n_blocks, self.conditioning = hidden_dim, n_blocks, conditioning

    def trunk(self, input_dim: int, preference_dim: int, n_members: int | None) -> Trunk:
        return XqcTrunk(input_dim, preference_dim, self.hidden_dim, self.n_blocks, self.conditioning, n_members)

    def head(self, features_dim: int, output_dim: int, n_members: int | None) -> nn.Module:
        return UnitHead(features_dim, output_dim, n_members)

    def log_std(self, raw: th.Tensor) -> th.Tensor:
        return th.clamp(raw, XQC_LOG_STD_MIN, XQC_LOG_STD_MAX)
