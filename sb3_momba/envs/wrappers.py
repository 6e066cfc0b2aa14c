"""The wrapper that conditions observations on a preference."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import CloudpickleWrapper

from sb3_momba.envs.preferences import PreferenceSampler, SamplerSpec, check_preference, make_sampler, preference_dim
from sb3_momba.envs.spaces import HOW_TO_DECLARE, check_spaces, count_objectives, declared_reward_space
from sb3_momba.finite import all_finite

LARGEST_REWARD = 1e10
LONGEST_REPLAY = 20_000  # actions of an episode that are noted


class PreferenceWrapper(gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray], gym.utils.RecordConstructorArgs):
    """Condition a vector-reward environment on a preference w, so that it looks like any scalar one.

    - observation: float32 Box `[observation, w]`, the preference last
    - reward: the Python float `w . r`
    - `info["vector_reward"]`: float32 copy of r, (n_objectives,)
    - `info["preference"]`: the w that the action saw, (n_objectives,)

    A new preference is drawn for each episode (each step, if the sampler has a true `per_step`). `reset(options=
    {"preference": w})` sets it for one episode, `set_preference(w)` until `set_preference(None)`; in mid-episode the
    next observation is the first to carry it.

    With one objective there is nothing to prefer: the observation stays as it is, and w is [1].

    The environment declares its objectives by `reward_space`, a one-dimensional Box as in MO-Gymnasium; without one its
    reward must be a scalar. It stands inside `Monitor`, which needs a scalar: `Monitor(PreferenceWrapper(env))`.

    :param env: observations must be a one-dimensional Box, actions a bounded Box
    :param preference_sampler: `rng -> (n_objectives,)`, or a literal as `make_sampler` takes it; uniform on the simplex by
        default
    :raises ValueError: naming what the environment has and what to do about it
    """

    def __init__(self, env: gym.Env, preference_sampler: PreferenceSampler | SamplerSpec | None = None):
        gym.utils.RecordConstructorArgs.__init__(self, preference_sampler=preference_sampler)
        super().__init__(env)
        check_spaces(env.observation_space, env.action_space)
        self.n_objectives = count_objectives(env)
        self.declares_objectives = declared_reward_space(env) is not None
        if self.declares_objectives and is_wrapped(env, Monitor):
            raise ValueError(
                "This environment has a vector reward inside Monitor, which needs a scalar: build it as "
                "Monitor(PreferenceWrapper(env)) or with make_mo_vec_env."
            )
        self.preference_dim = preference_dim(self.n_objectives)
        self.env_index = 0
        self.set_preference_sampler(preference_sampler)
        self._fixed_preference: np.ndarray | None = None
        self._preference: np.ndarray | None = None
        self._holds_for_episode = False
        self._rng = np.random.default_rng()
        self._episode_step = 0
        self._episode: dict[str, Any] = {"actions": None, "vector_return": np.zeros(self.n_objectives)}

        box = env.observation_space
        assert isinstance(box, spaces.Box)
        self.raw_shape = box.shape
        self.observation_space = spaces.Box(
            np.concatenate([box.low, np.zeros(self.preference_dim)]).astype(np.float32),
            np.concatenate([box.high, np.ones(self.preference_dim)]).astype(np.float32),
            dtype=np.float32,
        )

    @property
    def preference(self) -> np.ndarray | None:
        """The w of the last observation, (n_objectives,); None before the first reset."""
        return None if self._preference is None else self._preference.copy()

    def set_preference(self, preference: Sequence[float] | np.ndarray | None) -> None:
        """Fix the preference, (n_objectives,), from the next observation on; None hands it back to the sampler.

        :raises ValueError: if it is not on the simplex, or has another shape
        """
        self._fixed_preference = None if preference is None else self._one_preference(preference)
        self._holds_for_episode = self._holds_for_episode and preference is None

    def set_preference_sampler(self, sampler: PreferenceSampler | SamplerSpec | CloudpickleWrapper | None) -> None:
        """Draw preferences with `sampler` from the next draw on; None: uniform on the simplex. It remembers no episode yet.

        :param sampler: or SB3's wrapper around it, which takes any callable into subprocesses
        """
        own = sampler.var if isinstance(sampler, CloudpickleWrapper) else sampler
        self.preference_sampler: PreferenceSampler = make_sampler("uniform" if own is None else own, self.n_objectives)
        self._n_remembered = int(getattr(self.preference_sampler, "remembered_episodes", 0))
        self._played = np.zeros((0, 2, self.n_objectives))  # preference and return of episodes that the sampler remembers

    def set_env_index(self, index: int) -> None:
        """The environment's place in its VecEnv, for error messages."""
        self.env_index = index

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode.

        :param seed: of the environment, and of the sampler's own random stream; episodes before it are forgotten
        :param options: `preference`, (n_objectives,), holds for this episode; all others go to the environment
        :return: [observation, w], float32 (observation_dim + preference_dim,), and the environment's info
        :raises ValueError: for a preference off the simplex, or an observation that is not finite or not of its space's shape
        """
        given = None
        if options is not None and "preference" in options:
            options = dict(options)
            given = self._one_preference(options.pop("preference"))
        if seed is not None:
            # A stream of its own: the environment draws from default_rng(seed) itself.
            self._rng = np.random.default_rng([seed, 1])
            self._played = self._played[:0]
        self._episode = {
            "seed": seed,
            "options": options or None,
            "env_rng": None if seed is not None else self.np_random.bit_generator.state,
            "rng": self._rng.bit_generator.state,
            "actions": [],
            "vector_return": np.zeros(self.n_objectives),
        }
        # As SB3 does it: an environment whose reset takes no options still works where none are given.
        observation, info = self.env.reset(seed=seed, **({"options": options} if options else {}))
        self._episode_step = 0
        self._holds_for_episode = given is not None
        self._preference = given if given is not None else self._next_preference()
        return self._observe(observation), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:  # type: ignore[override]
        """One step of the environment, its reward scalarised by the preference that the action saw.

        :param action: (action_dim,), within the action space's bounds
        :return: [next observation, next w], float32 (observation_dim + preference_dim,); w . r, in the unit of the rewards;
            terminated; truncated; and info with `vector_reward` and `preference`, both float32 (n_objectives,)
        :raises ValueError: for an observation or a reward that is not finite or not of its declared shape, a reward larger
            than 1e10 in size, or what a sampler drew that is no preference
        """
        self._note_action(action)
        observation, reward, terminated, truncated, info = self.env.step(action)
        assert self._preference is not None, "call reset() before step()"
        self._episode_step += 1
        vector_reward = self._check_reward(reward)
        self._episode["vector_return"] += vector_reward
        w = self._preference
        if (terminated or truncated) and self._n_remembered > 0:
            self._played = np.concatenate([self._played, [[w, self._episode["vector_return"]]]])[-self._n_remembered :]
        # As long as the environment uses the same dict again, ours must be another one.
        info = {**info, "vector_reward": vector_reward, "preference": w.copy()}
        if self._fixed_preference is not None or getattr(self.preference_sampler, "per_step", False):
            if not self._holds_for_episode:
                self._preference = self._next_preference()
        return self._observe(observation), float(np.dot(w, vector_reward)), terminated, truncated, info

    def _note_action(self, action: np.ndarray) -> None:
        """For a checkpoint in mid-episode, up to LONGEST_REPLAY of them."""
        actions = self._episode["actions"]
        if actions is not None:
            actions.append(np.array(action))
            if len(actions) > LONGEST_REPLAY:
                self._episode["actions"] = None

    def episode_so_far(self) -> dict[str, Any]:
        """What is needed to play the running episode again: the random numbers at its reset, the actions since, (n,
        action_dim), what they earned, and the preferences of this moment. `actions` is None where there is no episode, or too
        long a one."""
        actions = self._episode["actions"]
        return {
            **self._episode,
            "actions": None if actions is None else np.array(actions),
            "episode_step": self._episode_step,
            "preference": self._preference,
            "fixed_preference": self._fixed_preference,
            "holds_for_episode": self._holds_for_episode,
            "rng_now": self._rng.bit_generator.state,
            "played": self._played,
        }

    def begin_replay(self, state: dict[str, Any]) -> dict[str, Any]:
        """Set the random numbers, and the episodes that the sampler remembers, to those before an episode's reset; the
        arguments of that reset."""
        if state["env_rng"] is not None:
            self.np_random.bit_generator.state = state["env_rng"]
        self._rng.bit_generator.state = state["rng"]
        self._played = np.asarray(state.get("played", self._played), dtype=np.float64)
        return {"seed": state["seed"], "options": state["options"]}

    def end_replay(self, state: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Set the preferences to those of the moment when `state` was noted; [observation, w] of that moment, and what was
        earned until then."""
        self._fixed_preference, self._preference = state["fixed_preference"], state["preference"]
        self._holds_for_episode = state["holds_for_episode"]
        self._rng.bit_generator.state = state["rng_now"]
        return self._observe(self._observation), self._episode["vector_return"]

    def _next_preference(self) -> np.ndarray:
        if self._fixed_preference is not None:
            return self._fixed_preference.copy()
        played = () if self._n_remembered == 0 else (self._played[:, 0], self._played[:, 1])
        drawn = self.preference_sampler(self._rng, *played)
        try:
            return self._one_preference(drawn)
        except ValueError as error:
            raise ValueError(
                f"The preference sampler {self.preference_sampler!r} drew what is no preference. {error}"
            ) from error

    def _one_preference(self, preference: Sequence[float] | np.ndarray) -> np.ndarray:
        w = check_preference(preference, self.n_objectives)
        if w.ndim != 1:
            raise ValueError(f"One environment has one preference, ({self.n_objectives},), not an array of shape {w.shape}.")
        return w

    def _observe(self, observation: np.ndarray) -> np.ndarray:
        """[observation, w], always a fresh array: the environment may use its own again."""
        assert self._preference is not None
        self._observation = observation
        if np.shape(observation) != self.raw_shape:
            raise ValueError(
                f"{self._where()}: the observation has shape {np.shape(observation)} where {self.raw_shape} is declared: "
                "return what observation_space says."
            )
        w = self._preference if self.preference_dim > 0 else self._preference[:0]
        wrapped = np.concatenate([observation, w], dtype=np.float32)
        if not all_finite(wrapped):
            raise ValueError(
                f"{self._where()}: the observation has a number that is not finite: {observation}. Mend the environment, "
                "or end the episode before its state diverges."
            )
        return wrapped

    def _check_reward(self, reward: Any) -> np.ndarray:
        """The reward as a fresh float32 (n_objectives,), or an error that names the environment, step and objective."""
        try:
            vector = np.asarray(reward)
            if vector.dtype.kind not in "biuf":
                raise TypeError(f"dtype {vector.dtype}")
        except (TypeError, ValueError) as error:
            raise ValueError(f"{self._where()}: the reward {reward!r} is not made of numbers: return floats.") from error
        expected = (self.n_objectives,) if self.declares_objectives else ()
        if vector.shape != expected:
            cure = "return one number per objective of reward_space" if self.declares_objectives else HOW_TO_DECLARE
            raise ValueError(
                f"{self._where()}: the reward {reward!r} has shape {vector.shape} where {expected} is declared: {cure}."
            )
        vector = vector.reshape(self.n_objectives).astype(np.float64)
        if not all(abs(number) <= LARGEST_REWARD for number in vector.tolist()):
            objective = int((~(np.abs(vector) <= LARGEST_REWARD)).argmax())
            raise ValueError(
                f"{self._where()}: the reward of objective {objective} is {vector[objective]}: rewards must be "
                f"finite and at most {LARGEST_REWARD:g} in size. It was not stored."
            )
        return vector.astype(np.float32)

    def _where(self) -> str:
        name = self.spec.id if self.spec is not None else type(self.unwrapped).__name__
        return f"{name} (environment {self.env_index}, step {self._episode_step} of the episode)"
