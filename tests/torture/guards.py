"""What the guard rails cost: a training with them, and with the work alone that remains without them."""

import contextlib
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from timeit import repeat
from typing import Any
from unittest import mock

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_momba import MOMBA, PreferenceWrapper, make_mo_vec_env
from sb3_momba.buffers import PreferenceReplayBuffer
from sb3_momba.envs.workers import WatchedSubprocVecEnv
from sb3_momba.logs import ForgivingWrite
from sb3_momba.nn import descent
from sb3_momba.policy import MombaPolicy
from sb3_momba.zoo.configuration import read_configuration
from tests.stubs import StubEnv
from tests.torture.measured import Counts, Measured, Rows

TASK = "MO-HalfCheetah-v4"
LEARNING_STARTS = 20
LARGEST_SHARE = 0.02  # of the step time of the default
ROUNDS = 9


@dataclass
class Guard:
    """A function that checks something, and what it would be without."""

    name: str
    owner: Any
    function: str
    unguarded: Callable[..., Any]

    def __post_init__(self) -> None:
        self.guarded = getattr(self.owner, self.function)


def observe(wrapper: PreferenceWrapper, observation: np.ndarray) -> np.ndarray:
    assert wrapper._preference is not None
    wrapper._observation = observation
    return np.concatenate([observation, wrapper._preference[: wrapper.preference_dim]], dtype=np.float32)


def take_reward(wrapper: PreferenceWrapper, reward: Any) -> np.ndarray:
    return np.array(reward, dtype=np.float32)


def take_preference(wrapper: PreferenceWrapper, preference: np.ndarray) -> np.ndarray:
    return (preference / preference.sum()).astype(np.float32)


def add(
    buffer: PreferenceReplayBuffer,
    obs: np.ndarray,
    next_obs: np.ndarray,
    action: np.ndarray,
    reward: np.ndarray,
    done: np.ndarray,
    infos: list[dict[str, Any]],
) -> None:
    raw = buffer.observation_dim
    buffer.preferences[buffer.pos] = obs[:, raw:]
    vector_rewards = np.stack([info["vector_reward"] for info in infos])
    ReplayBuffer.add(buffer, obs[:, :raw], next_obs[:, :raw], action, vector_rewards, done, infos)
    buffer.n_added += 1


def take_observation(policy: MombaPolicy, observation: np.ndarray, preference: Any, kept: Any) -> np.ndarray:
    return observation


def pass_by(*_: Any) -> None:
    pass


GUARDS = [
    Guard("observations", PreferenceWrapper, "_observe", observe),
    Guard("rewards", PreferenceWrapper, "_check_reward", take_reward),
    Guard("preferences", PreferenceWrapper, "_one_preference", take_preference),
    Guard("replay buffer", PreferenceReplayBuffer, "add", add),
    Guard("predict", MombaPolicy, "with_preference", take_observation),
    Guard("losses", descent, "check_loss", pass_by),
    Guard("gradients", descent, "check_gradients", pass_by),
    # Once in several episodes: no step of those that are measured has a call of it.
    Guard(
        "logs on a full disk", ForgivingWrite, "__call__", lambda forgiving, *args, **kwargs: forgiving.write(*args, **kwargs)
    ),
]


def default_model() -> MOMBA:
    return MOMBA("SimbaPolicy", make_mo_vec_env(TASK), learning_starts=LEARNING_STARTS, seed=0, device="cpu")


def capql_model() -> MOMBA:
    """The smallest networks that are shipped, and a new preference for every step: here guards weigh most."""
    capql = read_configuration("capql", TASK)
    settings = {**capql.hyperparameters, "learning_starts": LEARNING_STARTS}
    return MOMBA(capql.policy, make_mo_vec_env(TASK), seed=0, device="cpu", **settings)


def clocked(function: Callable[..., Any], name: str, spent: dict[str, float]) -> Callable[..., Any]:
    def call(*args: Any, **kwargs: Any) -> Any:
        start = time.process_time()
        try:
            return function(*args, **kwargs)
        finally:
            spent[name] += time.process_time() - start

    return call


def window(model: MOMBA, steps: int, with_guards: bool) -> list[float]:
    """Of each step of a training, the seconds of processor time, and those in each guard or what stands for it."""
    spent: dict[str, float] = defaultdict(float)
    with contextlib.ExitStack() as stack:
        for guard in GUARDS:
            function = guard.guarded if with_guards else guard.unguarded
            stack.enter_context(mock.patch.object(guard.owner, guard.function, clocked(function, guard.name, spent)))
        clocked(model.learn, "", spent)(steps, reset_num_timesteps=False)
    return [spent[name] / steps for name in ("", *(guard.name for guard in GUARDS))]


def in_place(model: MOMBA, windows: int, steps: int) -> tuple[float, float, list[float]]:
    """Seconds of a step with guards and without, and each guard's cost where it stands: after an update, which has driven all
    else out of the processor's caches. The least of all windows, as what else the machine does only adds to them."""
    pairs = [(window(model, steps, True), window(model, steps, False)) for _ in range(windows)]
    guarded, unguarded = (np.min(found, axis=0) for found in zip(*pairs, strict=True))
    return guarded[0], unguarded[0], list(guarded[1:] - unguarded[1:])


def watching_costs(steps: int) -> tuple[float, float]:
    """Seconds of processor time of a step of two idle environments in processes of their own: ours, and SB3's."""
    seconds = []
    for cls in (WatchedSubprocVecEnv, SubprocVecEnv):
        with mock.patch("sb3_momba.envs.making.WatchedSubprocVecEnv", cls):
            venv = make_mo_vec_env(StubEnv, 2, vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": "fork"})
        assert type(venv) is cls
        venv.reset()
        rounds = repeat(
            partial(venv.step, np.zeros((2, 2), dtype=np.float32)), number=steps, repeat=ROUNDS, timer=time.process_time
        )
        seconds.append(min(rounds) / steps)
        venv.close()
    return seconds[0], seconds[1]


def guards(counts: Counts) -> Measured:
    """What the guard rails cost of the step rate, in microseconds of processor time per step."""
    columns, shares = [], []
    for make in (default_model, capql_model):
        model = make().learn(LEARNING_STARTS + 2)
        step, unguarded, costs = in_place(model, counts["windows"], counts["window_steps"])
        shares.append(sum(costs) / step)
        seconds = (*costs, sum(costs), step)
        columns.append([*(f"{1e6 * one:.1f}" for one in seconds), as_share(shares[-1]), f"{unguarded / step:.3f}"])
    names = [
        *(guard.name for guard in GUARDS),
        "all guards",
        "a step",
        "share of the guards",
        "step rate over that without them",
    ]
    rows: Rows = [["", "default", "CAPQL"], *([*row] for row in zip(names, *columns, strict=True))]
    ours, theirs = watching_costs(counts["window_steps"] * 10)
    rows.append(["a step of two idle environments in processes: watched, SB3's", f"{1e6 * ours:.1f}", f"{1e6 * theirs:.1f}"])
    too_much = [f"the guards take {as_share(shares[0])} of the default's step"] if shares[0] > LARGEST_SHARE else []
    return Measured(rows, too_much)


def as_share(share: float) -> str:
    return f"{share:.2%}" + (f", more than {LARGEST_SHARE:.0%}" if share > LARGEST_SHARE else "")
