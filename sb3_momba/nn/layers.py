"""SimbaV2's layers (Lee et al., 2025; section 3.3 of the thesis).

`n_members=None` builds one network; an integer builds an ensemble of that many networks as one batched module, whose
weights and activations carry the member as their first dimension.

Shapes: (batch, features) for one network, (n_members, batch, features) inside an ensemble.
"""

import math
from collections.abc import Callable

import torch as th
import torch.nn.functional as F
from torch import nn

EPS = 1e-8
C_SHIFT = 3.0
EXPANSION = 4

Normalization = Callable[[th.Tensor], th.Tensor]


def l2_norm(x: th.Tensor) -> th.Tensor:
    """Of the last dimension, which stays with length 1; at least EPS."""
    return th.linalg.vector_norm(x, dim=-1, keepdim=True).clamp_min(EPS)


def l2_normalize(x: th.Tensor) -> th.Tensor:
    """Divide by the l2 norm of the last dimension: a point on the unit hypersphere."""
    return x / l2_norm(x)


def identity(x: th.Tensor) -> th.Tensor:
    """What stands in place of `l2_normalize` where feature normalisation is switched off."""
    return x


def in_float32(x: th.Tensor) -> th.Tensor:
    """A product that was rounded to bfloat16, for what must not be; everything else as it is."""
    return x.float() if x.dtype == th.bfloat16 else x


def member_shape(n_members: int | None) -> tuple[int, ...]:
    """The leading dimensions of a parameter: none, or one for the members of an ensemble."""
    return () if n_members is None else (n_members,)


def dense(x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None = None) -> th.Tensor:
    """x W + b for one network, or for each member of an ensemble.

    :param x: (batch, in), seen by every member alike, or (n_members, batch, in)
    :param weight: (in, out) or (n_members, in, out): laid out as the product makes its gradient, which is then not copied
    :param bias: (out,) or (n_members, out)
    :return: (batch, out) or (n_members, batch, out)
    """
    if weight.dim() == 2:
        return x @ weight if bias is None else th.addmm(bias, x, weight)
    x = x.expand(weight.shape[0], -1, -1)
    return th.bmm(x, weight) if bias is None else th.baddbmm(bias.unsqueeze(1), x, weight)


def orthogonal_members_(weight: nn.Parameter) -> None:
    """Fill (in, out), or each member of (n_members, in, out), with an orthogonal matrix."""
    for matrix in weight.detach().view(-1, *weight.shape[-2:]):
        nn.init.orthogonal_(matrix.T)


class Projected(nn.Module):
    """A layer whose parameters lie on hyperspheres, and are put back there after every step (Algorithm 1)."""

    def project(self) -> None:
        raise NotImplementedError


class HyperDense(Projected):
    """x W without bias, whose columns, one per output unit, `project` puts on the unit hypersphere (weight normalisation,
    section 3.3)."""

    def __init__(self, in_features: int, out_features: int, n_members: int | None = None):
        super().__init__()
        self.weight = nn.Parameter(th.empty(*member_shape(n_members), in_features, out_features))
        orthogonal_members_(self.weight)

    def forward(self, x: th.Tensor) -> th.Tensor:
        return dense(x, self.weight)

    @th.no_grad()
    def project(self) -> None:
        """W_i <- W_i / ||W_i|| for each output unit i."""
        # Over columns this sum takes an eighth of `vector_norm`'s time.
        self.weight.div_(self.weight.square().sum(dim=-2, keepdim=True).sqrt().clamp_min(EPS))


class Scaler(nn.Module):
    """s * x, component by component. The parameter starts at `scale` and acts as `init`: `init / scale` is its own
    learning rate beside the optimiser's."""

    def __init__(self, features: int, init: float = 1.0, scale: float = 1.0, n_members: int | None = None):
        super().__init__()
        # Ensembles need the batch dimension between member and feature.
        shape = (features,) if n_members is None else (n_members, 1, features)
        self.scaler = nn.Parameter(th.full(shape, scale))
        self.forward_scale = init / scale

    def forward(self, x: th.Tensor) -> th.Tensor:
        return x * (self.scaler * self.forward_scale)


class HyperEmbedder(nn.Module):
    """x_emb = l2(s_e * W_e l2(x (+) c_shift)): the appended constant keeps the magnitude that the norm removes."""

    def __init__(self, in_features: int, hidden_dim: int, normalize: Normalization, n_members: int | None = None):
        super().__init__()
        self.normalize = normalize
        self.dense = HyperDense(in_features + 1, hidden_dim, n_members)
        self.scaler = Scaler(hidden_dim, math.sqrt(2 / hidden_dim), math.sqrt(2 / hidden_dim), n_members)

    def forward(self, x: th.Tensor) -> th.Tensor:
        x = F.pad(x, (0, 1), value=C_SHIFT)
        return self.normalize(self.scaler(self.dense(self.normalize(x))))


class HyperLerpBlock(nn.Module):
    """x_ffn = l2(W_2 ReLU(s_b * W_1 x)) and x_b = l2(x + a * (x_ffn - x)), where the thesis's eta is 1 - a.

    :param in_features: width of what W_1 reads: `hidden_dim`, and more where the preference joins the block's input
    """

    def __init__(
        self, in_features: int, hidden_dim: int, n_blocks: int, normalize: Normalization, n_members: int | None = None
    ):
        super().__init__()
        self.normalize = normalize
        scale = math.sqrt(2 / hidden_dim) / math.sqrt(EXPANSION)
        self.dense1 = HyperDense(in_features, EXPANSION * hidden_dim, n_members)
        self.scaler = Scaler(EXPANSION * hidden_dim, scale, scale, n_members)
        self.dense2 = HyperDense(EXPANSION * hidden_dim, hidden_dim, n_members)
        self.lerp = Scaler(hidden_dim, 1 / (n_blocks + 1), 1 / math.sqrt(hidden_dim), n_members)

    def forward(self, x: th.Tensor, block_input: th.Tensor) -> th.Tensor:
        """
        :param x: the embedding that the block improves, (..., hidden_dim)
        :param block_input: what W_1 reads, (..., in_features): x itself, or x with the preference appended
        """
        # EPS keeps a vector whose units are all off from having no direction.
        hidden = F.relu(self.scaler(self.dense1(block_input))) + EPS
        x_ffn = self.normalize(self.dense2(hidden))
        return self.normalize(x + self.lerp(x_ffn - x))


class HyperHead(nn.Module):
    """Output prediction: dense, scaler, dense, and the network's only bias."""

    def __init__(self, hidden_dim: int, out_features: int, n_members: int | None = None):
        super().__init__()
        self.dense1 = HyperDense(hidden_dim, hidden_dim, n_members)
        self.scaler = Scaler(hidden_dim, n_members=n_members)
        self.dense2 = HyperDense(hidden_dim, out_features, n_members)
        self.bias = nn.Parameter(th.zeros(*member_shape(n_members), out_features))

    def forward(self, x: th.Tensor) -> th.Tensor:
        return self.dense2(self.scaler(self.dense1(x))) + (self.bias if self.bias.dim() == 1 else self.bias.unsqueeze(1))


class UnitHead(nn.Module):
    """Output prediction by one dense layer with unit-norm columns, and a bias."""

    def __init__(self, hidden_dim: int, out_features: int, n_members: int | None = None):
        super().__init__()
        self.dense = HyperDense(hidden_dim, out_features, n_members)
        self.bias = nn.Parameter(th.zeros(*member_shape(n_members), out_features))

    def forward(self, x: th.Tensor) -> th.Tensor:
        return dense(x, self.dense.weight, self.bias)


class Linear(nn.Module):
    """torch's Linear, its initialisation included, for one network or an ensemble."""

    def __init__(self, in_features: int, out_features: int, n_members: int | None = None):
        super().__init__()
        layers = [nn.Linear(in_features, out_features) for _ in range(n_members or 1)]
        shape = member_shape(n_members)
        self.weight = nn.Parameter(th.stack([x.weight.detach().T for x in layers]).view(*shape, in_features, out_features))
        self.bias = nn.Parameter(th.stack([x.bias.detach() for x in layers]).view(*shape, out_features))

    def forward(self, x: th.Tensor) -> th.Tensor:
        return dense(x, self.weight, self.bias)


def orthogonal_(layer: nn.Module) -> nn.Module:
    """Start a `Linear` from orthogonal weights and zero biases."""
    assert isinstance(layer, Linear)
    orthogonal_members_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


class Film(nn.Module):
    """Feature-wise affine transformation (Perez et al., 2018): (1 + g(w)) * x + b(w), the identity at the start."""

    def __init__(self, preference_dim: int, features: int, n_members: int | None = None):
        super().__init__()
        self.affine = Linear(preference_dim, 2 * features, n_members)
        nn.init.zeros_(self.affine.weight)
        nn.init.zeros_(self.affine.bias)

    def forward(self, x: th.Tensor, preference: th.Tensor) -> th.Tensor:
        gain, shift = self.affine(preference).chunk(2, dim=-1)
        return (1 + gain) * x + shift


def project_weights(network: nn.Module) -> None:
    """Put the weights of every projected layer of a network back on their hyperspheres (Algorithm 1)."""
    for module in network.modules():
        if isinstance(module, Projected):
            module.project()
