"""Preferences, the wrapper that shows them to the agent, and vectorised environments that carry it."""

import logging
import pickle
from functools import partial
from math import comb

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

from sb3_momba import PreferenceWrapper, make_mo_vec_env
from sb3_momba.envs.preferences import (
    FixedSampler,
    PerStepSampler,
    UniformSampler,
    check_preference,
    preference_grid,
    simplex_lattice,
)
from tests.stubs import StubEnv, observation_of, reward_of, tiny_model

ANY_ACTION = np.zeros(2, dtype=np.float32)
HOPPER, CHEETAH = "mo-hopper-2obj-v5", "mo-halfcheetah-v5"
CAR, WATER = "mo-mountaincarcontinuous-v0", "water-reservoir-v0"


def shown(observation: np.ndarray) -> list[float]:
    """The preference in the observation of a wrapped StubEnv."""
    return observation[..., 3:].tolist()


def preferences_of_steps(env: gym.Env, n_steps: int, seed: int | None = None) -> np.ndarray:
    """The preference of each observation, the first one included; an episode that ends is reset."""
    observation, _ = env.reset(seed=seed)
    seen = [shown(observation)]
    for _ in range(n_steps):
        observation, _, terminated, truncated, _ = env.step(ANY_ACTION)
        if terminated or truncated:
            observation, _ = env.reset()
        seen.append(shown(observation))
    return np.array(seen)


# ----------------------------------------------------------------------------------------------- what a step returns


def test_the_observation_is_float32_with_the_preference_last():
    bounds = {"low": np.array([-1.0, 0.0, -np.inf]), "high": np.array([1.0, np.inf, 5.0])}
    env = PreferenceWrapper(StubEnv(observation_space=spaces.Box(**bounds, dtype=np.float64)))
    assert env.observation_space == spaces.Box(
        np.float32([-1, 0, -np.inf, 0, 0]), np.float32([1, np.inf, 5, 1, 1]), dtype=np.float32
    )
    assert env.action_space == env.unwrapped.action_space
    observation, _ = env.reset(options={"preference": [0.25, 0.75]})
    np.testing.assert_array_equal(observation, np.float32([0.5, 0.75, 1.0, 0.25, 0.75]), strict=True)
    observation = env.step(ANY_ACTION)[0]
    np.testing.assert_array_equal(observation, np.float32([1.0, 1.25, 1.5, 0.25, 0.75]), strict=True)


@pytest.mark.parametrize("n_objectives", [2, 3, 6])
def test_the_observation_lies_in_the_observation_space(n_objectives):
    env = PreferenceWrapper(StubEnv(n_objectives))
    assert env.observation_space.contains(env.reset(seed=0)[0])
    assert env.observation_space.contains(env.step(ANY_ACTION)[0])


def test_the_reward_is_the_python_float_w_dot_r_and_info_tells_both():
    env = PreferenceWrapper(StubEnv())
    env.reset(options={"preference": [0.25, 0.75]})
    env.step(ANY_ACTION)
    _, reward, _, _, info = env.step(ANY_ACTION)
    assert type(reward) is float
    assert reward == 0.25 * 2 + 0.75 * -20
    np.testing.assert_array_equal(info["vector_reward"], np.float32([2, -20]), strict=True)
    np.testing.assert_array_equal(info["preference"], np.float32([0.25, 0.75]), strict=True)
    assert info["step"] == 2


def test_info_holds_fresh_copies():
    env = PreferenceWrapper(StubEnv(reuse_arrays=True))
    observation, _ = env.reset(options={"preference": [0.25, 0.75]})
    first = env.step(ANY_ACTION)
    second = env.step(ANY_ACTION)
    np.testing.assert_array_equal(first[4]["vector_reward"], reward_of(1, 2))
    np.testing.assert_array_equal(first[0][:3], observation_of(1))
    np.testing.assert_array_equal(observation[:3], observation_of(0, start_of_episode=True))
    assert first[4] is not second[4]
    second[4]["preference"][:] = 7
    second[0][:] = 7
    env.preference[:] = 7
    third = env.step(ANY_ACTION)
    assert shown(third[0]) == [0.25, 0.75]
    assert third[4]["preference"].tolist() == [0.25, 0.75]


class OneInfo(gym.Wrapper):
    """Returns the same info dictionary at every step, as some environments do."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.info = {"mine": 1}

    def step(self, action):
        return *self.env.step(action)[:4], self.info


def test_the_info_of_the_environment_is_not_written_to():
    env = OneInfo(StubEnv())
    wrapped = PreferenceWrapper(env)
    wrapped.reset()
    assert wrapped.step(ANY_ACTION)[4]["mine"] == 1
    assert env.info == {"mine": 1}


def test_info_tells_the_preference_that_the_action_saw_before_a_new_one_is_drawn():
    env = PreferenceWrapper(StubEnv(), PerStepSampler(UniformSampler(2)))
    before, _ = env.reset(seed=0)
    for t in range(1, 6):
        after, reward, _, _, info = env.step(ANY_ACTION)
        assert info["preference"].tolist() == shown(before)
        assert shown(after) != shown(before)
        assert reward == pytest.approx(float(np.dot(shown(before), reward_of(t, 2))), rel=1e-5)
        before = after


# --------------------------------------------------------------------------------------------- where w comes from


def test_by_default_each_episode_has_one_new_preference():
    seen = preferences_of_steps(PreferenceWrapper(StubEnv(episode_length=5)), n_steps=14, seed=0)
    episodes = seen.reshape(3, 5, 2)
    assert (episodes == episodes[:, :1]).all()
    assert len(np.unique(episodes[:, 0], axis=0)) == 3
    np.testing.assert_allclose(seen.sum(axis=1), 1, rtol=1e-6)


def test_the_default_preferences_are_uniform_on_the_simplex():
    env = PreferenceWrapper(StubEnv(n_objectives=3))
    env.reset(seed=0)
    drawn = np.array([env.reset()[0][3:] for _ in range(3000)])
    # Dirichlet(1, 1, 1): mean 1/3, variance 1/18, and P(w_i > 1/2) = 1/4.
    np.testing.assert_allclose(drawn.mean(axis=0), 1 / 3, atol=0.02)
    np.testing.assert_allclose(drawn.var(axis=0), 1 / 18, atol=0.005)
    np.testing.assert_allclose((drawn > 0.5).mean(axis=0), 1 / 4, atol=0.03)


def test_a_per_step_sampler_gives_each_observation_its_own_preference():
    seen = preferences_of_steps(PreferenceWrapper(StubEnv(episode_length=5), PerStepSampler(UniformSampler(2))), 14, seed=0)
    assert len(np.unique(seen, axis=0)) == 15


def test_a_fixed_sampler_gives_its_preference_always():
    seen = preferences_of_steps(PreferenceWrapper(StubEnv(episode_length=2), FixedSampler((0.25, 0.75))), 7)
    assert (seen == [0.25, 0.75]).all()


def test_any_callable_samples():
    seen = preferences_of_steps(PreferenceWrapper(StubEnv(), lambda rng: [0.5, 0.5] if rng.random() >= 0 else None), 3)
    assert (seen == 0.5).all()


def test_a_sampler_off_the_simplex_is_an_error():
    env = PreferenceWrapper(StubEnv(), lambda rng: rng.random(2) + 1)
    with pytest.raises(ValueError, match="sums to"):
        env.reset()


def test_the_preference_of_reset_holds_for_one_episode():
    for sampler in (UniformSampler(2), PerStepSampler(UniformSampler(2))):
        env = PreferenceWrapper(StubEnv(), sampler)
        assert shown(env.reset(seed=0, options={"preference": [0.25, 0.75]})[0]) == [0.25, 0.75]
        assert [shown(env.step(ANY_ACTION)[0]) for _ in range(3)] == [[0.25, 0.75]] * 3
        assert shown(env.reset()[0]) != [0.25, 0.75]


def test_reset_hands_other_options_and_the_seed_to_the_environment():
    env = PreferenceWrapper(StubEnv())
    options = {"preference": [0.5, 0.5], "start": 3}
    env.reset(seed=5, options=options)
    assert env.unwrapped.options == {"start": 3}
    assert options == {"preference": [0.5, 0.5], "start": 3}
    assert env.unwrapped.np_random_seed == 5
    env.reset(options={"preference": [0.5, 0.5]})
    assert env.unwrapped.options is None


def test_set_preference_counts_from_the_next_observation_in_mid_episode():
    env = PreferenceWrapper(StubEnv())
    observation, _ = env.reset(seed=0)
    env.set_preference([0.25, 0.75])
    following, reward, _, _, info = env.step(ANY_ACTION)
    assert info["preference"].tolist() == shown(observation)
    assert reward == pytest.approx(np.dot(shown(observation), reward_of(1, 2)))
    assert shown(following) == [0.25, 0.75]
    assert env.preference.tolist() == [0.25, 0.75]
    assert shown(env.reset()[0]) == [0.25, 0.75]


def test_set_preference_to_none_hands_it_back_to_the_sampler():
    env = PreferenceWrapper(StubEnv())
    env.set_preference([0.25, 0.75])
    env.reset(seed=0)
    env.set_preference(None)
    assert shown(env.step(ANY_ACTION)[0]) == [0.25, 0.75]
    assert shown(env.reset()[0]) != [0.25, 0.75]
    per_step = PreferenceWrapper(StubEnv(), PerStepSampler(UniformSampler(2)))
    per_step.set_preference([0.25, 0.75])
    per_step.reset(seed=0)
    assert shown(per_step.step(ANY_ACTION)[0]) == [0.25, 0.75]
    per_step.set_preference(None)
    assert shown(per_step.step(ANY_ACTION)[0]) != [0.25, 0.75]


def test_the_option_of_reset_beats_an_earlier_set_preference_for_one_episode():
    env = PreferenceWrapper(StubEnv())
    env.set_preference([1, 0])
    assert shown(env.reset(options={"preference": [0, 1]})[0]) == [0, 1]
    assert shown(env.step(ANY_ACTION)[0]) == [0, 1]
    assert shown(env.reset()[0]) == [1, 0]


def test_a_later_set_preference_beats_the_option_of_reset():
    env = PreferenceWrapper(StubEnv())
    env.reset(options={"preference": [0, 1]})
    env.set_preference([1, 0])
    assert shown(env.step(ANY_ACTION)[0]) == [1, 0]


def test_the_preference_is_the_caller_s_only_by_value():
    w = np.array([0.25, 0.75])
    env = PreferenceWrapper(StubEnv())
    env.set_preference(w)
    w[:] = 0.5
    assert shown(env.reset()[0]) == [0.25, 0.75]


def test_set_preference_sampler_counts_from_the_next_draw():
    env = PreferenceWrapper(StubEnv())
    observation, _ = env.reset(seed=0)
    env.set_preference_sampler(FixedSampler((0.25, 0.75)))
    assert shown(env.step(ANY_ACTION)[0]) == shown(observation)
    assert shown(env.reset()[0]) == [0.25, 0.75]
    env.set_preference_sampler(None)
    assert shown(env.reset()[0]) != [0.25, 0.75]


# ---------------------------------------------------------------------------------------------------------- seeds


@pytest.mark.parametrize("sampler", [None, PerStepSampler(UniformSampler(2))], ids=["per episode", "per step"])
def test_the_same_seed_gives_the_same_preferences_and_another_seed_others(sampler):
    make = partial(PreferenceWrapper, preference_sampler=sampler)
    first = preferences_of_steps(make(StubEnv(episode_length=2)), 10, seed=3)
    again = preferences_of_steps(make(StubEnv(episode_length=2)), 10, seed=3)
    other = preferences_of_steps(make(StubEnv(episode_length=2)), 10, seed=4)
    np.testing.assert_array_equal(first, again)
    assert (first != other).all()


def test_a_reset_without_seed_goes_on_with_the_stream():
    env = PreferenceWrapper(StubEnv())
    first, second = shown(env.reset(seed=3)[0]), shown(env.reset()[0])
    assert first != second
    assert [shown(env.reset(seed=3)[0]), shown(env.reset()[0])] == [first, second]


def test_without_a_seed_two_environments_differ():
    assert shown(PreferenceWrapper(StubEnv()).reset()[0]) != shown(PreferenceWrapper(StubEnv()).reset()[0])


class StartsAnywhere(StubEnv):
    """Its first observation comes from its own seeded stream."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed, options=options)
        return self.np_random.random(3).astype(np.float32), {}


def test_preferences_do_not_repeat_the_random_numbers_of_the_environment():
    env = PreferenceWrapper(StartsAnywhere(), lambda rng: (lambda u: [u, 1 - u])(rng.random()))
    observation, _ = env.reset(seed=11)
    assert observation[3] not in observation[:3]


# ---------------------------------------------------------------------------------------------------- one objective


@pytest.mark.parametrize("n_objectives", [None, 1], ids=["number", "vector of one"])
def test_one_objective_leaves_observations_and_rewards_as_they_are(n_objectives):
    env = PreferenceWrapper(StubEnv(n_objectives))
    assert env.n_objectives == 1
    assert env.observation_space == env.unwrapped.observation_space
    np.testing.assert_array_equal(env.reset()[0], observation_of(0, start_of_episode=True))
    observation, reward, _, _, info = env.step(ANY_ACTION)
    np.testing.assert_array_equal(observation, observation_of(1))
    assert type(reward) is float
    assert reward == 1.0
    np.testing.assert_array_equal(info["vector_reward"], np.float32([1]), strict=True)
    np.testing.assert_array_equal(info["preference"], np.float32([1]), strict=True)


@pytest.mark.parametrize("n_objectives", [1, 2])
@pytest.mark.parametrize("shape", [(1,), (2,), (4,), ()], ids=str)
def test_an_observation_of_another_shape_than_declared_is_an_error_and_never_broadcast(n_objectives, shape):
    env = StubEnv(n_objectives, observations={2: np.ones(shape, dtype=np.float32)})
    model = tiny_model(env)
    with pytest.raises(ValueError, match=r"StubEnv .*step 2 .*observation.*shape"):
        model.learn(5)
    assert model.replay_buffer.pos == 1


@pytest.mark.parametrize("space", [spaces.Box(-1, 1, ()), spaces.Box(-1, 1, (2, 2)), spaces.Discrete(2)], ids=str)
def test_a_reward_space_that_is_no_vector_is_an_error(space):
    with pytest.raises(ValueError, match=r"reward_space=.* is not a one-dimensional Box"):
        PreferenceWrapper(StubEnv(reward_space=space))


# ------------------------------------------------------------------------------------------- gymnasium's registry


@pytest.fixture
def registered_id():
    env_id = "PreferenceStub-v0"
    wrapper = PreferenceWrapper.wrapper_spec(preference_sampler=FixedSampler((0.25, 0.75)))
    gym.register(env_id, entry_point="tests.stubs:StubEnv", additional_wrappers=(wrapper,), disable_env_checker=True)
    yield env_id
    del gym.registry[env_id]


def test_an_id_registered_with_the_wrapper_makes_wrapped_environments(registered_id):
    env = gym.make(registered_id)
    assert isinstance(env, PreferenceWrapper)
    assert shown(env.reset()[0]) == [0.25, 0.75]
    again = gym.make(env.spec)
    assert isinstance(again, PreferenceWrapper)
    assert shown(again.reset()[0]) == [0.25, 0.75]


def test_the_spec_of_a_wrapped_environment_records_the_wrapper_and_its_sampler():
    env = PreferenceWrapper(gym.make(HOPPER, disable_env_checker=True), FixedSampler((1.0, 0.0)))
    spec = env.spec
    assert spec.additional_wrappers[-1].kwargs == {"preference_sampler": FixedSampler((1.0, 0.0))}
    again = gym.make(spec)
    assert isinstance(again, PreferenceWrapper)
    assert again.reset()[0][-2:].tolist() == [1, 0]


@pytest.mark.parametrize(
    "sampler",
    [
        UniformSampler(3),
        FixedSampler((0.2, 0.3, 0.5)),
        PerStepSampler(UniformSampler(3)),
        PerStepSampler(FixedSampler((0.2, 0.8))),
    ],
    ids=lambda sampler: type(sampler).__name__,
)
@pytest.mark.parametrize("pickler", [pickle, cloudpickle], ids=lambda module: module.__name__)
def test_samplers_survive_pickling(sampler, pickler):
    again = pickler.loads(pickler.dumps(sampler))
    assert again == sampler
    assert getattr(again, "per_step", False) == getattr(sampler, "per_step", False)
    np.testing.assert_array_equal(again(np.random.default_rng(0)), sampler(np.random.default_rng(0)))


# ----------------------------------------------------------------------------------------------------- VecEnvs


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_make_mo_vec_env_seeds_environment_i_with_seed_plus_i(vec_env_cls):
    venv = make_mo_vec_env(StartsAnywhere, n_envs=2, seed=7, vec_env_cls=vec_env_cls)
    observations = venv.reset()
    singles = [PreferenceWrapper(StartsAnywhere()).reset(seed=7 + i)[0] for i in range(2)]
    np.testing.assert_array_equal(observations, singles)
    assert len(np.unique(observations[:, 3])) == 2
    assert venv.env_is_wrapped(Monitor) == venv.env_is_wrapped(PreferenceWrapper) == [True] * 2
    assert venv.get_attr("env_index") == [0, 1]
    venv.close()


def test_make_mo_vec_env_puts_the_wrapper_inside_monitor():
    venv = make_mo_vec_env(partial(StubEnv, episode_length=2), preference_sampler=FixedSampler((0.25, 0.75)))
    assert isinstance(venv.envs[0], Monitor)
    assert isinstance(venv.envs[0].env, PreferenceWrapper)
    venv.reset()
    venv.step(ANY_ACTION[None])
    infos = venv.step(ANY_ACTION[None])[3]
    assert infos[0]["episode"]["r"] == 0.25 * (1 + 2) + 0.75 * (-10 - 20)
    assert infos[0]["terminal_observation"].tolist() == [2.0, 2.25, 2.5, 0.25, 0.75]


def test_make_mo_vec_env_hands_over_env_kwargs_and_samplers():
    venv = make_mo_vec_env(StubEnv, 2, preference_sampler=FixedSampler((1, 0, 0)), env_kwargs={"n_objectives": 3})
    assert venv.get_attr("n_objectives") == [3, 3]
    assert venv.reset()[:, 3:].tolist() == [[1, 0, 0]] * 2
    venv = make_mo_vec_env(WATER, env_kwargs={"normalized_action": True})
    assert np.isfinite(venv.action_space.high).all()


def test_make_mo_vec_env_needs_something_that_makes_environments():
    with pytest.raises(ValueError, match="an id or a callable"):
        make_mo_vec_env(StubEnv())


def test_env_method_sets_the_preference_of_one_environment():
    venv = make_mo_vec_env(StubEnv, 2)
    venv.env_method("set_preference", [0.25, 0.75], indices=[1])
    observations = venv.reset()
    assert shown(observations[1]) == [0.25, 0.75]
    assert shown(observations[0]) != [0.25, 0.75]


def test_the_options_of_a_vec_env_reach_the_wrapper():
    venv = make_mo_vec_env(StubEnv, 2)
    venv.set_options([{"preference": [1, 0]}, {"preference": [0, 1]}])
    assert venv.reset()[:, 3:].tolist() == [[1, 0], [0, 1]]


def test_a_prebuilt_vec_env_with_the_wrapper_trains():
    for venv in (
        DummyVecEnv([lambda: Monitor(PreferenceWrapper(StubEnv()))]),
        VecMonitor(DummyVecEnv([lambda: PreferenceWrapper(StubEnv())])),
    ):
        model = tiny_model(venv).learn(5)
        assert model.n_objectives == 2
        np.testing.assert_array_equal(model.replay_buffer.rewards[:5, 0], [reward_of(t, 2) for t in range(1, 6)])


def test_a_prebuilt_vec_env_without_the_wrapper_is_an_error_that_names_it():
    fork = {"start_method": "fork"}
    for venv in (
        DummyVecEnv([StubEnv]),
        make_vec_env(StubEnv),
        make_vec_env(StubEnv, 2, None, 0, None, None, None, SubprocVecEnv, fork),
    ):
        with pytest.raises(ValueError, match=r"without PreferenceWrapper.*make_mo_vec_env"):
            tiny_model(venv)
        venv.close()


def test_the_wrapper_outside_monitor_is_an_error_that_names_the_order():
    order = r"Monitor\(PreferenceWrapper\(env\)\) or with make_mo_vec_env"
    with pytest.raises(ValueError, match=order):
        PreferenceWrapper(Monitor(StubEnv()))
    with pytest.raises(ValueError, match=order):
        make_vec_env(StubEnv, wrapper_class=PreferenceWrapper)


def test_a_vector_reward_inside_monitor_is_an_error_that_names_the_order():
    with pytest.raises(ValueError, match=r"Monitor\(PreferenceWrapper\(env\)\)"):
        tiny_model(Monitor(StubEnv()))


def test_subclasses_of_the_wrappers_count_as_the_wrappers():
    class OwnWrapper(PreferenceWrapper):
        pass

    class OwnMonitor(Monitor):
        pass

    model = tiny_model(OwnMonitor(OwnWrapper(StubEnv())))
    assert model.observation_space.shape == (5,)  # one preference, not two
    with pytest.raises(ValueError, match=r"Monitor\(PreferenceWrapper\(env\)\)"):
        PreferenceWrapper(OwnMonitor(StubEnv()))


def test_an_environment_that_is_wrapped_already_is_not_wrapped_twice():
    env = Monitor(PreferenceWrapper(StubEnv(), FixedSampler((0.25, 0.75))))
    model = tiny_model(env)
    assert model.env.envs[0] is env
    assert model.observation_space.shape == (5,)
    assert shown(model.env.reset()[0]) == [0.25, 0.75]


@pytest.mark.parametrize(
    ("env_id", "env_kwargs", "n_objectives", "observation_dim"),
    [(HOPPER, {}, 2, 11), (CHEETAH, {}, 2, 17), (CAR, {}, 2, 2), (WATER, {"normalized_action": True}, 2, 1)],
)
def test_environments_of_mo_gymnasium(env_id, env_kwargs, n_objectives, observation_dim):
    venv = make_mo_vec_env(env_id, 2, seed=0, env_kwargs=env_kwargs)
    assert venv.get_attr("n_objectives") == [n_objectives] * 2
    assert venv.observation_space.shape == (observation_dim + n_objectives,)
    observations = venv.reset()
    venv.action_space.seed(0)
    some = 0.0
    for _ in range(10):
        actions = np.array([venv.action_space.sample() for _ in range(2)])
        following, rewards, dones, infos = venv.step(actions)
        for i in range(2):
            preference, vector_reward = infos[i]["preference"], infos[i]["vector_reward"]
            np.testing.assert_array_equal(preference, observations[i, observation_dim:])
            assert vector_reward.shape == (n_objectives,)
            assert rewards[i] == pytest.approx(float(np.dot(preference, vector_reward)), rel=1e-5, abs=1e-6)
            some += np.abs(vector_reward).sum()
            if dones[i]:
                assert infos[i]["terminal_observation"][observation_dim:].tolist() == preference.tolist()
        observations = following
    assert some > 0
    assert np.isfinite(observations).all()
    model = tiny_model(venv, learning_starts=10).learn(20)
    assert model._n_updates == 5
    assert venv.action_space.contains(model.predict(observations[0])[0])


def test_rewards_equal_those_of_the_bare_environment():
    bare, wrapped = gym.make(HOPPER, disable_env_checker=True), PreferenceWrapper(gym.make(HOPPER, disable_env_checker=True))
    observation, _ = bare.reset(seed=4)
    np.testing.assert_array_equal(wrapped.reset(seed=4)[0][:11], observation.astype(np.float32))
    bare.action_space.seed(0)
    for _ in range(5):
        action = bare.action_space.sample()
        observation, reward, _, _, _ = bare.step(action)
        following, _, _, _, info = wrapped.step(action)
        np.testing.assert_array_equal(following[:11], observation.astype(np.float32))
        np.testing.assert_array_equal(info["vector_reward"], np.float32(reward))


# --------------------------------------------------------------------------------------------- grids and checks


def assert_on_simplex(grid: np.ndarray) -> None:
    assert (grid >= 0).all()
    np.testing.assert_allclose(grid.sum(axis=1), 1, rtol=1e-9)
    assert len(np.unique(grid.round(9), axis=0)) == len(grid)


def corners_missing(grid: np.ndarray) -> list[int]:
    return [i for i in range(grid.shape[1]) if not np.isclose(grid, np.eye(grid.shape[1])[i], atol=1e-6).all(axis=1).any()]


@pytest.mark.parametrize("n", [2, 3, 11, 100])
def test_the_grid_of_two_objectives_is_linspace(n):
    grid = preference_grid(2, n)
    np.testing.assert_array_equal(grid, np.stack([np.linspace(0, 1, n), 1 - np.linspace(0, 1, n)], axis=1))
    assert_on_simplex(grid)
    assert corners_missing(grid) == []


@pytest.mark.parametrize("d", [3, 4, 5, 6])
def test_the_grid_of_three_to_six_objectives_has_exactly_100_well_spread_points(d):
    grid = preference_grid(d)
    assert grid.shape == (100, d)
    assert grid.dtype == np.float64
    assert_on_simplex(grid)
    assert corners_missing(grid) == []
    distances = np.linalg.norm(grid[:, None] - grid[None], axis=-1) + 10 * np.eye(100)
    nearest = distances.min(axis=1)
    assert nearest.min() > 0.3 * nearest.max()
    np.testing.assert_allclose(grid.mean(axis=0), 1 / d, atol=0.03)


def test_a_grid_can_be_changed_without_changing_the_next_one():
    for d in (2, 3, 4):
        first = preference_grid(d)
        original = first.copy()
        first[:] = 7
        np.testing.assert_array_equal(preference_grid(d), original)


@pytest.mark.parametrize(("d", "asked", "given"), [(3, 10, 10), (3, 11, 15), (3, 99, 105), (3, 1, 3), (4, 20, 20), (5, 36, 70)])
def test_any_other_size_gives_the_smallest_lattice_with_at_least_as_many_points(d, asked, given, caplog):
    with caplog.at_level(logging.INFO, logger="sb3_momba"):
        grid = preference_grid(d, asked)
    assert grid.shape == (given, d)
    assert_on_simplex(grid)
    assert corners_missing(grid) == []
    messages = [record.getMessage() for record in caplog.records]
    if asked == given:
        assert messages == []
    else:
        assert len(messages) == 1
        assert str(asked) in messages[0]
        assert str(given) in messages[0]


def test_seven_objectives_have_a_lattice_too():
    assert preference_grid(7, 100).shape == (210, 7)


def test_the_smallest_grids():
    np.testing.assert_array_equal(preference_grid(1, 100), [[1.0]])
    np.testing.assert_array_equal(preference_grid(2, 1), [[0.5, 0.5]])
    for bad in ((0, 5), (2, 0), (-1, 5)):
        with pytest.raises(ValueError, match=rf"n_objectives={bad[0]}, n_preferences={bad[1]}.*at least 1"):
            preference_grid(*bad)


@given(st.integers(1, 6), st.integers(1, 6))
def test_a_lattice_holds_every_multiple_once_in_lexicographic_order(d, divisions):
    grid = simplex_lattice(d, divisions)
    assert grid.shape == (comb(divisions + d - 1, d - 1), d)
    multiples = grid * divisions
    np.testing.assert_allclose(multiples, multiples.round(), atol=1e-9)
    rows = [tuple(row) for row in multiples.round().astype(int)]
    assert all(sum(row) == divisions and min(row) >= 0 for row in rows)
    assert rows == sorted(set(rows))


weights = st.integers(1, 6).flatmap(lambda d: st.lists(st.floats(1e-3, 1.0), min_size=d, max_size=d))


@given(weights)
def test_check_preference_keeps_what_is_on_the_simplex(x):
    exact = np.array(x) / np.sum(x)
    w = check_preference(exact, len(exact))
    assert w.dtype == np.float32
    np.testing.assert_allclose(w, exact, rtol=1e-6)
    np.testing.assert_array_equal(check_preference(w, len(w)), check_preference(w.tolist(), len(w)))
    batch = check_preference(np.stack([exact, exact[::-1]]), len(exact))
    np.testing.assert_array_equal(batch, [w, check_preference(exact[::-1], len(exact))])


@given(weights, st.floats(1e-4, 10) | st.floats(-0.9, -1e-4))
def test_check_preference_refuses_what_does_not_sum_to_one(x, excess):
    exact = np.array(x) / np.sum(x)
    with pytest.raises(ValueError, match="sums to"):
        check_preference(exact * (1 + excess), len(exact))


@given(weights.filter(lambda x: len(x) > 1), st.floats(1e-4, 10))
def test_check_preference_refuses_negative_weights(x, size):
    exact = np.array(x) / np.sum(x)
    exact[0] += exact[1] + size
    exact[1] = -size
    with pytest.raises(ValueError, match="negative weight"):
        check_preference(exact, len(exact))


@given(st.integers(0, 4), st.integers(1, 6), st.sampled_from([(), (1,), (2,), (1, 1)]))
def test_check_preference_refuses_every_other_shape(n, d, front):
    w = np.full((*front, n), 1 / max(n, 1))
    if w.ndim in (1, 2) and n == d:
        assert check_preference(w, d).shape == w.shape
    else:
        with pytest.raises(ValueError, match=rf"give {d} weights"):
            check_preference(w, d)


def test_check_preference_does_not_change_its_argument():
    w = np.array([-1e-7, 1.0])
    np.testing.assert_array_equal(check_preference(w, 2), [0, 1])
    np.testing.assert_array_equal(w, [-1e-7, 1.0])
