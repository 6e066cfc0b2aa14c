"""check_mo_env names what is wrong with an environment."""

import re
import warnings

import numpy as np
import pytest
from gymnasium import spaces

from sb3_momba import PreferenceWrapper, check_mo_env
from tests.stubs import StubEnv


class Fresh(StubEnv):
    """StubEnv with episodes that are all alike."""

    def reset(self, **kwargs):
        self.n_steps = 0
        return super().reset(**kwargs)


@pytest.mark.parametrize("env", ["mo-hopper-2obj-v5", "MO-Swimmer-v4", "Pendulum-v1", Fresh, Fresh(n_objectives=3)])
def test_environments_that_are_right_pass_without_a_word(env):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_mo_env(env, n_steps=250)


class Wrong(Fresh):
    """Does one thing in another way."""

    wrong: str

    def reset(self, **kwargs):
        start = super().reset(**kwargs)
        if self.wrong == "reset":
            return start[0]
        if self.wrong == "reset info":
            return start[0], None
        if self.wrong == "seed":
            return start[0] + np.random.default_rng().normal(size=3).astype(np.float32), start[1]
        if self.wrong == "deterministic":
            return start[0] + self.np_random.normal(size=3).astype(np.float32), start[1]
        return start

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        if self.wrong == "step":
            return observation, reward, terminated, info
        if self.wrong == "terminated":
            return observation, reward, 0, truncated, info
        if self.wrong == "info":
            return observation, reward, terminated, truncated, [1]
        if self.wrong == "vector_reward":
            return observation, reward, terminated, truncated, {"vector_reward": reward}
        return observation, reward, terminated, truncated, info


MESSAGES = {
    "reset": "reset returned a ndarray: return (observation, info)",
    "reset info": "info is a NoneType: return a dictionary",
    "step": "step returned a tuple of 4: return (observation, reward, terminated, truncated, info)",
    "terminated": "terminated is 0: return True or False",
    "info": "info is a list: return a dictionary",
    "vector_reward": "info has an entry 'vector_reward', which PreferenceWrapper writes over",
    "seed": "Two runs with the same seed and actions differ: draw random numbers from self.np_random",
    "deterministic": "It declares deterministic = True, and another seed gives another run",
}


@pytest.mark.parametrize("wrong", MESSAGES)
def test_what_is_returned_in_another_way_is_named(wrong):
    env = Wrong()
    env.wrong, env.deterministic = wrong, wrong == "deterministic"
    with pytest.raises(ValueError, match=re.escape(MESSAGES[wrong])):
        check_mo_env(env, n_steps=30)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"observation_space": spaces.Discrete(3)}, "not a one-dimensional Box"),
        ({"action_space": spaces.Box(-np.inf, np.inf, (2,))}, "no finite bounds"),
        ({"observations": {3: np.zeros(4)}}, "the observation has shape (4,) where (3,) is declared"),
        ({"observations": {3: np.array([0, np.nan, 0])}}, "not finite"),
        ({"rewards": {3: 1.0}}, "has shape () where (2,) is declared"),
        ({"rewards": {3: np.array([1, np.inf])}}, "the reward of objective 1 is inf"),
        ({"observation_space": spaces.Box(0, 5, (3,))}, "observation_space.high[0] is 5, and 10 was seen: widen the space"),
        ({"reward_space": spaces.Box(-50, np.inf, (2,))}, "reward_space.low[1] is -50, and -100 was seen"),
    ],
    ids=str,
)
def test_what_is_declared_or_given_wrongly_is_named(settings, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        check_mo_env(Fresh, n_steps=30, env_kwargs=settings)


def test_everything_that_is_outside_of_its_space_is_named_at_once():
    env = Fresh(observation_space=spaces.Box(0, 5, (3,)), reward_space=spaces.Box(0, 1, (2,)))
    with pytest.raises(ValueError, match="is not ready for a training") as error:
        check_mo_env(env, n_steps=30)
    assert str(error.value).count("\n- ") == 5


def test_an_environment_without_spaces_or_in_our_wrapper_is_refused():
    env = Fresh()
    del env.action_space
    with pytest.raises(ValueError, match=r"Fresh has no action_space: set self\.action_space"):
        check_mo_env(env)
    with pytest.raises(ValueError, match="in PreferenceWrapper already"):
        check_mo_env(PreferenceWrapper(Fresh()))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"episode_length": 10_000}, "No episode ended in 30 steps, and there is no time limit"),
        ({"cast": lambda r: [r[0], 1.0]}, "Objective 1 was 1 at each of 30 steps"),
        ({"cast": lambda r: [r[0], 1e5 * r[0]]}, "Objective 1 is 100,000 times as large as objective 0"),
    ],
)
def test_what_is_seldom_meant_is_a_warning(settings, message):
    with pytest.warns(UserWarning, match=message):
        check_mo_env(Fresh, n_steps=30, env_kwargs=settings)


def test_a_machine_is_run_once_and_not_compared():
    class Machine(Fresh):
        def step(self, action):
            observation, *others = super().step(action)
            return observation + np.random.default_rng().random(3), *others

    with pytest.raises(ValueError, match=r"Two runs with the same seed .* ask for reproducible=False"):
        check_mo_env(Machine, n_steps=30)
    check_mo_env(Machine, n_steps=30, reproducible=False)


def test_a_reset_without_options_is_named():
    class Old(Fresh):
        def reset(self, seed=None):
            return super().reset(seed=seed)

    with pytest.raises(ValueError, match=r"reset takes \['seed'\]: write def reset\(self, \*, seed=None, options=None\)"):
        check_mo_env(Old())
