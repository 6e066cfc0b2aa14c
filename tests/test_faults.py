"""What can go wrong with environments, preferences and files, one row of the table of faults after the other.

Every error must name the culprit, the value and the cure, and come before anything is stored.
"""

import base64
import errno
import io
import json
import logging
import os
import pickle
import re
import subprocess
import threading
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import SAC
from stable_baselines3.common.logger import CSVOutputFormat, KVWriter, Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize

from sb3_momba import MOMBA, PreferenceWrapper, evaluate_front, files, make_mo_vec_env
from sb3_momba.envs.preferences import PerStepSampler, UniformSampler, check_preference
from sb3_momba.files import FileFormatError, read_tree
from sb3_momba.finite import all_finite
from sb3_momba.nn.descent import NonFiniteLossError
from sb3_momba.saving import PickleFreeSaving
from tests.stubs import StubEnv, assert_same_tree, observation_of, reward_of, tiny_model

ANY_ACTION = np.zeros(2, dtype=np.float32)
VEC_ENVS = [(DummyVecEnv, None), (SubprocVecEnv, {"start_method": "fork"})]


def assert_fails_after(env: Any, n_stored: int, match: str) -> None:
    """Training stops with an error that matches; buffer and statistics hold exactly the `n_stored` good transitions."""
    model = tiny_model(env)
    with pytest.raises(ValueError, match=match):
        model.learn(50)
    buffer, policy = model.replay_buffer, model.policy
    assert buffer.pos == n_stored
    assert int(policy.statistics.count) == n_stored * buffer.n_envs
    assert not buffer.rewards[n_stored:].any()
    returns = np.zeros(buffer.rewards.shape[1:])
    largest = 0.0
    for rewards in buffer.rewards[:n_stored]:
        returns = model.gamma * returns + rewards
        largest = max(largest, float(np.abs(returns).max()))
    assert float(policy.return_scale.max_return) == pytest.approx(largest)
    assert bool(th.isfinite(policy.statistics.mean).all())


# ------------------------------------------------------------------------------------------------- 1 to 8: numbers


def test_row_01_a_scalar_reward_without_reward_space_trains_as_one_objective_and_says_so_once(caplog):
    with caplog.at_level(logging.WARNING, logger="sb3_momba"):
        model = tiny_model("Pendulum-v1", learning_starts=5).learn(20)
    assert [record.message for record in caplog.records if "one objective" in record.message] == [
        "The environment has one objective: MOMBA trains it as single-objective SAC, with SimbaPolicy."
    ]
    assert model.n_objectives == 1
    assert model.observation_space.shape == (3,)
    assert model.predict(np.zeros(3, dtype=np.float32))[0].shape == (1,)
    assert model._n_updates == 15


def test_row_01_a_vector_reward_without_reward_space_is_an_error_that_says_how_to_declare_it():
    env = StubEnv(n_objectives=None, rewards={3: np.array([1.0, 2.0])})
    assert_fails_after(
        env, 2, r"StubEnv .*step 3.*array\(\[1\., 2\.\]\).*shape \(2,\).*self\.reward_space = gymnasium\.spaces\.Box"
    )


def test_row_02_a_reward_of_the_wrong_length_names_the_environment_and_both_shapes():
    broken = partial(StubEnv, rewards={7: np.ones(3)})
    venv = DummyVecEnv([partial(lambda make: Monitor(PreferenceWrapper(make())), make) for make in (StubEnv, broken)])
    assert_fails_after(venv, 6, r"environment 1, step 7 .*shape \(3,\) where \(2,\).*one number per objective")


def test_row_03_a_reward_of_one_number_is_never_broadcast_to_two_objectives():
    assert_fails_after(StubEnv(rewards={4: np.ones(1)}), 3, r"environment 0, step 4 .*shape \(1,\) where \(2,\)")


@pytest.mark.parametrize(
    "cast",
    [list, tuple, lambda r: r.astype(np.float64), lambda r: r.astype(np.int64), lambda r: [int(x) for x in r]],
    ids=["list", "tuple", "float64", "int64", "ints"],
)
def test_row_04_any_vector_of_numbers_is_cast_to_float32_once(cast):
    model = tiny_model(StubEnv(cast=cast)).learn(12)
    assert model.replay_buffer.rewards.dtype == np.float32
    np.testing.assert_array_equal(model.replay_buffer.rewards[:12, 0], [reward_of(t, 2) for t in range(1, 13)])


@pytest.mark.parametrize("number", [5, 5.0, np.float64(5), np.array(5.0), np.int32(5)], ids=lambda x: type(x).__name__)
def test_row_04_any_number_is_the_reward_of_one_undeclared_objective(number):
    model = tiny_model(StubEnv(n_objectives=None, rewards={2: number})).learn(3)
    np.testing.assert_array_equal(model.replay_buffer.rewards[:3, 0, 0], [1, 5, 3])


@pytest.mark.parametrize(
    "reward", [1.5, np.float32(1.5), np.array(1.5), "reward", "1.5", ["1", "2"], None], ids=lambda x: repr(x).replace(" ", "")
)
def test_row_05_a_number_or_a_string_where_a_vector_is_declared_is_an_error(reward):
    assert_fails_after(StubEnv(rewards={2: reward}), 1, r"environment 0, step 2 .*reward")


def test_row_05_a_string_where_a_number_is_expected_is_an_error():
    assert_fails_after(StubEnv(n_objectives=None, rewards={2: "1.5"}), 1, r"step 2 .*reward '1\.5' is not")


def test_row_06_a_nan_reward_names_step_and_objective_before_it_is_stored():
    env = StubEnv(rewards={7: np.array([1.0, np.nan])})
    assert_fails_after(env, 6, r"step 7 .*objective 1 is nan.*must be finite")


@pytest.mark.parametrize("number", [np.inf, -np.inf, 1e30, -1e30])
def test_row_07_an_infinite_or_absurdly_large_reward_leaves_the_statistics_untouched(number):
    env = StubEnv(rewards={5: [number, 1.0]})
    assert_fails_after(env, 4, rf"step 5 .*objective 0 is {str(number).replace('+', '.')}.*finite and at most")


@pytest.mark.parametrize("number", [np.inf, 1e30])
def test_row_07_holds_for_a_scalar_vec_env_without_preference_wrapper(number):
    venv = DummyVecEnv([lambda: Monitor(StubEnv(n_objectives=None, rewards={5: number}))])
    assert_fails_after(venv, 4, "reward")


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_row_08_an_observation_that_is_not_finite_is_an_error_before_it_is_stored(number):
    env = StubEnv(observations={6: np.array([0.0, number, 0.0], dtype=np.float32)})
    assert_fails_after(env, 5, rf"StubEnv .*step 6 .*observation .*not finite.*{number}.*Mend the environment")


def test_row_08_a_first_observation_that_is_not_finite_is_an_error():
    env = StubEnv(observations={0: np.full(3, np.nan, dtype=np.float32)})
    assert_fails_after(env, 0, r"StubEnv .*step 0 .*observation .*not finite")


@pytest.mark.parametrize(("step", "n_stored"), [(6, 5), (0, 0)], ids=["step", "reset"])
def test_row_08_holds_for_a_scalar_vec_env_without_preference_wrapper(step, n_stored):
    observations = {step: np.full(3, np.nan, dtype=np.float32)}
    venv = DummyVecEnv([lambda: Monitor(StubEnv(n_objectives=None, observations=observations))])
    assert_fails_after(venv, n_stored, "observation")


def test_row_08_predict_never_answers_a_nan_observation_with_a_nan_action():
    model = tiny_model(StubEnv())
    with pytest.raises(ValueError, match=r"observation.*finite"):
        model.predict(np.array([0.0, np.nan, 0.0]), preference=[0.5, 0.5])


@pytest.mark.parametrize("number", [0.0, 1e30, -3e38, np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("shape", [(3,), (2, 3)])
def test_row_08_a_number_is_finite_even_where_its_square_is_not(number, shape):
    x = np.ones(shape, dtype=np.float32)
    x[..., 1] = number
    assert all_finite(x) == np.isfinite(number)


# ------------------------------------------------------------------------- 9 to 12: arrays, wrappers, vectorisation


def learn_from_reused_arrays(vec_env_cls: type, vec_env_kwargs: dict[str, Any] | None) -> MOMBA:
    """Eight steps of two environments with episodes of three, which overwrite their arrays at every step and reset."""
    env = StubEnv(reuse_arrays=True)
    first = env.reset()[0]
    observation, reward = env.step(ANY_ACTION)[:2]
    assert observation is first
    assert env.step(ANY_ACTION)[1] is reward
    make = partial(StubEnv, episode_length=3, reuse_arrays=True)
    venv = make_mo_vec_env(make, n_envs=2, vec_env_cls=vec_env_cls, vec_env_kwargs=vec_env_kwargs)
    model = tiny_model(venv).learn(16)
    venv.close()
    return model


@pytest.mark.parametrize(("vec_env_cls", "vec_env_kwargs"), VEC_ENVS)
def test_row_09_a_reused_reward_array_is_stored_with_its_true_values_on_terminal_steps_too(vec_env_cls, vec_env_kwargs):
    buffer = learn_from_reused_arrays(vec_env_cls, vec_env_kwargs).replay_buffer
    expected = np.array([[reward_of(t, 2)] * 2 for t in range(1, 9)])
    np.testing.assert_array_equal(buffer.rewards[:8], expected)
    np.testing.assert_array_equal(buffer.dones[:8, 0], [0, 0, 1, 0, 0, 1, 0, 0])


@pytest.mark.parametrize(("vec_env_cls", "vec_env_kwargs"), VEC_ENVS)
def test_row_10_a_reused_observation_array_is_stored_with_its_true_values_on_terminal_steps_too(vec_env_cls, vec_env_kwargs):
    buffer = learn_from_reused_arrays(vec_env_cls, vec_env_kwargs).replay_buffer
    for t in range(8):
        expected = observation_of(t, start_of_episode=t in (0, 3, 6))
        np.testing.assert_array_equal(buffer.observations[t], [expected] * 2)
        np.testing.assert_array_equal(buffer.next_observations[t], [observation_of(t + 1)] * 2)


class DropInfo(gym.Wrapper):
    """A wrapper that returns an info of its own."""

    def step(self, action):
        return *self.env.step(action)[:4], {}


def test_row_11_a_wrapper_that_strips_info_is_an_error_that_names_the_order_of_wrappers():
    order = r"Monitor\(PreferenceWrapper\(YourWrapper\(env\)\)\)"
    assert_fails_after(DropInfo(PreferenceWrapper(StubEnv())), 0, rf"Environment 0.*no 'vector_reward'.*{order}")
    makers = [lambda: Monitor(PreferenceWrapper(StubEnv())), lambda: Monitor(DropInfo(PreferenceWrapper(StubEnv())))]
    assert_fails_after(DummyVecEnv(makers), 0, rf"Environment 1.*no 'vector_reward'.*{order}")


def test_row_11_the_order_that_the_error_names_works():
    model = tiny_model(Monitor(PreferenceWrapper(DropInfo(StubEnv())))).learn(5)
    np.testing.assert_array_equal(model.replay_buffer.rewards[:5, 0], [reward_of(t, 2) for t in range(1, 6)])


@pytest.mark.parametrize(
    "change",
    [lambda observation: np.append(observation, np.float32(7)), lambda observation: observation / 2],
    ids=["one wider", "of the same width"],
)
def test_row_11_a_wrapper_that_changes_the_preference_outside_preference_wrapper_is_an_error(change):
    wrapped = PreferenceWrapper(StubEnv())
    space = spaces.Box(-np.inf, np.inf, change(np.zeros(5)).shape, np.float32)
    with pytest.raises(ValueError, match=r"outside.* PreferenceWrapper|PreferenceWrapper\(YourWrapper\(env\)\)"):
        tiny_model(gym.wrappers.TransformObservation(wrapped, change, space)).learn(5)


@pytest.mark.parametrize("n_objectives", [None, 2])
def test_row_11_a_wrapper_that_changes_the_reward_outside_preference_wrapper_is_an_error(n_objectives):
    env = gym.wrappers.TransformReward(PreferenceWrapper(StubEnv(n_objectives)), lambda reward: 2 * reward)
    with pytest.raises(ValueError, match=r"outside.* PreferenceWrapper|PreferenceWrapper\(YourWrapper\(env\)\)"):
        tiny_model(env).learn(5)


def test_row_12_environments_with_different_numbers_of_objectives_are_an_error_at_construction():
    def make(n_objectives: int) -> Callable[[], gym.Env]:
        return lambda: Monitor(PreferenceWrapper(StubEnv(n_objectives, observation_dim=5 - n_objectives)))

    with pytest.raises(ValueError, match=r"differ in their numbers of objectives: \[2, 3\]"):
        tiny_model(DummyVecEnv([make(2), make(3)]))


def test_row_12_environments_with_and_without_preference_wrapper_are_an_error_at_construction():
    makers = [lambda: Monitor(PreferenceWrapper(StubEnv())), lambda: Monitor(StubEnv(n_objectives=None, observation_dim=5))]
    for order in (makers, makers[::-1]):
        with pytest.raises(ValueError, match=r"without PreferenceWrapper.*make_mo_vec_env"):
            tiny_model(DummyVecEnv(order))


# --------------------------------------------------------------------------------------------- 13 to 15: preferences

BAD_PREFERENCES = [
    ([-0.1, 1.1], r"\[-0\.1, 1\.1\] has a negative weight"),
    ([0.5, 0.6], r"\[0\.5, 0\.6\] sums to 1\.1, not to 1: divide"),
    ([0.0, 0.0], r"sums to 0\.0, not to 1"),
    ([np.nan, 1.0], r"nan.* not finite"),
    ([np.inf, 0.0], r"inf.* not finite"),
    ([1.0], r"shape \(1,\): give 2 weights"),
    ([0.2, 0.3, 0.5], r"shape \(3,\): give 2 weights"),
    (0.5, r"shape \(\): give 2 weights"),
    ("half", r"'half' is not an array of 2 numbers"),
]


@pytest.mark.parametrize(("preference", "match"), BAD_PREFERENCES)
def test_row_13_a_bad_preference_is_an_error_wherever_it_is_given(preference, match):
    env = PreferenceWrapper(StubEnv())
    env.reset(options={"preference": [0.25, 0.75]})
    with pytest.raises(ValueError, match=match):
        env.set_preference(preference)
    with pytest.raises(ValueError, match=match):
        env.reset(options={"preference": preference})
    np.testing.assert_array_equal(env.step(ANY_ACTION)[0][3:], np.float32([0.25, 0.75]))
    assert env.unwrapped.n_episodes == 1
    model = tiny_model(StubEnv())
    with pytest.raises(ValueError, match=match):
        model.predict(np.zeros(3), preference=preference)


def test_row_13_one_bad_preference_in_a_batch_is_an_error():
    model = tiny_model(StubEnv())
    with pytest.raises(ValueError, match="negative weight"):
        model.predict(np.zeros((2, 3)), preference=[[0.5, 0.5], [-0.5, 1.5]])


@given(
    st.lists(st.floats(0, 1, width=32), min_size=1, max_size=6).filter(lambda x: sum(x) > 0.01),
    st.lists(st.floats(-1e-7, 1e-7), min_size=6, max_size=6),
)
def test_row_14_a_preference_off_the_simplex_by_1e7_is_renormalised(weights, errors):
    exact = np.array(weights) / np.sum(weights)
    w = check_preference(exact + errors[: len(exact)], len(exact))
    assert w.dtype == np.float32
    assert (w >= 0).all()
    assert w.sum(dtype=np.float64) == pytest.approx(1, abs=3e-7)
    np.testing.assert_allclose(w, exact, atol=1e-6)


def test_row_15_with_a_preference_per_step_every_transition_keeps_its_own():
    reported = []
    model = tiny_model(StubEnv(episode_length=7), preference_sampler=PerStepSampler(UniformSampler(2)))
    model.learn(40, callback=lambda local, _: reported.append(local["infos"][0]["preference"]) is None)
    stored = model.replay_buffer.preferences[:40, 0]
    np.testing.assert_array_equal(stored, reported)
    assert len(np.unique(stored, axis=0)) == 40
    batch = model.replay_buffer.sample(200)
    np.testing.assert_array_equal(batch.observations[:, 3:], batch.preferences)
    np.testing.assert_array_equal(batch.next_observations[:, 3:], batch.preferences)
    steps = batch.observations[:, 0].long()
    np.testing.assert_array_equal(batch.preferences, stored[steps])


def test_row_15_a_preference_set_in_mid_episode_counts_from_the_next_observation():
    model = tiny_model(StubEnv())

    def change_after_fifth_step(local: dict[str, Any], _: Any) -> bool:
        if local["self"].num_timesteps == 5:
            local["env"].env_method("set_preference", [1.0, 0.0])
        return True

    model.learn(9, callback=change_after_fifth_step)
    stored = model.replay_buffer.preferences[:9, 0]
    first = stored[0]
    assert 0 < first[0] < 1
    # The sixth action has seen the observation of the fifth step, made before the change.
    np.testing.assert_array_equal(stored[:6], [first] * 6)
    np.testing.assert_array_equal(stored[6:], [[1, 0]] * 3)


# --------------------------------------------------------------------------------------------------- 16 to 19: spaces


def assert_refused(make: Callable[[], gym.Env], match: str) -> None:
    """As an environment and as a VecEnv, at construction."""
    for give in (make, lambda: DummyVecEnv([make])):
        with pytest.raises(ValueError, match=match):
            tiny_model(give())


@pytest.mark.parametrize("space", [spaces.Discrete(3), spaces.MultiDiscrete([2, 2]), spaces.MultiBinary(2)], ids=str)
def test_row_16_discrete_actions_are_an_error(space):
    assert_refused(lambda: StubEnv(action_space=space), r"action space (Multi)?(Discrete|Binary).*continuous actions, a Box")


def test_row_16_cartpole_is_an_error():
    assert_refused(lambda: gym.make("CartPole-v1"), r"Discrete\(2\).*continuous actions")


@pytest.mark.parametrize(("low", "high"), [(-np.inf, np.inf), (0.0, np.inf), (-np.inf, 0.0)])
def test_row_17_unbounded_actions_are_an_error(low, high):
    make = partial(StubEnv, action_space=spaces.Box(low, high, (2,), np.float32))
    assert_refused(make, r"action space Box\(.*inf.*no finite bounds.*ActionWrapper")


def test_row_18_a_constant_action_dimension_is_an_error_that_names_it():
    box = spaces.Box(np.float32([-1, 1, -1]), np.float32([1, 1, 1]))
    assert_refused(partial(StubEnv, action_space=box), r"low >= high in dimension 1.*ActionWrapper")


@pytest.mark.parametrize("shape", [(), (2, 3)], ids=str)
def test_row_18_actions_that_are_not_a_vector_are_an_error(shape):
    assert_refused(partial(StubEnv, action_space=spaces.Box(-1, 1, shape)), rf"action space .*{re.escape(str(shape))}")


OBSERVATION_SPACES = [
    spaces.Dict({"position": spaces.Box(-1, 1, (3,))}),
    spaces.Box(0, 255, (36, 36, 3), np.uint8),
    spaces.Box(-1, 1, (2, 2)),
    spaces.Box(-1, 1, ()),
    spaces.Discrete(5),
]


@pytest.mark.parametrize("space", OBSERVATION_SPACES, ids=lambda space: f"{type(space).__name__}{space.shape}")
def test_row_19_observations_that_are_not_a_vector_are_an_error_that_says_what_to_flatten_with(space):
    assert_refused(partial(StubEnv, observation_space=space), r"observation space .*flatten it with .*FlattenObservation")


# --------------------------------------------------------------------------------------------- 20 and 21: episodes


@pytest.mark.parametrize(("ending", "bootstraps"), [("truncated", 1), ("terminated", 0), ("both", 0)])
def test_row_20_only_a_truncated_episode_bootstraps_from_its_last_state(ending, bootstraps, monkeypatch):
    model = tiny_model(
        StubEnv(episode_length=3, ending=ending),
        learning_starts=100,
        gamma=0.5,
        critic_loss="mse",
        vector_values=True,
        best_return_scale=None,
        ent_coef=0.0,
    ).learn(9)
    with th.no_grad():
        for name, parameter in model.critic_target.named_parameters():
            parameter.zero_()
            if name == "head.bias":
                parameter += 8.0
    targets = []
    bootstrap = model.policy.value.bootstrap
    monkeypatch.setattr(model.policy.value, "bootstrap", lambda *a, **k: targets.append(bootstrap(*a, **k)) or targets[-1])
    batch = model.replay_buffer.sample(100)
    monkeypatch.setattr(model.replay_buffer, "sample", lambda _: batch)
    model.train(gradient_steps=1, batch_size=100)
    steps = batch.next_observations[:, 0].long()
    assert set(steps.tolist()) == set(range(1, 10))
    continues = np.where(steps % 3 == 0, bootstraps, 1)[:, None]
    expected = np.stack([reward_of(int(t), 2) for t in steps]) + 0.5 * 8.0 * continues
    for critic in range(2):
        np.testing.assert_allclose(targets[0][:, critic, :, 0], expected, rtol=1e-6)


@pytest.mark.parametrize("ending", ["truncated", "terminated"])
def test_row_21_episodes_of_one_step_train(ending):
    model = tiny_model(make_mo_vec_env(partial(StubEnv, episode_length=1, ending=ending), n_envs=2)).learn(60)
    buffer = model.replay_buffer
    assert model._n_updates == 20
    assert buffer.dones[:30].all()
    assert (buffer.timeouts[:30] == (ending == "truncated")).all()
    for t in range(30):
        np.testing.assert_array_equal(buffer.observations[t, 0], observation_of(t, start_of_episode=True))
        np.testing.assert_array_equal(buffer.next_observations[t, 0], observation_of(t + 1))
    # Without a second step, no return is larger than a reward.
    assert float(model.policy.return_scale.max_return) == 300


# ---------------------------------------------------------------------------------------------- 28, 31 and 35: files


@pytest.fixture
def saved(tmp_path) -> tuple[MOMBA, Path, bytes]:
    """A model, the file it is saved in, and that file's content."""
    model = tiny_model(StubEnv())
    model.save(tmp_path / "model.zip")
    return model, tmp_path / "model.zip", (tmp_path / "model.zip").read_bytes()


@pytest.mark.parametrize(
    ("attribute", "place"),
    [
        (threading.Lock(), "note is a lock"),
        ({"a": [1, {"b": threading.Lock()}]}, r"note\.a\.1\.b is a lock"),
        (np.array([None]), r"note .*dtype object"),
        (b"bytes", "note is a bytes"),
    ],
)
def test_row_28_an_attribute_that_cannot_be_saved_is_named_and_the_old_file_is_intact(saved, attribute, place):
    model, path, content = saved
    model.note = attribute
    with pytest.raises(TypeError, match=rf"data\.{place}"):
        model.save(path)
    assert path.read_bytes() == content
    assert os.listdir(path.parent) == ["model.zip"]
    model.save(path, exclude=["note"])
    assert not hasattr(MOMBA.load(path), "note")


def test_row_31_a_directory_as_target_is_an_error(saved):
    model, path, _ = saved
    target = path.with_name("runs.d")
    target.mkdir()
    for save in (model.save, model.save_replay_buffer):
        with pytest.raises(IsADirectoryError, match=r"runs\.d.* is a directory: give the name of a file"):
            save(target)
    assert os.listdir(target) == []


def test_row_31_a_read_only_target_is_an_error_and_stays_as_it_was(saved, monkeypatch):
    model, path, content = saved
    path.chmod(0o444)
    if os.geteuid() == 0:  # root may write to any file: ask for the permission bits themselves
        monkeypatch.setattr(os, "access", lambda path, mode: bool(os.stat(path).st_mode & 0o222))
    for save in (model.save, model.save_replay_buffer):
        with pytest.raises(PermissionError, match=r"model\.zip is read-only: choose another name, or make it writable"):
            save(path)
    assert path.read_bytes() == content
    assert os.listdir(path.parent) == ["model.zip"]


def test_row_31_an_impossible_target_is_an_error_that_names_it_as_the_caller_did(saved):
    model, path, content = saved
    with pytest.raises(OSError, match=r"model\.zip"):
        model.save(path / "below_a_file.zip")
    assert path.read_bytes() == content
    long_name = path.with_name("x" * 252 + ".zip")
    with pytest.raises(OSError, match="x" * 252) as error:
        model.save(long_name)
    assert ".part" not in str(error.value)


def test_row_31_a_read_only_directory_is_an_error_that_names_the_target_as_the_caller_did(saved, monkeypatch):
    model, path, content = saved

    def refuse(name: os.PathLike[str], mode: str) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(name))

    monkeypatch.setattr(files, "open", refuse, raising=False)
    with pytest.raises(PermissionError, match=r"model\.zip") as error:
        model.save(path)
    assert ".part" not in str(error.value)
    assert path.read_bytes() == content


class Exploit:
    """Its pickle runs a command wherever it is loaded."""

    def __init__(self, canary: Path):
        self.canary = canary

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return subprocess.call, (["touch", str(self.canary)],)


@pytest.fixture
def exploit(tmp_path) -> Exploit:
    exploit = Exploit(tmp_path / "canary")
    pickle.loads(pickle.dumps(exploit))
    assert exploit.canary.exists()
    exploit.canary.unlink()
    return exploit


def saved_files() -> dict[str, bytes]:
    model = tiny_model(StubEnv(), preference_sampler=UniformSampler(2)).learn(25)
    model_file, buffer_file = io.BytesIO(), io.BytesIO()
    model.save(model_file)
    model.save_replay_buffer(buffer_file)
    return {"model": model_file.getvalue(), "buffer": buffer_file.getvalue()}


def load_in_every_way(content: bytes, model: MOMBA) -> Iterator[Callable[[], Any]]:
    for load in (MOMBA.load, model.set_parameters, model.load_replay_buffer):
        yield partial(load, io.BytesIO(content))


def archive_with(content: bytes, members: dict[str, bytes]) -> bytes:
    """A zip archive with some members replaced or added."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        old = {name: archive.read(name) for name in archive.namelist()}
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, member in {**old, **members}.items():
            archive.writestr(name, member)
    return file.getvalue()


def pickled_array(payload: Any) -> bytes:
    file = io.BytesIO()
    np.save(file, np.array([payload], dtype=object), allow_pickle=True)
    return file.getvalue()


def torch_file(payload: Any) -> bytes:
    file = io.BytesIO()
    th.save(payload, file)
    return file.getvalue()


@pytest.mark.parametrize("kind", ["model", "buffer"])
def test_row_35_a_pickle_in_place_of_the_file_or_of_any_member_is_refused(kind, exploit):
    content = saved_files()[kind]
    payloads = [pickle.dumps(exploit), pickled_array(exploit), torch_file(exploit)]
    attacks = {f"whole file {i}": payload for i, payload in enumerate(payloads)}
    names = zipfile.ZipFile(io.BytesIO(content)).namelist()
    assert len(names) > 7
    model = tiny_model(StubEnv())
    for name in names:
        attacks |= {f"{name} {i}": archive_with(content, {name: payload}) for i, payload in enumerate(payloads)}
    for attack, malicious in attacks.items():
        for load in load_in_every_way(malicious, model):
            with pytest.raises(FileFormatError):
                load()
            assert not exploit.canary.exists(), attack


@pytest.mark.parametrize("kind", ["model", "buffer"])
def test_row_35_members_that_other_libraries_would_unpickle_are_never_read(kind, exploit):
    sb3_data = json.dumps(
        {"policy_class": {":type:": "x", ":serialized:": base64.b64encode(cloudpickle.dumps(exploit)).decode()}}
    ).encode()
    extra = {"data": sb3_data, "data.pkl": pickle.dumps(exploit), "policy.pth": torch_file(exploit)}
    extra |= {"pytorch_variables.pth": torch_file(exploit), "extra.npy": pickled_array(exploit)}
    content = saved_files()[kind]
    assert_same_tree(read_tree(io.BytesIO(archive_with(content, extra)))[0], read_tree(io.BytesIO(content))[0])
    model = tiny_model(StubEnv())
    if kind == "model":
        MOMBA.load(io.BytesIO(archive_with(content, extra)))
        model.set_parameters(io.BytesIO(archive_with(content, extra)))
    else:
        model.load_replay_buffer(io.BytesIO(archive_with(content, extra)))
    assert not exploit.canary.exists()


DANGEROUS_NAMES = [
    "os.system",
    "posix.system",
    "builtins.eval",
    "builtins.exec",
    "subprocess.Popen",
    "torch.hub.load",
    "torch.load",
    "torch.os.system",
    "torch.serialization.load",
    "torch.utils.cpp_extension.load",
    "numpy.load",
    "stable_baselines3.common.save_util.load_from_pkl",
    "stable_baselines3.common.vec_env.subproc_vec_env.SubprocVecEnv",
    "stable_baselines3.common.vec_env.base_vec_env.CloudpickleWrapper",
    "sb3_momba.files.os.system",
    "sb3_momba.files._Decoder",
    "",
    ".",
]


def every_dict(x: Any) -> Iterator[dict[str, Any]]:
    if isinstance(x, dict):
        yield x
    for item in x.values() if isinstance(x, dict) else x if isinstance(x, list) else ():
        yield from every_dict(item)


def with_tree(content: bytes, change: Callable[[dict[str, Any]], None]) -> bytes:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        tree = json.loads(archive.read("tree.json"))
    change(tree)
    return archive_with(content, {"tree.json": json.dumps(tree).encode()})


@pytest.mark.parametrize("name", DANGEROUS_NAMES)
def test_row_35_a_class_slot_names_nothing_but_modules_optimisers_and_buffers(name, exploit):
    command = f"touch {exploit.canary}"
    forms = [
        {"~": "class", "name": name},
        {"~": "object", "class": name, "state": command},
        {"~": "object", "class": name, "state": [command]},
        {"~": name, "state": command},
    ]
    content, model = saved_files()["model"], tiny_model(StubEnv())
    for form in forms:
        for slot in ("policy_class", "learning_rate", "preference_sampler", "replay_buffer_class", "observation_space"):
            malicious = with_tree(content, lambda tree, form=form, slot=slot: tree["tree"]["data"].update({slot: form}))
            for load in load_in_every_way(malicious, model):
                with pytest.raises(FileFormatError, match=r"class|unknown kind"):
                    load()
                assert not exploit.canary.exists()


def test_row_35_registered_objects_never_run_what_their_state_says(exploit):
    command = f"__import__('os').system('touch {exploit.canary}')"
    content = saved_files()["model"]

    def poison(tree: dict[str, Any]) -> None:
        for x in list(every_dict(tree["tree"])):
            if x.get("~") == "object":
                x["state"] = command if isinstance(x["state"], str) else dict.fromkeys(x["state"], command)

    with pytest.raises(FileFormatError):
        MOMBA.load(io.BytesIO(with_tree(content, poison)))
    assert not exploit.canary.exists()


@pytest.mark.parametrize(
    ("slot", "name"),
    [
        ("policy_class", "torch.nn.modules.linear.Linear"),
        ("policy_class", "stable_baselines3.sac.policies.SACPolicy"),
        ("policy_class", "torch.optim.adam.Adam"),
        ("replay_buffer_class", "stable_baselines3.common.buffers.ReplayBuffer"),
        ("learning_rate", "torch.nn.modules.linear.Identity"),
    ],
)
def test_row_35_a_harmless_class_in_the_wrong_slot_is_refused(slot, name):
    def swap(tree: dict[str, Any]) -> None:
        tree["tree"]["data"][slot] = {"~": "class", "name": name}

    with pytest.raises(ValueError, match=slot):
        MOMBA.load(io.BytesIO(with_tree(saved_files()["model"], swap)))


@pytest.mark.parametrize("removed", ["data", "params", "tensors"])
def test_row_35_a_model_file_without_one_of_its_parts_is_refused(removed):
    content = with_tree(saved_files()["model"], lambda tree: tree["tree"].pop(removed))
    with pytest.raises(ValueError, match=removed):
        MOMBA.load(io.BytesIO(content))


def test_row_35_a_pickled_zip_of_stable_baselines3_is_refused_with_the_cure(tmp_path):
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, device="cpu").save(tmp_path / "sac.zip")
    model = tiny_model(StubEnv())
    for load in (MOMBA.load, model.set_parameters):
        with pytest.raises(FileFormatError, match=r"sac\.zip.*trust=True"):
            load(tmp_path / "sac.zip")


def test_row_35_a_pickled_replay_buffer_of_stable_baselines3_is_refused(tmp_path, exploit):
    with open(tmp_path / "buffer.pkl", "wb") as file:
        pickle.dump([tiny_model(StubEnv()).replay_buffer, exploit], file)
    with pytest.raises(FileFormatError, match=r"buffer\.pkl"):
        tiny_model(StubEnv()).load_replay_buffer(tmp_path / "buffer.pkl")
    assert not exploit.canary.exists()


def test_a_pickled_zip_of_stable_baselines3_loads_with_trust(tmp_path):
    model = tiny_model(StubEnv()).learn(30)
    super(PickleFreeSaving, model).save(tmp_path / "pickled.zip")
    with pytest.raises(FileFormatError):
        MOMBA.load(tmp_path / "pickled.zip")
    trusted = MOMBA.load(tmp_path / "pickled.zip", trust=True, device="cpu")
    assert_same_tree(trusted.get_parameters(), model.get_parameters())
    assert trusted.n_objectives == 2


# ------------------------------------------------------------------------------------------ 22 to 27: settings, divergence


def test_row_22_three_environments_and_as_many_updates_as_steps():
    env = make_mo_vec_env(StubEnv, 3)
    model = tiny_model(env, learning_starts=6, gradient_steps=-1).learn(30)
    assert model._n_updates == 24  # 30 steps, of which 6 only fill the buffer


def test_row_23_episodes_as_train_freq_need_one_environment():
    with pytest.raises(ValueError, match=r"train_freq=1 episodes with n_envs=2.*use one environment"):
        tiny_model(make_mo_vec_env(StubEnv, 2), train_freq=(1, "episode"))


def test_row_24_a_buffer_smaller_than_a_batch_and_no_learning_starts():
    model = tiny_model(StubEnv(), buffer_size=5, batch_size=16, learning_starts=0).learn(20)
    assert model._n_updates == 20
    assert all(th.isfinite(p).all() for p in model.policy.parameters())


def test_row_25_a_buffer_larger_than_memory_is_an_error_in_gb(monkeypatch):
    class Memory:
        available = 1e9

    monkeypatch.setattr("psutil.virtual_memory", lambda: Memory)
    # 3 + 3 observations, 2 actions, 2 rewards, 2 preferences, 2 flags: 14 numbers of 4 bytes.
    model = tiny_model(StubEnv(), buffer_size=100_000_000)  # untouched pages cost nothing: it may be there to predict
    with pytest.raises(MemoryError, match=r"=100,000,000 .*5\.6 GB; 1\.0 GB are free: choose buffer_size=14,285,714"):
        model.learn(1)
    assert model.num_timesteps == 0


def test_whole_numbers_as_actions_are_refused():
    with pytest.raises(ValueError, match=r"dtype int32.*Declare a float32 Box"):
        tiny_model(StubEnv(action_space=spaces.Box(0, 10, (3,), np.int32)))


def test_an_evaluation_does_not_take_frames_stacked_outside():
    venv = VecFrameStack(DummyVecEnv([lambda: Monitor(StubEnv(None))]), 3)
    with pytest.raises(ValueError, match=r"VecFrameStack does not see .* stack frames inside it"):
        evaluate_front(tiny_model(venv), venv)


@pytest.mark.parametrize("wrapper", [VecNormalize, lambda venv: VecFrameStack(venv, 2)])
def test_row_26_wrappers_that_change_observations_or_the_scalar_reward_are_refused(wrapper):
    with pytest.raises(ValueError, match=r"leave it out|put it inside"):
        tiny_model(wrapper(make_mo_vec_env(StubEnv, 1)))


def test_row_27_a_diverging_loss_is_skipped_and_then_an_error(caplog):
    model = tiny_model(StubEnv()).learn(30)
    good = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    original = model._critic_loss
    model._critic_loss = with_losses(original, [float("nan"), float("inf")])
    updates = model._n_updates
    model.train(3, 8)
    assert model._n_updates == updates + 1
    assert caplog.text.count("is skipped") == 2
    model.policy.load_state_dict(good)
    model._critic_loss = with_losses(original, [float("nan")] * 100)
    with pytest.raises(NonFiniteLossError, match=r"20 updates in a row.*Lower learning_rate"):
        model.train(100, 8)
    assert all(th.equal(good[name], tensor) for name, tensor in model.policy.state_dict().items())


def with_losses(original, losses):
    """A critic loss that is first what it is told to be, then itself."""
    waiting = list(losses)

    def loss_of(batch, alpha):
        loss, metrics = original(batch, alpha)
        return (loss * waiting.pop(0) if waiting else loss), metrics

    return loss_of


def test_row_27_a_gradient_that_is_not_a_number_is_skipped_too(caplog):
    model = tiny_model(StubEnv()).learn(30)
    good = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    original = model._critic_loss

    def steep_loss(batch, alpha):
        loss, metrics = original(batch, alpha)
        zero = sum(parameter.sum() for parameter in model.critic.parameters()) * 0
        return loss + zero.sqrt(), metrics  # finite, but not its slope

    model._critic_loss = steep_loss
    model.train(1, 8)
    assert "the norm of the critic's gradient is nan" in caplog.text
    assert all(th.equal(good[name], tensor) for name, tensor in model.policy.state_dict().items())


def test_row_27_an_absurd_learning_rate_ends_in_finite_parameters_or_an_error():
    model = tiny_model(StubEnv(), policy="MlpPolicy", critic_loss="mse", learning_rate=1e6)
    try:
        model.learn(200)
    except NonFiniteLossError as error:
        assert "diverges" in str(error)  # noqa: PT017
    assert all(th.isfinite(p).all() for p in model.policy.parameters())


class FullDisk(KVWriter):
    def write(self, key_values, key_excluded, step=0):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_row_30_a_full_disk_in_the_logs_is_said_once(caplog, tmp_path):
    model = tiny_model(StubEnv())
    model.set_logger(Logger(None, [FullDisk(), CSVOutputFormat(str(tmp_path / "progress.csv"))]))
    model.learn(100, log_interval=1)
    assert model.num_timesteps == 100
    assert caplog.text.count("A log (FullDisk) cannot be written: [Errno 28] No space left on device") == 1
    assert len((tmp_path / "progress.csv").read_text().splitlines()) > 5
