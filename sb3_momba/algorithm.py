"""What stands around Algorithm 1: construction, environments, prediction, exploration, episodes, logs, going on."""

import logging
import os
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import CloudpickleWrapper, VecEnv, VecFrameStack, VecNormalize, is_vecenv_wrapped

from sb3_momba.buffers import PreferenceReplayBuffer
from sb3_momba.checkpoints.checkpoint import resume
from sb3_momba.checkpoints.folders import Checkpoint
from sb3_momba.checkpoints.training_state import callbacks_below, given_callback, set_states_of_callbacks
from sb3_momba.diagnostics import NegativeReturnWatch, TrainingMetrics, weight_norm
from sb3_momba.envs.making import check_vec_env, make_env, n_objectives_of, wrap_env
from sb3_momba.envs.preferences import FixedSampler, PreferenceSampler, SamplerSpec, make_sampler
from sb3_momba.exploration import HeldNoise
from sb3_momba.export import export_policy
from sb3_momba.logs import forgive_full_disks
from sb3_momba.nn.networks import Actor, Critic
from sb3_momba.nn.speed import keep_freed_memory
from sb3_momba.saving import PickleFreeSaving
from sb3_momba.settings import HER_DEFAULTS, OF_THE_ALGORITHM, check_settings, is_number, parse_ent_coef, parse_target_entropy

Self = TypeVar("Self", bound="PreferenceConditionedAlgorithm")

logger = logging.getLogger(__name__)


class PreferenceConditionedAlgorithm(PickleFreeSaving):
    """An off-policy algorithm whose policy reads [observation, preference]; a subclass has the arguments and the update."""

    actor: Actor
    critic: Critic
    critic_target: Critic
    critic_loss: str
    vector_values: bool
    her: bool
    her_kwargs: dict[str, Any] | None
    preference_alignment: bool | str
    preference_sampler: PreferenceSampler | SamplerSpec | None
    best_return_scale: float | None
    return_scaling: str
    reward_centering: bool
    target_entropy: str | float
    deterministic_exploration: bool
    noise_repeat: int
    td3_noise: float | None
    compile: bool
    log_ent_coef: th.Tensor | None
    _root_callback: BaseCallback | None = None
    _in_a_step = False  # from its action until it is stored
    _states_of_callbacks: dict[str, Any] | None = None  # from a checkpoint, for the callbacks of the next `learn`
    _resumed_from: tuple[Checkpoint, PreferenceReplayBuffer] | None = None  # and the buffer that it filled

    def _setup_model(self) -> None:
        self._check_settings()
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        if self.env is not None:
            self._prepare_env(self.env)
        self.replay_buffer = self._make_replay_buffer()
        self.policy = self.policy_class(  # type: ignore[assignment]
            self.observation_space,
            self.action_space,
            self.lr_schedule,
            **self._injected_policy_kwargs(),
            **self.policy_kwargs,
        ).to(self.device)
        self.actor, self.critic, self.critic_target = self.policy.actor, self.policy.critic, self.policy.critic_target
        keep_freed_memory()
        for network in (self.actor, self.critic, self.critic_target):
            network.compiled = self.compile
        self._setup_entropy_coefficient()
        self._held_noise = HeldNoise(self.noise_repeat)
        self._metrics = TrainingMetrics()
        self._negative_returns = NegativeReturnWatch()
        self._skipped_updates = 0

    def _check_settings(self) -> None:
        """:raises ValueError: for options that do not go together, saying why"""
        self._convert_train_freq()
        assert isinstance(self.train_freq, TrainFreq)
        if self.train_freq.unit is TrainFrequencyUnit.EPISODE and self.n_envs > 1:
            raise ValueError(
                f"train_freq={self.train_freq.frequency} episodes with n_envs={self.n_envs}: episodes end at different times; "
                "count steps, or use one environment."
            )
        check_settings(self)

    def _injected_policy_kwargs(self) -> dict[str, Any]:
        """What the policy must know of the algorithm; the user's `policy_kwargs` stay as they were given."""
        ours = {name: getattr(self, name) for name in OF_THE_ALGORITHM}
        return {**ours, "deterministic_policy": self.td3_noise is not None}

    def _make_replay_buffer(self) -> PreferenceReplayBuffer:
        relabelling = {**HER_DEFAULTS, **(self.her_kwargs or {})} if self.her else {}
        buffer_class: Any = self.replay_buffer_class
        return buffer_class(
            self.buffer_size,
            self.observation_space,
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            optimize_memory_usage=self.optimize_memory_usage,
            **{
                "n_objectives": self.n_objectives,
                "gamma": self.gamma,
                "n_steps": self.n_steps,
                "seed": self.seed,
                **relabelling,
                **self.replay_buffer_kwargs,
            },
        )

    def _setup_entropy_coefficient(self) -> None:
        """alpha = exp(beta), learned or fixed (section 3.4.2)."""
        self.target_entropy = parse_target_entropy(self.target_entropy, int(np.prod(self.action_space.shape)))  # type: ignore[arg-type]
        learned, start = parse_ent_coef(self.ent_coef)
        if learned:
            self.log_ent_coef = th.tensor(start, device=self.device).log().requires_grad_(True)
            self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coef], lr=self.lr_schedule(1))
        else:
            self.ent_coef_tensor = th.tensor(start, device=self.device)

    @staticmethod
    def _wrap_env(env: GymEnv | str | Callable[[], gym.Env], verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        """Monitor(PreferenceWrapper(env)) in a VecEnv; a VecEnv must have the wrapper already, or be scalar."""
        if not isinstance(env, VecEnv):
            env = wrap_env(make_env(env, render_mode="rgb_array"))
        venv = OffPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        if is_vecenv_wrapped(venv, VecNormalize):
            raise ValueError("VecNormalize changes what the replay buffer stores: leave it out. The policy normalises itself.")
        if n_objectives_of(venv) > 1 and is_vecenv_wrapped(venv, VecFrameStack):
            raise ValueError("VecFrameStack stacks preferences too: leave it out, and stack frames inside PreferenceWrapper.")
        check_vec_env(venv)
        return venv

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            raise ValueError(f"policy={policy_name!r} is not known: use one of {', '.join(self.policy_aliases)}, or a class.")
        return self.policy_aliases[policy_name]

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Train on another environment; SB3's signature. One that does not fit is refused before anything changes.

        :param env: environment or VecEnv; an environment is put into PreferenceWrapper
        :param force_reset: the next `learn` starts with a reset
        :raises ValueError: for another number of objectives, observation or action space, or what MOMBA cannot train on
        :raises AssertionError: for another number of environments; `load(path, env)` takes it
        """
        venv = self._wrap_env(env, self.verbose)
        if n_objectives_of(venv) != self.n_objectives:
            raise ValueError(f"The model has {self.n_objectives} objectives, the environment {n_objectives_of(venv)}.")
        super().set_env(venv, force_reset)
        self._prepare_env(venv)

    def _prepare_env(self, env: VecEnv) -> None:
        if self.preference_sampler is not None and self.n_objectives > 1:
            sampler = make_sampler(self.preference_sampler, self.n_objectives)
            env.env_method("set_preference_sampler", CloudpickleWrapper(sampler))
        if self.n_objectives == 1:
            logger.warning(
                "The environment has one objective: MOMBA trains it as single-objective SAC, with %s.",
                self.policy_class.__name__,
            )

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed torch, numpy, the environments, the action space and the replay buffer."""
        super().set_random_seed(seed)
        if seed is not None and self.replay_buffer is not None:
            self.replay_buffer.seed(seed)

    def predict(  # type: ignore[override]
        self,
        observation: np.ndarray,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        *,
        preference: Sequence[float] | np.ndarray | None = None,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """The policy's action, within the bounds of the action space.

        :param observation: as the environment gives it, (observation_dim,) or (batch, observation_dim), with `preference`;
            or [observation, w], as the wrapped environment gives it, without; a model whose `preference_sampler` keeps one
            preference takes the environment's own without, too
        :param preference: (n_objectives,) or (batch, n_objectives)
        :param deterministic: the mean action instead of a sample
        :return: (action_dim,) or (batch, action_dim), and `state`
        :raises ValueError: if one of both is missing, doubled or of the wrong shape
        """
        sampler = None if self.preference_sampler is None else make_sampler(self.preference_sampler, self.n_objectives)
        kept = sampler.preference if isinstance(sampler, FixedSampler) else None
        wrapped = self.policy.with_preference(observation, preference, kept)
        return self.policy.predict(wrapped, state, episode_start, deterministic)

    def export(self, path: str | os.PathLike[str], preference: Sequence[float] | np.ndarray | None = None) -> None:
        """Write the deterministic policy as a graph that runs without this package; the old file stands until the new one is
        whole.

        Its inputs are "observation", float32 (batch, observation_dim) as the environment gives it, and "preference", float32
        (batch, n_objectives), weights of at least 0 that sum to 1, neither of which it checks; its output is "action", float32
        (batch, action_dim), within the action space's bounds: what `predict(..., deterministic=True)` gives, but for rounding.

        :param path: ".onnx" (needs the package onnx), or ".pt" or ".ts" for TorchScript
        :param preference: (n_objectives,), built in; the graph then has one input, as with one objective
        :raises ValueError: for another suffix, or a wrong preference
        :raises ImportError: if onnx is missing
        """
        export_policy(self.policy, path, preference)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """The action for the environments and, scaled to [-1, 1], for the replay buffer; SB3's unless CAPQL's, TD3's or noise
        that is kept is asked for."""
        self._in_a_step = True
        explores_by_the_mean = self.deterministic_exploration or self.td3_noise is not None
        if self.num_timesteps < learning_starts or not (explores_by_the_mean or self.noise_repeat > 1):
            return super()._sample_action(learning_starts, action_noise, n_envs)
        assert isinstance(self._last_obs, np.ndarray)
        if explores_by_the_mean:
            action, _ = self.predict(self._last_obs, deterministic=True)
            scaled = self.policy.scale_action(action)
            if self.td3_noise is not None:
                scaled = np.clip(scaled + self.td3_noise * self._held_noise(th.zeros(scaled.shape)).numpy(), -1, 1)
        else:
            scaled = self.policy.explore(self._last_obs, self._held_noise)
        if action_noise is not None:
            scaled = np.clip(scaled + action_noise(), -1, 1)
        return self.policy.unscale_action(scaled), scaled

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Store the transition, then update the normalisation statistics with s_t and r_t (Algorithm 1)."""
        assert isinstance(self._last_obs, np.ndarray)
        observations = self._last_obs[:, : self.policy.observation_dim]
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self.policy.statistics.update(observations)
        self._observe_rewards(self.replay_buffer.latest_rewards, dones)
        self._in_a_step = False

    def _observe_rewards(self, rewards: np.ndarray, dones: np.ndarray) -> None:
        self.policy.observe_rewards(rewards, dones)
        if self.preference_alignment and self.preference_alignment != "positive":
            self._negative_returns.add(rewards, dones)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        """SB3's; where it resets the environments, the episodes that were going on end here.

        SB3 resets the action noise at every `learn`: after a checkpoint it goes on from where it was instead. A callback or an
        error that ended the last `learn` within a step left the environments elsewhere than at `_last_obs`: they are reset.
        """
        if self._in_a_step:
            self._last_obs, self._in_a_step = None, False
        noise = self.action_noise
        if isinstance(noise, VectorizedActionNoise) and noise.n_envs != self.n_envs:  # those of another VecEnv
            self.action_noise = noise.base_noise
        noise_so_far = deepcopy(self.action_noise) if self._states_of_callbacks is not None else None
        resets = reset_num_timesteps or self._last_obs is None
        if resets:
            self.policy.return_scale.end_episodes()
            self._negative_returns.end_episodes()
        if resets or not self.replay_buffer.goes_on:
            self.replay_buffer.end_episodes()
        self.replay_buffer.check_memory()
        total_timesteps, root = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        if self.num_timesteps < total_timesteps <= self.learning_starts:
            logger.warning("Nothing is learned before learning_starts=%d: lower it, or take more steps.", self.learning_starts)
        self._root_callback = given_callback(root)
        forgive_full_disks(self.logger)
        if self._states_of_callbacks is not None:
            self.action_noise = noise_so_far
            set_states_of_callbacks(self._root_callback, self._states_of_callbacks)
            self._states_of_callbacks = None
        return total_timesteps, root

    def learn(
        self: Self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "MOMBA",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train; SB3's signature.

        :param total_timesteps: environment steps, over all environments
        :param log_interval: episodes between two logs
        :param reset_num_timesteps: False counts on from the steps made so far
        :raises NonFiniteLossError: if the training diverges, see `train`
        :raises ValueError: for steps that are no finite number of at least 0
        """
        if not is_number(total_timesteps) or total_timesteps < 0:
            raise ValueError(f"total_timesteps={total_timesteps!r}: give a number of environment steps, at least 0.")
        try:
            return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        finally:
            for _, one in callbacks_below(self._root_callback):
                getattr(one, "after_learn", lambda: None)()

    def dump_logs(self) -> None:
        """Write the log, with the means of the training metrics since the last time."""
        if self._metrics.sums:
            self._metrics.record(self.logger)
            self.logger.record("train/return_scale", self.policy.reward_factor)
            self.logger.record("train/actor_weight_norm", weight_norm(self.actor))
            self.logger.record("train/critic_weight_norm", weight_norm(self.critic))
            self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        super().dump_logs()

    @property
    def remaining_timesteps(self) -> int:
        """What the last `learn` had before it: after `resume`, `learn(remaining_timesteps, reset_num_timesteps=False)`."""
        return max(int(self._total_timesteps) - self.num_timesteps, 0)

    @classmethod
    def resume(cls: type[Self], path: str | os.PathLike[str], env: GymEnv, replay: bool = True, **kwargs: Any) -> Self:
        """The training as it was at a checkpoint: `learn(model.remaining_timesteps, callback, reset_num_timesteps=False)` goes
        on exactly as if nothing had happened, callbacks of the same kinds in the same places included: SB3's own, and others
        that have `state_dict` and `load_state_dict`. The same holds for the bits of every number on the same machine with the
        same versions and number of threads, for environments whose only randomness is Gymnasium's `np_random`. Where a running
        episode does not come out as it was, it ends there, as truncated, with a warning.

        :param path: folder of a MombaCheckpointCallback, or one of the checkpoints in it; damaged ones are passed over
        :param env: an environment of the same kind, and as many
        :param replay: brings running episodes back by their actions, from their reset on, here and now. False, for a machine
            that must not move by itself, only resets: these episodes end, as truncated, where the checkpoint was
        :param kwargs: of `load`, without a seed
        :raises FileFormatError: if no checkpoint is whole, naming what is damaged
        :raises ValueError: if `env` is not of that kind
        """
        return resume(cls, path, env, replay, **kwargs)
