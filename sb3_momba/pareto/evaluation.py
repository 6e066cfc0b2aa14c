"""Rolling out a policy under a grid of preferences (section 4.1.2)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecNormalize, is_vecenv_wrapped

from sb3_momba.envs.making import check_vec_env, make_env, make_mo_vec_env, n_objectives_of, wrap_env
from sb3_momba.envs.preferences import check_preference, preference_grid
from sb3_momba.envs.registry import raw_id
from sb3_momba.files import FileFormatError, FilePath, read_tree, with_existing_suffix, with_suffix, write_tree
from sb3_momba.pareto import metrics
from sb3_momba.pareto.processes import in_processes
from sb3_momba.pareto.protocol import N_EPISODES, N_PREFERENCES

MAX_PARALLEL_EPISODES = BATCH = 128
FRONT_FORMAT, FRONT_VERSION = "sb3_momba.front", 1

Array = NDArray[np.float64]


class Predictor(Protocol):
    """Anything with SB3's `predict` on the wrapped environment's observations [s, w]."""

    def predict(self, observation: Any, *, deterministic: bool) -> tuple[np.ndarray, Any]: ...


@dataclass
class ParetoFront:
    """What a policy earned under each preference.

    :param preferences: (P, n_objectives)
    :param returns: undiscounted vector returns, (P, E, n_objectives), E episodes per preference
    :param discounted_returns: likewise
    :param episode_lengths: in steps, (P, E)
    :param settings: how it was measured
    """

    preferences: Array
    returns: Array
    discounted_returns: Array
    episode_lengths: NDArray[np.int64]
    settings: dict[str, Any] = field(default_factory=dict)

    @property
    def values(self) -> Array:
        """Mean return of each preference, (P, n_objectives)."""
        return np.asarray(self.returns.mean(axis=1))

    @property
    def discounted_values(self) -> Array:
        """Mean discounted return of each preference, (P, n_objectives)."""
        return np.asarray(self.discounted_returns.mean(axis=1))

    @property
    def n_objectives(self) -> int:
        """Width of preferences and returns."""
        return int(self.preferences.shape[1])

    def non_dominated(self) -> NDArray[np.bool_]:
        """Which preferences' values no other one dominates, (P,)."""
        return metrics.non_dominated(self.values)

    def hypervolume(self, reference_point: ArrayLike | None = None) -> float:
        """HV, eq. (4.1), above a reference point, (n_objectives,); 0 by default."""
        return metrics.hypervolume(self.values, np.zeros(self.n_objectives) if reference_point is None else reference_point)

    def expected_utility(self) -> float:
        """EUM, eq. (4.2), over the evaluated preferences, in the unit of the scalarised return."""
        return metrics.expected_utility(self.values, self.preferences)

    def preference_regret(self) -> float:
        """What asking for a preference loses against the best policy found for it, in the unit of the scalarised return."""
        return metrics.preference_regret(self.values, self.preferences)

    def metrics(self, reference_point: ArrayLike | None = None) -> dict[str, float]:
        """All of the above by name; the reference point is 0 by default."""
        reference = np.zeros(self.n_objectives) if reference_point is None else reference_point
        return metrics.summarise(self.values, self.preferences, reference)

    def save(self, path: FilePath) -> None:
        """Write one file, ".npz" appended if it has no suffix, atomically and without pickle.

        :raises TypeError: names a setting that cannot be stored without pickle
        :raises OSError: if the file cannot be written; an old one stands
        """
        write_tree(with_suffix(path, ".npz"), {"format": FRONT_FORMAT, "version": FRONT_VERSION, **vars(self)})

    @classmethod
    def load(cls, path: FilePath) -> "ParetoFront":
        """A front from the file that `save` wrote; nothing of it is executed.

        :raises FileNotFoundError: if there is no such file
        :raises FileFormatError: if the file is damaged or no front
        """
        tree, _ = read_tree(with_existing_suffix(path, ".npz"))
        if not isinstance(tree, dict) or tree.pop("format", None) != FRONT_FORMAT:
            raise FileFormatError(f"{path} holds no Pareto front.")
        version = tree.pop("version", None)
        if version != FRONT_VERSION:
            raise FileFormatError(f"{path} has format version {version!r}, this sb3_momba reads {FRONT_VERSION}.")
        names = {field.name for field in fields(cls)}
        if set(tree) != names:
            raise FileFormatError(f"{path} holds {sorted(tree)}, not what a Pareto front has: {sorted(names)}.")
        shapes = {name: getattr(tree[name], "shape", ()) for name in sorted(names - {"settings"})}
        returns = shapes["returns"]
        expected = {
            "preferences": returns[::2],
            "returns": returns,
            "discounted_returns": returns,
            "episode_lengths": returns[:2],
        }
        if len(returns) != 3 or shapes != expected:
            raise FileFormatError(f"{path} holds arrays that do not go together, of shapes {shapes}.")
        return cls(**tree)


def evaluate_front(
    model: Predictor,
    env: str | gym.Env | VecEnv | Callable[[], gym.Env],
    n_preferences: int = N_PREFERENCES,
    n_episodes: int = N_EPISODES,
    seed: int = 0,
    preferences: ArrayLike | None = None,
    gamma: float | None = None,
    deterministic: bool = True,
    env_kwargs: dict[str, Any] | None = None,
    n_workers: int = 1,
    n_envs: int = MAX_PARALLEL_EPISODES,
) -> ParetoFront:
    """Roll a policy out under each preference, all episodes together, one `predict` per step.

    Episode e of every preference starts from seed + e. An environment class without any randomness may declare
    `deterministic = True`: with a deterministic policy one episode then stands for all. The policy always sees batches of
    one shape, so that the result of a deterministic one is the same, bit for bit, for any `n_workers` and `n_envs`.

    :param model: anything with `predict` on observations [s, w]
    :param env: of an id or a callable, copies run side by side; a VecEnv has its own; in an environment that exists already,
        one episode follows the other
    :param n_preferences: how many equally spaced preferences; see `preference_grid`
    :param n_episodes: per preference
    :param seed: of each preference's first episode
    :param preferences: to evaluate instead, (P, n_objectives), each on the simplex
    :param gamma: of the discounted returns; the model's own by default, 0.99 where it has none
    :param deterministic: the policy's mean action instead of a sample
    :param env_kwargs: of an id or a callable; an environment that exists takes none
    :param n_workers: processes that share the episodes; for an id or a callable. As with SB3's SubprocVecEnv, a script needs
        `if __name__ == "__main__":`
    :param n_envs: copies in each process, at most; fewer take less memory and more time
    :return: P preferences in the order of the grid; returns (P, E, n_objectives), in the units of the rewards, E = n_episodes
        or 1
    :raises ValueError: for a number below 1, a preference off the simplex, or an environment that does not fit the model
    :raises WorkerError: if one of several processes dies or hangs
    """
    if n_workers < 1 or (n_workers > 1 and isinstance(env, VecEnv | gym.Env)):
        raise ValueError(f"n_workers={n_workers}: at least one; more of them need an id or a callable that makes environments.")
    if n_episodes < 1:
        raise ValueError(f"n_episodes={n_episodes}: at least one episode is needed.")
    if n_envs < 1:
        raise ValueError(f"n_envs={n_envs}: at least one copy of the environment is needed.")
    if preferences is not None and np.size(preferences) == 0:
        raise ValueError("preferences=[]: give at least one preference, or None for equally spaced ones.")
    gamma = float(getattr(model, "gamma", 0.99)) if gamma is None else gamma
    probe = probe_environment(env, env_kwargs)
    check_model_fits(model, probe)
    grid = preference_grid(probe.n_objectives, n_preferences) if preferences is None else np.atleast_2d(preferences)
    grid = check_preference(grid, probe.n_objectives).astype(np.float64)
    n_run = 1 if probe.deterministic and deterministic else n_episodes
    each = [(w, int(seed) + episode) for w in grid for episode in range(n_run)]
    jobs = [(number, w, one_seed) for number, (w, one_seed) in enumerate(each)]

    if n_workers == 1:
        returns, discounted, lengths = run_jobs(model, env, env_kwargs, jobs, gamma, deterministic, n_envs)
    else:
        policy = model.policy if isinstance(model, BaseAlgorithm) else model  # without environments and replay buffer
        parts = [jobs[i::n_workers] for i in range(n_workers)]
        calls = [(policy, env, env_kwargs, part, gamma, deterministic, n_envs) for part in parts if part]
        results = in_processes(run_jobs, calls)
        n_objectives = grid.shape[1]
        returns, discounted = np.zeros((2, len(jobs), n_objectives))
        lengths = np.zeros(len(jobs), dtype=np.int64)
        for i, result in enumerate(results):
            returns[i::n_workers], discounted[i::n_workers], lengths[i::n_workers] = result
    settings = {
        "env": probe.name,
        "seed": seed,
        "gamma": gamma,
        "deterministic_policy": deterministic,
        "deterministic_env": probe.deterministic,
    }
    shape = (len(grid), n_run)
    return ParetoFront(grid, returns.reshape(*shape, -1), discounted.reshape(*shape, -1), lengths.reshape(shape), settings)


Jobs = Sequence[tuple[int, np.ndarray, int]]  # number among all jobs, preference, seed
Measured = tuple[Array, Array, NDArray[np.int64]]


def run_jobs(
    model: Predictor,
    env: str | gym.Env | VecEnv | Callable[[], gym.Env],
    env_kwargs: dict[str, Any] | None,
    jobs: Jobs,
    gamma: float,
    deterministic: bool,
    n_envs: int = MAX_PARALLEL_EPISODES,
    still_alive: Callable[[], None] = lambda: None,
) -> Measured:
    """Returns (n_jobs, n_objectives), discounted ones, and lengths (n_jobs,).

    :param still_alive: called at each step
    """
    venv, is_ours = _make_vec_env(env, min(len(jobs), n_envs), env_kwargs)
    n_threads = th.get_num_threads()
    # Sampling actions must not disturb the random numbers of a training that is going on.
    with th.random.fork_rng(enabled=not deterministic):
        if not deterministic:
            th.manual_seed(jobs[0][2])
        try:
            th.set_num_threads(1)  # More of them only slow such small products down, and could round them differently.
            return _run_episodes(model, venv, jobs, gamma, deterministic, still_alive)
        finally:
            th.set_num_threads(n_threads)
            if is_ours:
                venv.close()


def _run_episodes(
    model: Predictor, venv: VecEnv, jobs: Jobs, gamma: float, deterministic: bool, still_alive: Callable[[], None]
) -> Measured:
    """Each environment takes the next (preference, seed) as soon as its episode ends; idle ones go on unheard."""
    n_objectives = jobs[0][1].size
    returns, discounted = np.zeros((2, len(jobs), n_objectives))
    lengths = np.zeros(len(jobs), dtype=np.int64)
    observations = np.array(venv.reset())
    waiting = iter(enumerate(jobs))
    job_of: list[int | None] = [None] * venv.num_envs

    def start_next(index: int) -> None:
        job = next(waiting, None)
        job_of[index] = None if job is None else job[0]
        if job is not None:
            _, w, seed = job[1]
            options = {"preference": w} if n_objectives > 1 else None
            observations[index] = venv.env_method("reset", seed=seed, options=options, indices=[index])[0][0]

    for index in range(venv.num_envs):
        start_next(index)
    while any(job is not None for job in job_of):
        still_alive()
        places = [None if job is None else jobs[job][0] for job in job_of]
        next_observations, scalars, dones, infos = venv.step(_predict(model, observations, places, deterministic))
        observations = np.array(next_observations)
        for index, job in enumerate(job_of):
            if job is None:
                continue
            reward = np.asarray(infos[index].get("vector_reward", [scalars[index]]), dtype=np.float64)
            returns[job] += reward
            discounted[job] += gamma ** lengths[job] * reward
            lengths[job] += 1
            if dones[index]:
                start_next(index)
    return returns, discounted, lengths


def _predict(model: Predictor, observations: np.ndarray, places: Sequence[int | None], deterministic: bool) -> np.ndarray:
    """Actions, of a network in batches of one shape with each job in a place of its own: products round differently with
    both.

    :param places: the number of each observation's job; None where nobody listens
    """
    if not isinstance(model, BaseAlgorithm | BasePolicy):
        return model.predict(observations, deterministic=deterministic)[0]
    space = model.action_space
    assert isinstance(space, spaces.Box)
    actions = np.tile((space.low + space.high) / 2, (len(observations), 1))
    blocks: dict[int, list[tuple[int, int]]] = {}
    for index, place in enumerate(places):
        if place is not None:
            blocks.setdefault(place // BATCH, []).append((index, place % BATCH))
    for block in blocks.values():
        indices, rows = (list(column) for column in zip(*block, strict=True))
        batch = np.tile(observations[indices[0]], (BATCH, 1))
        batch[rows] = observations[indices]
        actions[indices] = model.predict(batch, deterministic=deterministic)[0][rows]
    return actions


@dataclass
class Probe:
    """What is known of an environment before it is evaluated."""

    name: str
    n_objectives: int
    deterministic: bool
    observation_space: Any  # Boxes; wrap_env refuses others
    action_space: Any


def probe_environment(env: str | gym.Env | VecEnv | Callable[[], gym.Env], env_kwargs: dict[str, Any] | None = None) -> Probe:
    """What must be known of an environment before it is copied."""
    if isinstance(env, VecEnv):
        if env_kwargs:
            raise ValueError("env_kwargs go with an id or a callable; this VecEnv exists already.")
        check_vec_env(env)
        if is_vecenv_wrapped(env, VecNormalize):
            raise ValueError("VecNormalize scales rewards, which are no returns then: give the environment without it.")
        if is_vecenv_wrapped(env, VecFrameStack):
            raise ValueError("VecFrameStack does not see where an evaluation resets an environment: stack frames inside it.")
        spec = env.get_attr("spec", indices=[0])[0]
        deterministic = env.has_attr("deterministic") and all(env.get_attr("deterministic"))
        name = raw_id(spec.id) if spec is not None else "VecEnv"
        return Probe(name, n_objectives_of(env), bool(deterministic), env.observation_space, env.action_space)
    one = wrap_env(make_env(env, env_kwargs))
    try:
        name = raw_id(one.spec.id) if one.spec is not None else type(one.unwrapped).__name__
        deterministic = one.has_wrapper_attr("deterministic") and one.get_wrapper_attr("deterministic")
        n_objectives = one.get_wrapper_attr("n_objectives")
        return Probe(name, n_objectives, bool(deterministic), one.observation_space, one.action_space)
    finally:
        if one.unwrapped is not getattr(env, "unwrapped", None):
            one.close()


def check_model_fits(model: Any, probe: Probe) -> int:
    """The number of objectives.

    :raises ValueError: if a model that knows its own has another one, or other observations or actions
    """
    n_objectives = getattr(model, "n_objectives", probe.n_objectives)
    if n_objectives != probe.n_objectives:
        raise ValueError(f"The model has {n_objectives} objectives, the environment {probe.name} has {probe.n_objectives}.")
    for name in ("observation_space", "action_space"):
        ours, theirs = getattr(model, name, None), getattr(probe, name)
        if ours is not None and ours.shape != theirs.shape:
            raise ValueError(f"The model's {name} has shape {ours.shape}, that of {probe.name} has {theirs.shape}.")
    return probe.n_objectives


def _make_vec_env(
    env: str | gym.Env | VecEnv | Callable[[], gym.Env], n_envs: int, env_kwargs: dict[str, Any] | None
) -> tuple[VecEnv, bool]:
    """A VecEnv, and whether it is ours to close."""
    if isinstance(env, VecEnv):
        return env, False
    if isinstance(env, gym.Env):
        return DummyVecEnv([lambda: wrap_env(env)]), False
    return make_mo_vec_env(env, n_envs, env_kwargs=env_kwargs), True
