"""FlashSAC's networks (Kim et al., 2026, "FlashSAC: Fast and Stable Off-Policy Reinforcement Learning for High-Dimensional
Robot Control", arXiv 2604.04539; sizes and constants as in the authors' code)."""

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_momba.nn.batch_norm import BatchNorm
from sb3_momba.nn.layers import EPS, EXPANSION, Film, HyperDense, Projected, UnitHead
from sb3_momba.nn.networks import Trunk, squash_log_std

BATCH_NORM_EPS, RMS_NORM_EPS = 1e-5, 1e-6


class UnitBatchNorm(BatchNorm, Projected):
    """Batch norm whose gains and shifts, 2 d numbers of one member, `project` puts back to a joint norm of sqrt(d)."""

    def __init__(self, features: int, n_members: int | None = None):
        super().__init__(features, BATCH_NORM_EPS, n_members)

    @th.no_grad()
    def project(self) -> None:
        squares = self.gain.square() + self.shift.square()
        factor = squares.mean(dim=-1, keepdim=True).clamp_min(EPS**2).rsqrt()
        self.gain.mul_(factor)
        self.shift.mul_(factor)


class UnitRmsNorm(Projected):
    """x / sqrt(mean of x_i^2) * gain over the features (Zhang and Sennrich, 2019); `project` puts the d gains of a member back
    to a norm of sqrt(d), and so bounds the features'."""

    def __init__(self, features: int, n_members: int | None = None):
        super().__init__()
        self.gain = nn.Parameter(th.ones((features,) if n_members is None else (n_members, 1, features)))

    def forward(self, x: th.Tensor) -> th.Tensor:
        return x * (x.square().mean(dim=-1, keepdim=True) + RMS_NORM_EPS).rsqrt() * self.gain

    @th.no_grad()
    def project(self) -> None:
        self.gain.mul_(self.gain.square().mean(dim=-1, keepdim=True).clamp_min(EPS**2).rsqrt())


class FlashSacEmbedder(nn.Module):
    """x_emb = W_e BN(x)."""

    def __init__(self, in_features: int, hidden_dim: int, n_members: int | None = None):
        super().__init__()
        self.norm = UnitBatchNorm(in_features, n_members)
        self.dense = HyperDense(in_features, hidden_dim, n_members)

    def forward(self, x: th.Tensor) -> th.Tensor:
        return self.dense(self.norm(x))


class FlashSacBlock(nn.Module):
    """The inverted residual block x + ReLU(BN_2(W_2 ReLU(BN_1(W_1 x)))), four times as wide inside.

    :param in_features: width of what W_1 reads: `hidden_dim`, and more where the preference joins the block's input
    """

    def __init__(self, in_features: int, hidden_dim: int, n_members: int | None = None):
        super().__init__()
        self.dense1 = HyperDense(in_features, EXPANSION * hidden_dim, n_members)
        self.norm1 = UnitBatchNorm(EXPANSION * hidden_dim, n_members)
        self.dense2 = HyperDense(EXPANSION * hidden_dim, hidden_dim, n_members)
        self.norm2 = UnitBatchNorm(hidden_dim, n_members)

    def forward(self, x: th.Tensor, block_input: th.Tensor) -> th.Tensor:
        """
        :param x: what the block adds to, (..., hidden_dim)
        :param block_input: what W_1 reads, (..., in_features): x itself, or x with the preference appended
        """
        return x + F.relu(self.norm2(self.dense2(F.relu(self.norm1(self.dense1(block_input))))))


class FlashSacTrunk(Trunk):
    """Embedder, inverted residual blocks and, behind the last of them, RMS norm. Of our own: the preference beside a block's
    input ("all") and FiLM behind the block."""

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
        self.embedder = FlashSacEmbedder(input_dim, hidden_dim, n_members)
        self.blocks = nn.ModuleList(
            FlashSacBlock(hidden_dim + self.appended_dim, hidden_dim, n_members) for _ in range(n_blocks)
        )
        self.films = nn.ModuleList(Film(preference_dim, hidden_dim, n_members) for _ in range(n_blocks) if self.film_dim > 0)
        self.norm = UnitRmsNorm(hidden_dim, n_members)

    def forward(self, x: th.Tensor, preference: th.Tensor) -> th.Tensor:
        x = self.embedder(x)
        for i, block in enumerate(self.blocks):
            x = block(x, self.append(x, preference))
            if self.film_dim > 0:
                x = self.films[i](x, preference)
        return self.norm(x)


class FlashSacArchitecture:
    """FlashSAC: inverted residual blocks with batch norm, unit-norm layers, a dense head with bias, SimbaV2's log std.

    :param hidden_dim: width h of the embedding; a block is 4h wide inside
    :param n_blocks: number of blocks
    """

    def __init__(self, hidden_dim: int, n_blocks: int, conditioning: str):
        self.hidden_dim, self.n_blocks, self.conditioning = hidden_dim, n_blocks, conditioning

    def trunk(self, input_dim: int, preference_dim: int, n_members: int | None) -> Trunk:
        return FlashSacTrunk(input_dim, preference_dim, self.hidden_dim, self.n_blocks, self.conditioning, n_members)

    def head(self, features_dim: int, output_dim: int, n_members: int | None) -> nn.Module:
        return UnitHead(features_dim, output_dim, n_members)

    def log_std(self, raw: th.Tensor) -> th.Tensor:
        return squash_log_std(raw)
