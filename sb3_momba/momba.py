"""MOMBA: preference-conditioned maximum-entropy actor-critic with SimbaV2 networks and distributional critics."""

import contextlib
import logging
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import update_learning_rate

from sb3_momba.algorithm import PreferenceConditionedAlgorithm
from sb3_momba.buffers import PreferenceReplayBuffer, PreferenceReplayBufferSamples
from sb3_momba.diagnostics import Metrics
from sb3_momba.envs.making import n_objectives_of
from sb3_momba.envs.preferences import PreferenceSampler, SamplerSpec
from sb3_momba.exploration import td3_smoothed
from sb3_momba.nn.batch_norm import follow_batch_statistics, without_batch_statistics
from sb3_momba.nn.descent import NonFiniteLossError, descend, move_towards
from sb3_momba.nn.distributional import lowest
from sb3_momba.nn.layers import in_float32
from sb3_momba.nn.products import fast_float32_products, product_dtype
from sb3_momba.nn.speed import without_weight_gradients
from sb3_momba.policies import SHIPPED_POLICIES
from sb3_momba.policy import MombaPolicy
from sb3_momba.settings import check_device, check_other_arguments, parameters

MAX_SKIPPED_UPDATES = 20

logger = logging.getLogger(__name__)


class MOMBA(PreferenceConditionedAlgorithm):
    """Multi-objective RL with expressive function approximators (Algorithm 1 of the thesis).

    CAPQL (Lu et al., 2023) with SimbaV2 networks (Lee et al., 2025) and distributional critics: one run learns one policy
    pi(a | s, w) for every preference w. With a scalar reward it is single-objective SimbaV2-SAC. Defaults are Table B.1's.

    :param policy: "SimbaPolicy", "MlpPolicy", "XqcPolicy", "FlashSacPolicy" or a class
    :param env: id, environment or VecEnv; environments are put into PreferenceWrapper
    :param learning_rate: of actor, critics and entropy coefficient; a number or a function of the remaining progress
    :param buffer_size: transitions kept
    :param learning_starts: steps of uniformly random actions before the first update
    :param batch_size: transitions per update
    :param tau: step of the target critics towards the critics
    :param gamma: discount
    :param train_freq: steps between updates, or (n, "step" | "episode")
    :param gradient_steps: updates each time; -1: as many as steps were taken
    :param action_noise: added to the policy's actions while training
    :param n_steps: of an n-step return
    :param critic_loss: "ce", distributional critics (section 3.2), or "mse", expected values
    :param vector_values: critics of the vector return (section 3.2.2) instead of the scalarised one (3.2.1)
    :param her: relabel preferences in hindsight, eq. (3.20)
    :param her_kwargs: `dict(keep_probability=0.2, concentration=5.0, n_relabels=1, corner_probability=0.0)`: the buffer's
    :param preference_alignment: preference alignment regularisation, eq. (3.21); needs vector_values. "positive": only where
        w.Q is above 0, as its cosine makes a gain of any loss below
    :param best_return_scale: what the largest return seen is scaled to (section 3.4.1); None: rewards as they are
    :param return_scaling: "maximum": by the largest return alone; "deviation": by the returns' standard deviation, down to what
        keeps the largest at best_return_scale (SimbaV2's code; FlashSAC)
    :param reward_centering: critics learn by how much returns exceed what the mean reward is worth for ever (Naik et al., 2024)
    :param ent_coef: alpha; "auto_0.2" learns it from 0.2, a number fixes it
    :param target_entropy: of the policy on [-1, 1], in nats; "auto": `-|A|`; "std_0.15": that of a Gaussian with this standard
        deviation in each dimension (FlashSAC)
    :param ent_coef_learning_rate: of the entropy coefficient alone; None: `learning_rate`
    :param policy_delay: updates of the critics for each of the actor and the entropy coefficient (TD3, Fujimoto et al., 2018)
    :param reset_interval: updates after which networks and optimisers start again, while the replay buffer, the statistics and
        alpha stay (Nikishin et al., 2022); None: never
    :param noise_repeat: most steps for which the noise of one sampled action is kept (FlashSAC); 1: new noise at every step
    :param td3_noise: None: SAC's stochastic policy. A number: TD3's (Fujimoto et al., 2018), the mean action, explored under
        Gaussian noise of this deviation on [-1, 1], while targets take the next one under twice the noise, clipped at five
        times; 0.1 gives its numbers. Without its target of the actor; needs ent_coef=0.0
    :param preference_sampler: `rng -> (n_objectives,)` for all environments, or a literal as `make_sampler` takes it; None
        leaves them theirs, by default uniform on the simplex once an episode
    :param precision: of an update's products: "float32", "bfloat16", or "auto", bfloat16 if the device has instructions for it
    :param compile: the networks by torch.compile: bfloat16 updates some 20 % faster after 10 to 60 s; needs a C++ compiler
    :param critic_minimum: "scalarised": the critic of lower w.Q (section 3.4.2); "objective": each objective's lower Q (CAPQL)
    :param critic_loss_reduction: over critics and objectives: "sum" (3.17) or "mean" (CAPQL)
    :param deterministic_exploration: collect data with the mean action (CAPQL's code) instead of a sample
    :param replay_buffer_class: PreferenceReplayBuffer or a subclass
    :param replay_buffer_kwargs: see PreferenceReplayBuffer; they take precedence over MOMBA's own
    :param optimize_memory_usage: SB3's switch, always off: see PreferenceReplayBuffer
    :param policy_kwargs: see the policies' classes and MombaPolicy
    :param stats_window_size: episodes that the log's mean return and length are taken over
    :param tensorboard_log: folder of TensorBoard's logs; None writes none
    :param verbose: 0 prints nothing, 1 the log, 2 debugging messages too
    :param seed: of networks, environments, exploration and replay buffer; None: another run each time
    :param device: of the networks; "auto": the GPU if there is one
    :param others: SAC's own arguments, such as use_sde, where they ask for nothing
    :raises ValueError: for settings or environments that do not go together, naming them
    :raises TypeError: for an argument that there is not, naming the nearest
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {policy.__name__: policy for policy in SHIPPED_POLICIES}

    def __init__(
        self,
        policy: str | type[MombaPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 5_000,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        n_steps: int = 1,
        critic_loss: str = "ce",
        vector_values: bool = False,
        her: bool = False,
        her_kwargs: dict[str, Any] | None = None,
        preference_alignment: bool | str = False,
        best_return_scale: float | None = 3.0,
        return_scaling: str = "maximum",
        reward_centering: bool = False,
        ent_coef: str | float = "auto_0.2",
        target_entropy: str | float = "auto",
        ent_coef_learning_rate: float | None = None,
        policy_delay: int = 1,
        reset_interval: int | None = None,
        noise_repeat: int = 1,
        td3_noise: float | None = None,
        preference_sampler: PreferenceSampler | SamplerSpec | None = None,
        precision: str = "float32",
        compile: bool = False,
        critic_minimum: str = "scalarised",
        critic_loss_reduction: str = "sum",
        deterministic_exploration: bool = False,
        replay_buffer_class: type[PreferenceReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        **others: Any,
    ):
        check_other_arguments(others, parameters(type(self)))
        check_device(device)
        if env is None and _init_setup_model:
            raise ValueError("env=None: MOMBA needs an environment to train on; MOMBA.load(path) needs none to predict.")
        super().__init__(
            policy,  # type: ignore[arg-type]
            None if env is None else self._wrap_env(env, verbose),
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            tuple(train_freq) if isinstance(train_freq, list) else train_freq,  # type: ignore[arg-type]
            gradient_steps,
            action_noise,
            replay_buffer_class=replay_buffer_class or PreferenceReplayBuffer,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed,
            sde_support=False,
            supported_action_spaces=(spaces.Box,),
        )
        self.critic_loss = critic_loss
        self.vector_values = vector_values
        self.her = her
        self.her_kwargs = her_kwargs
        self.preference_alignment = preference_alignment
        self.precision = precision
        self.compile = compile
        self.critic_minimum = critic_minimum
        self.critic_loss_reduction = critic_loss_reduction
        self.deterministic_exploration = deterministic_exploration
        self.best_return_scale = best_return_scale
        self.return_scaling = return_scaling
        self.reward_centering = reward_centering
        self.ent_coef = ent_coef
        self.target_entropy = target_entropy
        self.ent_coef_learning_rate = ent_coef_learning_rate
        self.policy_delay = policy_delay
        self.reset_interval = reset_interval
        self.noise_repeat = noise_repeat
        self.td3_noise = td3_noise
        self.preference_sampler = preference_sampler
        self.log_ent_coef: th.Tensor | None = None
        self.ent_coef_optimizer: th.optim.Optimizer | None = None
        self.n_objectives = 1 if self.env is None else n_objectives_of(self.env)
        if _init_setup_model:
            self._setup_model()

    # -------------------------------------------------------------------------------------------------- learning

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """The gradient steps of Algorithm 1. One whose loss or gradient is not finite is skipped.

        :param gradient_steps: how many, each on a minibatch of its own
        :param batch_size: transitions per minibatch
        :raises NonFiniteLossError: for MAX_SKIPPED_UPDATES in a row, each network as its last good step left it
        """
        self.policy.set_training_mode(True)
        optimizers = [self.critic.optimizer, self.actor.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers.append(self.ent_coef_optimizer)
        self._update_learning_rate(optimizers)
        if self.ent_coef_optimizer is not None and self.ent_coef_learning_rate is not None:
            update_learning_rate(self.ent_coef_optimizer, self.ent_coef_learning_rate)

        try:
            with fast_float32_products():
                for _ in range(gradient_steps):
                    self._try_gradient_step(self._sample(batch_size))
        finally:
            self.policy.set_training_mode(False)

    def _try_gradient_step(self, batch: PreferenceReplayBufferSamples) -> None:
        """One gradient step, skipped if a loss is not finite."""
        try:
            self._gradient_step(batch)
            self._skipped_updates = 0
        except NonFiniteLossError as error:
            self._skip_update(error)

    def _gradient_step(self, batch: PreferenceReplayBufferSamples) -> None:
        """One pass through the inner loop of Algorithm 1."""
        if self.reset_interval is not None and self._n_updates > 0 and self._n_updates % self.reset_interval == 0:
            if self._skipped_updates == 0:  # What is tried again has had its reset.
                self.policy.reset_networks()
        alpha = self.alpha
        with self._rounded_products():
            critic_loss, metrics = self._critic_loss(batch, alpha)
        descend(self.critic.optimizer, critic_loss, "critic")
        follow_batch_statistics(self.critic)
        try:
            if self._n_updates % self.policy_delay == 0:
                metrics |= self._improve_policy(batch, alpha)
        finally:  # The critics have taken their step, even where the actor's is skipped.
            self.policy.project_weights()
            move_towards(self.critic_target, self.critic, self.tau)
        self._n_updates += 1
        self._metrics.add({**metrics, "ent_coef": alpha})

    def _improve_policy(self, batch: PreferenceReplayBufferSamples, alpha: th.Tensor) -> Metrics:
        """The steps of the actor and the entropy coefficient."""
        with self._rounded_products(), without_weight_gradients(self.critic):
            actor_loss, log_prob, metrics = self._actor_loss(batch, alpha)
        descend(self.actor.optimizer, actor_loss, "actor")
        follow_batch_statistics(self.actor)
        if self.ent_coef_optimizer is not None:
            alpha_loss = self._alpha_loss(log_prob)
            descend(self.ent_coef_optimizer, alpha_loss, "entropy coefficient")
            metrics["ent_coef_loss"] = alpha_loss.detach()
        return metrics

    def _rounded_products(self) -> contextlib.AbstractContextManager[None]:
        """Inside, products' factors are rounded as `precision` says. One context per loss: it keeps the rounded weights."""
        dtype = product_dtype(self.precision, self.device)
        return th.autocast(self.device.type, dtype, enabled=dtype != th.float32)  # type: ignore[return-value]

    def _skip_update(self, error: NonFiniteLossError) -> None:
        """Go on after a bad loss; give up after many in a row, each network as its last good step left it."""
        self._skipped_updates += 1
        if self._skipped_updates >= MAX_SKIPPED_UPDATES:
            raise NonFiniteLossError(
                f"{self._skipped_updates} updates in a row had a loss that is not finite: the training diverges. Each network "
                f"is as its last good step left it. Lower learning_rate={self.learning_rate}, or check the rewards."
            ) from error
        logger.warning("Update %d is skipped: %s", self._n_updates + 1, error)

    def _sample(self, batch_size: int) -> PreferenceReplayBufferSamples:
        """A minibatch, normalised with the statistics of this moment."""
        batch = self.replay_buffer.sample(batch_size)
        rewards = self.policy.center(batch.rewards, batch.discounts * (1 - batch.dones))
        return batch._replace(
            observations=self.policy.normalize(batch.observations),
            next_observations=self.policy.normalize(batch.next_observations),
            rewards=rewards * self.policy.reward_factor,
        )

    def _critic_loss(self, batch: PreferenceReplayBufferSamples, alpha: th.Tensor) -> tuple[th.Tensor, Metrics]:
        """Eq. (3.17), or eqs. (3.2) and (3.13) by `critic_loss` and `vector_values`."""
        value = self.policy.value
        with th.no_grad():
            with without_batch_statistics(self.actor):
                next_actions, next_log_prob = self._act(batch.next_observations)
                if self.td3_noise is not None:
                    next_actions = td3_smoothed(next_actions, self.td3_noise)
            # Batch norm takes its statistics from both at once, so that predictions and targets are normalised alike.
            now, next_ = (batch.observations, batch.actions), (batch.next_observations, next_actions)
            targets = value.bootstrap(
                self.critic_target(*next_, *now),
                rewards=batch.rewards if self.vector_values else scalarise(batch.rewards, batch.preferences)[:, None],
                discounts=batch.discounts * (1 - batch.dones),
                bonus=-alpha * next_log_prob,
            )
            worth = value.target_mean(targets)
            if self.critic_minimum == "scalarised":
                worth = self._scalarised(worth, batch.preferences)[..., None]
            target = lowest(targets, worth)
        outputs, features = self.critic.values_and_features(*now, *next_)
        loss = value.loss(outputs, target)
        loss = loss.sum(dim=(1, 2)).mean() if self.critic_loss_reduction == "sum" else loss.mean()
        with th.no_grad():
            metrics = {
                "critic_loss": loss.detach(),
                "q": value.mean(outputs).mean(dim=(0, 1)),
                "target_end_mass": value.end_mass(target).mean(),
                "feature_norm": th.linalg.vector_norm(in_float32(features), dim=-1).mean(),
            }
        return loss, metrics

    def _actor_loss(self, batch: PreferenceReplayBufferSamples, alpha: th.Tensor) -> tuple[th.Tensor, th.Tensor, Metrics]:
        """Eq. (3.18), with eq. (3.21)'s alignment if it is on. Also returns log pi(a | s, w), (batch,)."""
        actions, log_prob = self._act(batch.observations)
        # Of batch norm, only the network that takes the step sees the batch: critics judge a new action as they would alone.
        with without_batch_statistics(self.critic):
            q_vector = self.policy.value.mean(self.critic(batch.observations, actions))
        if self.critic_minimum == "objective":
            q_vector = q_vector.amin(dim=1, keepdim=True)
        q = self._scalarised(q_vector, batch.preferences)
        if self.preference_alignment:
            cosine = th.cosine_similarity(q_vector, batch.preferences[:, None], dim=-1)
            q = th.where(q > 0, q * cosine, q) if self.preference_alignment == "positive" else q * cosine
        loss = (alpha * log_prob - q.min(dim=1).values).mean()
        return loss, log_prob.detach(), {"actor_loss": loss.detach(), "entropy": -log_prob.detach().mean()}

    def _act(self, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """a ~ pi(. | s, w), (batch, action_dim), and log pi, (batch,); TD3's mean action has none."""
        if self.td3_noise is None:
            return self.actor.action_log_prob(observations)
        return self.actor(observations, deterministic=True), observations.new_zeros(len(observations))

    def _alpha_loss(self, log_prob: th.Tensor) -> th.Tensor:
        """Eq. (3.19) with alpha = exp(beta)."""
        assert self.log_ent_coef is not None
        assert isinstance(self.target_entropy, float)
        return -(self.log_ent_coef.exp() * (log_prob + self.target_entropy)).mean()

    @property
    def alpha(self) -> th.Tensor:
        """The entropy coefficient, a scalar without gradient."""
        return self.ent_coef_tensor if self.log_ent_coef is None else self.log_ent_coef.detach().exp()

    def _scalarised(self, values: th.Tensor, preferences: th.Tensor) -> th.Tensor:
        """w.Q of eqs. (3.12) and (3.16): (batch, n_critics, n_values) -> (batch, n_critics)."""
        return scalarise(values, preferences[:, None]) if self.vector_values else values.squeeze(-1)


def scalarise(values: th.Tensor, preferences: th.Tensor) -> th.Tensor:
    """u_w(v) = w.v (Definition 3): the last dimension, n_objectives, is summed away."""
    return (preferences * values).sum(dim=-1)
