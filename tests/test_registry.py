"""The ids that carry PreferenceWrapper, and evaluation environments made from the training environment."""

import subprocess
import sys
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_util import is_wrapped, make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_momba import MOMBA, ParetoEvalCallback, PreferenceWrapper, evaluate_front, make_mo_vec_env
from sb3_momba.envs.making import make_env
from sb3_momba.envs.registry import CONTINUOUS, NEEDED_ARGUMENTS, TASKS, copies_of, preference_id, raw_id
from sb3_momba.pareto.protocol import REFERENCE_POINTS, reference_point_of
from sb3_momba.records import Record
from tests.stubs import TINY_SIMBA, StubEnv

MO_GYMNASIUM = [name for name, spec in gym.registry.items() if str(spec.entry_point).startswith("mo_gymnasium")]
TINY = {"buffer_size": 200, "learning_starts": 20, "batch_size": 8, "policy_kwargs": TINY_SIMBA}


def is_accepted(env_id: str) -> bool:
    env = make_env(env_id, NEEDED_ARGUMENTS.get(env_id))
    try:
        PreferenceWrapper(env)
    except ValueError:
        return False
    finally:
        env.close()
    return True


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("env_id", [name for name in MO_GYMNASIUM if not name.startswith("momba/")])
def test_every_task_that_can_be_trained_on_has_an_id(env_id: str) -> None:
    try:
        accepted = is_accepted(env_id)
    except (ImportError, gym.error.DependencyNotInstalled) as error:
        pytest.skip(str(error))
    assert (env_id in CONTINUOUS) == accepted


@pytest.mark.parametrize("env_id", [*TASKS, "mo-hopper-2obj-v5", "water-reservoir-v0"])
def test_rewards_are_numbers_and_monitor_sees_them(env_id: str) -> None:
    env = make_vec_env(f"momba/{env_id}", seed=0)  # SB3's, with Monitor around it
    observation = env.reset()
    (raw,) = env.get_attr("raw_shape")
    (n_objectives,) = env.get_attr("n_objectives")
    assert observation.shape == (1, raw[0] + n_objectives)
    _, rewards, _, infos = env.step(np.array([env.action_space.sample()]))
    assert rewards[0] == pytest.approx(np.dot(infos[0]["preference"], infos[0]["vector_reward"]), abs=1e-5)


def test_both_kinds_of_ids_are_one_task() -> None:
    model = MOMBA("SimbaPolicy", "momba/MO-Swimmer-v4", seed=0, **TINY).learn(30)
    other = MOMBA("SimbaPolicy", "MO-Swimmer-v4", seed=0, **TINY).learn(30)
    fronts = [
        evaluate_front(one, env_id, n_preferences=2)
        for one, env_id in ((model, "MO-Swimmer-v4"), (other, "momba/MO-Swimmer-v4"))
    ]
    assert np.array_equal(fronts[0].returns, fronts[1].returns)


def test_reference_points_are_those_of_the_task(monkeypatch) -> None:
    monkeypatch.setitem(REFERENCE_POINTS, "MO-Ant-v4", (-7.0, 3.0))
    assert reference_point_of("momba/MO-Ant-v4", 2) == reference_point_of("MO-Ant-v4", 2) == (-7.0, 3.0)
    assert raw_id("momba/mo-ant-v5") == raw_id("mo-ant-v5") == "mo-ant-v5"


@pytest.mark.parametrize("env_id", ["MO-Ant-v4", "momba/MO-Ant-v4"])
def test_records_are_of_the_same_task(env_id: str) -> None:
    record = SimpleNamespace(env=env_id, env_kwargs={"physics": "current"})
    assert Record.task.fget(record) == "MO-Ant-v4 (physics=current)"


def test_an_id_is_made_once_and_only_where_it_helps() -> None:
    gym.register("momba-tests/Stub-v0", entry_point=StubEnv, max_episode_steps=7, kwargs={"n_objectives": 3})
    try:
        made = preference_id("momba-tests/Stub-v0")
        assert made == preference_id("momba-tests/Stub-v0") == preference_id(made) == "momba/momba-tests.Stub-v0"
        env = gym.make(made)
        assert env.get_wrapper_attr("n_objectives") == 3
        assert env.spec.max_episode_steps == 7
        assert preference_id("nobody-knows-v0") == "nobody-knows-v0"
    finally:
        gym.registry.pop("momba-tests/Stub-v0")
        gym.registry.pop("momba/momba-tests.Stub-v0")


def test_importing_the_package_imports_no_task_and_not_rl_zoo3() -> None:
    code = """
import sys, sb3_momba, sb3_momba.benchmark.__main__, sb3_momba.train, sb3_momba.zoo.__main__
wanted = ("rl_zoo3", "optuna", "mo_gymnasium.envs.mujoco.", "mo_gymnasium.envs.water_reservoir.dam_env")
print([name for name in sys.modules if name.startswith(wanted)])
"""
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.strip() == "[]"


# ---------------------------------------------------------------------------------------- copies of the training environment


@pytest.mark.parametrize("env_id", ["MO-Swimmer-v4", "momba/MO-Swimmer-v4"])
def test_the_callback_makes_its_own_environment(env_id: str) -> None:
    env = make_mo_vec_env(env_id, 2, env_kwargs={"physics": "current"})
    callback = ParetoEvalCallback(eval_freq=10, n_preferences=2, n_episodes=1)
    MOMBA("SimbaPolicy", env, **TINY).learn(20, callback)
    assert callback.timesteps == [10, 20]
    own = callback.eval_env()
    assert own.unwrapped.physics == "current"
    assert is_wrapped(own, PreferenceWrapper)
    assert not is_wrapped(own, Monitor)
    assert own.unwrapped is not env.envs[0].unwrapped


def test_environments_in_processes_are_copied_too() -> None:
    env = make_mo_vec_env("MO-Swimmer-v4", 1, vec_env_cls=SubprocVecEnv)
    try:
        assert copies_of(env)().spec.id == "MO-Swimmer-v4"
    finally:
        env.close()


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (StubEnv, "The environment has no spec .* Give ParetoEvalCallback an eval_env"),
        (lambda: Unrecordable(gym.make("MO-Swimmer-v4")), "MO-Swimmer-v4 has a wrapper .* Unrecordable does not inherit"),
    ],
)
def test_what_cannot_be_copied_is_an_error_before_the_training(env, message: str) -> None:
    model = MOMBA("SimbaPolicy", env(), **TINY)
    callback = ParetoEvalCallback(n_preferences=2)
    with pytest.raises(ValueError, match=message):
        model.learn(20, callback)
    callback.on_training_end()  # as rl_zoo3 does, whatever happened


class Unrecordable(gym.Wrapper):
    pass
