"""A pytest plugin that puts MOMBA in SAC's place in Stable-Baselines3's own tests, which stay as they are.

Of each test file it keeps the tests that use SAC. With `--objectives 2`, Pendulum-v1 and IdentityEnvBox have two objectives.
`--results FILE` takes the outcomes as JSON.
"""

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3
from stable_baselines3.common import envs
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_momba import MOMBA, PreferenceWrapper


class SAC(MOMBA):
    """MOMBA with three of SAC's defaults: the tests run for a few hundred steps, so that with MOMBA's own `learning_starts` of
    5,000 nothing would be updated, and one of them looks for SAC's name of a log."""

    def __init__(self, policy: Any, env: Any, learning_rate: Any = 3e-4, learning_starts: int = 100, **kwargs: Any):
        super().__init__(policy, env, learning_rate, learning_starts=learning_starts, **kwargs)

    def learn(self, *args: Any, tb_log_name: str = "SAC", **kwargs: Any) -> "SAC":
        return super().learn(*args, tb_log_name=tb_log_name, **kwargs)


class TorqueApart(gym.Wrapper):
    """Pendulum's reward as two: the cost of angle and speed, and the cost of torque."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.reward_space = gym.spaces.Box(-np.inf, 0, (2,), np.float32)

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        torque = -0.001 * float(np.square(action).sum())
        return observation, np.array([reward - torque, torque]), terminated, truncated, info


class CloseAndNear(envs.IdentityEnvBox):
    """IdentityEnvBox with a second objective: to be within twice the distance."""

    reward_space = gym.spaces.Box(0, 1, (2,), np.float32)

    def _get_reward(self, action: np.ndarray) -> Any:
        return np.abs(self.state - action).max() <= np.array([self.eps, 2 * self.eps])


class TwoObjectiveIdentityEnvBox(PreferenceWrapper):
    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(CloseAndNear(*args, **kwargs))


made_with_two_objectives = False


def note_objectives() -> None:
    """Let every PreferenceWrapper with two objectives say that there is one."""
    construct = PreferenceWrapper.__init__

    def constructed(self: PreferenceWrapper, *args: Any, **kwargs: Any) -> None:
        global made_with_two_objectives
        construct(self, *args, **kwargs)
        made_with_two_objectives |= self.n_objectives == 2

    PreferenceWrapper.__init__ = constructed  # type: ignore[method-assign]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--objectives", type=int, default=1)
    parser.addoption("--results", type=Path)


def pytest_configure(config: pytest.Config) -> None:
    stable_baselines3.SAC = SAC  # type: ignore[misc]
    if config.getoption("objectives") == 2:
        pendulum = gym.spec("Pendulum-v1")
        gym.register("Pendulum-v1", lambda **kwargs: PreferenceWrapper(TorqueApart(pendulum.make(**kwargs))))
        envs.IdentityEnvBox = TwoObjectiveIdentityEnvBox  # type: ignore[misc]
        note_objectives()


def uses_sac(item: pytest.Function) -> bool:
    """Whether a test's parameters name SAC, or, where they name no algorithm, its body does."""
    values = list(item.callspec.params.values()) if hasattr(item, "callspec") else []
    named = getattr(item.module, "MODEL_DICT", {})
    values = [named[value][0] if isinstance(value, str) and value in named else value for value in values]
    algorithms = [value for value in values if isinstance(value, type) and issubclass(value, BaseAlgorithm)]
    return SAC in algorithms if algorithms else "SAC" in item.function.__code__.co_names


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    kept = [item for item in items if isinstance(item, pytest.Function) and uses_sac(item)]
    config.hook.pytest_deselected(items=[item for item in items if item not in kept])
    items[:] = kept


results: dict[str, dict[str, Any]] = {}


def pytest_runtest_setup(item: pytest.Item) -> None:
    global made_with_two_objectives
    made_with_two_objectives = False


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    result = results.setdefault(report.nodeid.split("/")[-1], {"outcome": "passed", "error": ""})
    result["two_objectives"] = made_with_two_objectives
    if report.outcome != "passed":
        crash = getattr(report.longrepr, "reprcrash", None)
        result["outcome"] = report.outcome
        result["error"] = crash.message if crash is not None else str(report.longrepr)


def pytest_sessionfinish(session: pytest.Session) -> None:
    path = session.config.getoption("results")
    if path is not None:
        path.write_text(json.dumps(results, indent=1))
