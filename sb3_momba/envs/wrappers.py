"""The wrapper that conditions observations on a preference, and vectorised environments that carry it."""

import contextlib
import logging
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import mo_gymnasium  # noqa: F401  registers its environments' ids
import numpy as np
from gymnasium import spaces
from mo_gymnasium.wrappers.wrappers import LinearReward
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import CloudpickleWrapper, DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_momba.envs.preferences import PreferenceSampler, SamplerSpec, check_preference, make_sampler, preference_dim
from sb3_momba.envs.workers import WatchedSubprocVecEnv
from sb3_momba.finite import all_finite

LARGEST_REWARD = 1e10
LONGEST_REPLAY = 20_000  # actions of an episode that are noted

EnvLike = str | gym.Env | Callable[[], gym.Env]

logger = logging.getLogger(__name__)


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
        """Draw preferences with `sampler` from the next draw on; None: uniform on the simplex.

        :param sampler: or SB3's wrapper around it, which takes any callable into subprocesses
        """
        own = sampler.var if isinstance(sampler, CloudpickleWrapper) else sampler
        self.preference_sampler: PreferenceSampler = make_sampler("uniform" if own is None else own, self.n_objectives)

    def set_env_index(self, index: int) -> None:
        """The environment's place in its VecEnv, for error messages."""
        self.env_index = index

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode.

        :param seed: of the environment, and of the sampler's own random stream
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
        }

    def begin_replay(self, state: dict[str, Any]) -> dict[str, Any]:
        """Set the random numbers to those before an episode's reset; the arguments of that reset."""
        if state["env_rng"] is not None:
            self.np_random.bit_generator.state = state["env_rng"]
        self._rng.bit_generator.state = state["rng"]
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
        drawn = self.preference_sampler(self._rng)
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


HOW_TO_DECLARE = (
    "if it has several objectives, declare them in the environment's __init__: "
    "self.reward_space = gymnasium.spaces.Box(-inf, inf, shape=(n_objectives,)), as MO-Gymnasium does"
)


def declared_reward_space(env: gym.Env) -> spaces.Box | None:
    """The environment's `reward_space`, wherever in its stack of wrappers it stands, or None."""
    if is_wrapped(env, LinearReward):
        return None  # MO-Gymnasium's own scalarisation, behind which the reward space still shows
    space = env.get_wrapper_attr("reward_space") if env.has_wrapper_attr("reward_space") else None
    if space is not None and (not isinstance(space, spaces.Box) or len(space.shape) != 1 or space.shape[0] < 1):
        raise ValueError(f"reward_space={space!r} is not a one-dimensional Box with an entry per objective.")
    return space


def count_objectives(env: gym.Env) -> int:
    """n_objectives of the declared `reward_space`, or 1."""
    space = declared_reward_space(env)
    return 1 if space is None else int(space.shape[0])


class UnsupportedSpaceError(ValueError, AssertionError):
    """Observations or actions that the policy does not know; SB3 raises AssertionError where it does not know a space."""


def check_spaces(observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
    """
    :raises UnsupportedSpaceError: where observations are not a one-dimensional Box, or actions not a bounded Box
    """
    if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 1:
        raise UnsupportedSpaceError(
            f"The observation space {observation_space} is not a one-dimensional Box: flatten it with "
            "gymnasium.wrappers.FlattenObservation, images after a feature extractor of your own."
        )
    if not isinstance(action_space, spaces.Box):
        raise UnsupportedSpaceError(f"The action space {action_space} is not supported: MOMBA needs continuous actions, a Box.")
    if len(action_space.shape) != 1 or action_space.shape[0] == 0:
        raise UnsupportedSpaceError(
            f"The action space {action_space} has shape {action_space.shape}: flatten it to (n,) with an ActionWrapper."
        )
    low, high = action_space.low, action_space.high
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise UnsupportedSpaceError(
            f"The action space {action_space} has no finite bounds: MOMBA's policy covers [low, high]. Ask the environment for "
            "bounded actions (water-reservoir-v0: normalized_action=True) or put an ActionWrapper with a bounded Box around it."
        )
    if (low >= high).any():
        raise UnsupportedSpaceError(
            f"The action space {action_space} has low >= high in dimension {int((low >= high).argmax())}: leave a constant "
            "action out of the space with an ActionWrapper."
        )


def make_env(env: EnvLike, env_kwargs: dict[str, Any] | None = None, render_mode: str | None = None) -> gym.Env:
    """An environment from its id, from a callable, or itself. Ids are made without Gymnasium's checker, which does not
    know vector rewards.

    :param render_mode: for an id, where its environment takes one
    """
    if isinstance(env, str):
        if render_mode is not None:
            with contextlib.suppress(TypeError), warnings.catch_warnings():
                warnings.filterwarnings("ignore", "(?s).*render_mode", UserWarning)  # It need not have this one.
                return gym.make(env, disable_env_checker=True, render_mode=render_mode, **(env_kwargs or {}))
        try:
            return gym.make(env, disable_env_checker=True, **(env_kwargs or {}))
        except TypeError as error:
            if not env_kwargs:
                raise
            raise ValueError(f"{env} cannot be made with env_kwargs={env_kwargs}: {str(error).rstrip('.')}.") from error
    if isinstance(env, gym.Env):
        if env_kwargs:
            raise ValueError("env_kwargs go with an id or a callable; this environment exists already.")
        return env
    return env(**(env_kwargs or {}))


def wrap_env(env: gym.Env, preference_sampler: PreferenceSampler | SamplerSpec | None = None) -> Monitor:
    """`Monitor(PreferenceWrapper(env))`, unless both are there already."""
    has_monitor, has_preference = is_wrapped(env, Monitor), is_wrapped(env, PreferenceWrapper)
    if has_preference and preference_sampler is not None:
        env.get_wrapper_attr("set_preference_sampler")(preference_sampler)
    if not has_preference:
        env = PreferenceWrapper(env, preference_sampler)
    return env if has_monitor else Monitor(env)  # type: ignore[return-value]


def make_mo_vec_env(
    env: str | Callable[[], gym.Env],
    n_envs: int = 1,
    seed: int | None = None,
    preference_sampler: PreferenceSampler | SamplerSpec | None = None,
    env_kwargs: dict[str, Any] | None = None,
    vec_env_cls: type[DummyVecEnv] | type[SubprocVecEnv] = DummyVecEnv,
    vec_env_kwargs: dict[str, Any] | None = None,
) -> VecEnv:
    """Several copies of a vector-reward environment, each `Monitor(PreferenceWrapper(env))`.

    SB3's `make_vec_env(wrapper_class=...)` would put the wrapper outside Monitor, where vector rewards cannot pass.

    Observations are [s, w], float32 (n_envs, observation_dim + preference_dim); rewards w . r, (n_envs,), each r in its
    environment's info as `vector_reward`, (n_objectives,).

    :param env: id or callable that makes a new environment
    :param n_envs: copies, at least one
    :param seed: environment i starts with seed + i
    :param preference_sampler: for every copy; each has its own random stream
    :param env_kwargs: of the id or the callable
    :param vec_env_cls: with SubprocVecEnv, processes are watched over: see WatchedSubprocVecEnv
    :param vec_env_kwargs: of its constructor
    :raises ValueError: for an environment that exists already, n_envs below 1, or what PreferenceWrapper refuses
    :raises WorkerError: with SubprocVecEnv, where a process raises an error or dies
    """
    if isinstance(env, gym.Env):
        raise ValueError("make_mo_vec_env needs an id or a callable that makes new environments, not one environment.")

    if n_envs < 1:
        raise ValueError(f"n_envs={n_envs}: at least one environment is needed.")

    def maker(index: int) -> Callable[[], gym.Env]:
        def make() -> gym.Env:
            wrapped = wrap_env(make_env(env, env_kwargs), preference_sampler)
            wrapped.get_wrapper_attr("set_env_index")(index)
            return wrapped

        return make

    vec_env_cls = WatchedSubprocVecEnv if vec_env_cls is SubprocVecEnv else vec_env_cls
    venv = vec_env_cls([maker(i) for i in range(n_envs)], **(vec_env_kwargs or {}))
    if seed is not None:
        venv.seed(seed)
    return venv


def check_vec_env(venv: VecEnv) -> None:
    """A VecEnv that MOMBA can train on: every environment in a PreferenceWrapper, or every one scalar.

    :raises ValueError: naming what is missing or differs
    """
    check_spaces(venv.observation_space, venv.action_space)
    wrapped = venv.env_is_wrapped(PreferenceWrapper)
    if all(wrapped):
        for index in range(venv.num_envs):
            venv.env_method("set_env_index", index, indices=[index])
        n_objectives = venv.get_attr("n_objectives")
        if len(set(n_objectives)) > 1:
            raise ValueError(f"The environments of this VecEnv differ in their numbers of objectives: {n_objectives}.")
        inside = venv.get_attr("raw_shape")[0][0] + preference_dim(n_objectives[0])
        if venv.observation_space.shape != (inside,):
            raise ValueError(
                f"A wrapper outside PreferenceWrapper changes [observation, preference] from ({inside},) to "
                f"{venv.observation_space.shape}: put it inside, as in Monitor(PreferenceWrapper(YourWrapper(env)))."
            )
    elif any(wrapped) or venv.has_attr("reward_space"):
        raise ValueError(
            "This VecEnv has vector rewards without PreferenceWrapper: vector rewards do not pass through a VecEnv. Build it "
            "with sb3_momba.make_mo_vec_env, or give MOMBA the environment's id."
        )


def n_objectives_of(venv: VecEnv) -> int:
    """The number of objectives of a checked VecEnv; 1 where its environments are scalar."""
    return int(venv.get_attr("n_objectives", indices=[0])[0]) if all(venv.env_is_wrapped(PreferenceWrapper)) else 1
