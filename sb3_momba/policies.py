"""The policies that a user names: each chooses the architectures of actor and critics."""

from typing import Any, ClassVar

from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_momba.nn.flash_sac import FlashSacArchitecture
from sb3_momba.nn.networks import MlpArchitecture, SimbaArchitecture
from sb3_momba.nn.xqc import XqcArchitecture
from sb3_momba.policy import MombaPolicy


class SimbaPolicy(MombaPolicy):
    """SimbaV2 actor and critics (Lee et al., 2025; section 3.3); the defaults are Table B.1's.

    `predict` takes [s, w], (batch, observation_dim + preference_dim), and gives actions, (batch, action_dim), in the
    environment's bounds.

    :param actor_hidden_dim: width of the actor's embedding
    :param actor_blocks: its hidden blocks
    :param critic_hidden_dim: width of a critic's embedding
    :param critic_blocks: its hidden blocks
    :param conditioning: "input", "all", "film" or "film+all" (section 4.3.4)
    :param normalize_features: hyperspherical normalisation of activations
    :param normalize_weights: unit-norm rows of the linear layers
    :param kwargs: see MombaPolicy
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        actor_hidden_dim: int = 128,
        actor_blocks: int = 2,
        critic_hidden_dim: int = 256,
        critic_blocks: int = 2,
        conditioning: str = "input",
        normalize_features: bool = True,
        normalize_weights: bool = True,
        **kwargs: Any,
    ):
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            SimbaArchitecture(actor_hidden_dim, actor_blocks, conditioning, normalize_features),
            SimbaArchitecture(critic_hidden_dim, critic_blocks, conditioning, normalize_features),
            normalize_weights=normalize_weights,
            **kwargs,
        )
        self.arguments = {
            "actor_hidden_dim": actor_hidden_dim,
            "actor_blocks": actor_blocks,
            "critic_hidden_dim": critic_hidden_dim,
            "critic_blocks": critic_blocks,
            "conditioning": conditioning,
            "normalize_features": normalize_features,
            "normalize_weights": normalize_weights,
            **kwargs,
        }


class MlpPolicy(MombaPolicy):
    """Dense networks, as SB3's SAC has them (Haarnoja et al., 2018; the MLP architecture of section 4.3).

    `predict` takes [s, w], (batch, observation_dim + preference_dim), and gives actions, (batch, action_dim), in the
    environment's bounds.

    :param net_arch: widths of the hidden layers, or `dict(pi=[...], qf=[...])` for actor and critics apart
    :param conditioning: "input", "all", "film" or "film+all" (section 4.3.4)
    :param ortho_init: orthogonal weights and zero biases at the start, as in CAPQL's code, instead of torch's own
    :param activation_fn: between the layers
    :param kwargs: see MombaPolicy
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        conditioning: str = "input",
        ortho_init: bool = False,
        activation_fn: type[nn.Module] = nn.ReLU,
        **kwargs: Any,
    ):
        if net_arch is None:
            net_arch = [256, 256]
        arch = net_arch if isinstance(net_arch, dict) else {"pi": net_arch, "qf": net_arch}
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            MlpArchitecture(arch["pi"], conditioning, ortho_init, activation_fn),
            MlpArchitecture(arch["qf"], conditioning, ortho_init, activation_fn),
            normalize_weights=False,
            **kwargs,
        )
        self.arguments = {
            "net_arch": net_arch,
            "conditioning": conditioning,
            "ortho_init": ortho_init,
            "activation_fn": activation_fn,
            **kwargs,
        }


class BlockPolicy(MombaPolicy):
    """A policy whose architecture is a width, a number of blocks and a conditioning; a subclass has their defaults."""

    architecture: ClassVar[type[XqcArchitecture | FlashSacArchitecture]]

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        actor_hidden_dim: int,
        actor_blocks: int,
        critic_hidden_dim: int,
        critic_blocks: int,
        conditioning: str,
        **kwargs: Any,
    ):
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            type(self).architecture(actor_hidden_dim, actor_blocks, conditioning),
            type(self).architecture(critic_hidden_dim, critic_blocks, conditioning),
            **kwargs,
        )
        self.arguments = {
            "actor_hidden_dim": actor_hidden_dim,
            "actor_blocks": actor_blocks,
            "critic_hidden_dim": critic_hidden_dim,
            "critic_blocks": critic_blocks,
            "conditioning": conditioning,
            **kwargs,
        }


class XqcPolicy(BlockPolicy):
    """XQC's actor and critics (Palenicek et al., 2025): dense layers of unit norm, batch norm before each ReLU.

    The sizes are those of the authors' code, and so are `critic_loss`, `n_atoms` and `support` by default. While training,
    (s, a) and (s', a') go through critics and target critics in one pass with common batch statistics. What the algorithm
    around them has otherwise, the configuration `xqc` says. Not theirs: observations are normalised by their running
    statistics too, which the input's batch norm undoes but for its eps, 1e-3, which then means the same in every unit.

    `predict` takes [s, w], (batch, observation_dim + preference_dim), and gives actions, (batch, action_dim), in the
    environment's bounds.

    :param actor_hidden_dim: width of the actor's layers
    :param actor_blocks: its hidden layers
    :param critic_hidden_dim: width of a critic's layers
    :param critic_blocks: its hidden layers
    :param conditioning: "input", "all", "film" or "film+all" (section 4.3.4)
    :param kwargs: see MombaPolicy
    """

    architecture = XqcArchitecture

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        actor_hidden_dim: int = 256,
        actor_blocks: int = 4,
        critic_hidden_dim: int = 512,
        critic_blocks: int = 4,
        conditioning: str = "input",
        **kwargs: Any,
    ):
        sizes = (actor_hidden_dim, actor_blocks, critic_hidden_dim, critic_blocks)
        super().__init__(observation_space, action_space, lr_schedule, *sizes, conditioning, **kwargs)


class FlashSacPolicy(BlockPolicy):
    """FlashSAC's actor and critics (Kim et al., 2026): inverted residual blocks with batch norm, unit-norm weights.

    The sizes are those of the authors' code, and so are `critic_loss`, `n_atoms` and `support` by default. While training,
    (s, a) and (s', a') go through critics and target critics in one pass with common batch statistics (the paper's cross-batch
    value prediction). What the algorithm around them has otherwise, the configuration `flashsac` says. Not theirs: the actor's
    statistics come from s alone instead of s and s'; running variances divide by n, not n - 1; observations are normalised by
    their running statistics too, which the input's batch norm undoes but for its eps.

    `predict` takes [s, w], (batch, observation_dim + preference_dim), and gives actions, (batch, action_dim), in the
    environment's bounds.

    :param actor_hidden_dim: width of the actor's embedding
    :param actor_blocks: its inverted residual blocks
    :param critic_hidden_dim: width of a critic's embedding
    :param critic_blocks: its inverted residual blocks
    :param conditioning: "input", "all", "film" or "film+all" (section 4.3.4)
    :param kwargs: see MombaPolicy
    """

    architecture = FlashSacArchitecture

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        actor_hidden_dim: int = 128,
        actor_blocks: int = 2,
        critic_hidden_dim: int = 256,
        critic_blocks: int = 2,
        conditioning: str = "input",
        **kwargs: Any,
    ):
        sizes = (actor_hidden_dim, actor_blocks, critic_hidden_dim, critic_blocks)
        super().__init__(observation_space, action_space, lr_schedule, *sizes, conditioning, **kwargs)


SHIPPED_POLICIES: tuple[type[MombaPolicy], ...] = (SimbaPolicy, MlpPolicy, XqcPolicy, FlashSacPolicy)
