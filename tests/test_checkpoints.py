"""Checkpoints: whole or not there, and a training that goes on from one as if nothing had happened."""

import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, EveryNTimesteps
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecMonitor

from sb3_momba import MOMBA, MombaCheckpointCallback, ParetoEvalCallback, PreferenceWrapper, make_mo_vec_env
from sb3_momba.buffers import STORED_ARRAYS
from sb3_momba.checkpoints.folders import CheckpointWriter, checkpoints_in, newest, number_of
from sb3_momba.checkpoints.replay_segments import rows_of
from sb3_momba.checkpoints.training_state import set_states_of_callbacks, states_of_callbacks
from sb3_momba.envs.preferences import PerStepSampler, UniformSampler
from sb3_momba.files import FileFormatError, alone_in, read_tree
from tests.stubs import TINY_MLP, TINY_SIMBA, StubEnv, assert_same_tree

SETTINGS = {"seed": 0, "learning_starts": 30, "batch_size": 16, "buffer_size": 150, "device": "cpu"}


def new_model(env, policy: str = "SimbaPolicy", **kwargs) -> MOMBA:
    sizes = TINY_MLP if policy == "MlpPolicy" else TINY_SIMBA
    return MOMBA(policy, env, **{**SETTINGS, "policy_kwargs": sizes, **kwargs})


def everything(model: MOMBA) -> dict:
    """What makes two trainings the same."""
    size = model.replay_buffer.size()
    return {
        "parameters": model.get_parameters(),
        "alpha": model.alpha,
        "buffer": {name: getattr(model.replay_buffer, name)[:size] for name in STORED_ARRAYS},
        "place": [model.replay_buffer.pos, model.replay_buffer.full, model.replay_buffer.n_added],
        "observations": model._last_obs,
        "steps": [model.num_timesteps, model._n_updates, model._episode_num],
        "running_returns": model.policy.return_scale.running_returns,
        "held_noise": model._held_noise.state_dict(),
        "random": [th.get_rng_state(), model.replay_buffer.rng.bit_generator.state],
    }


def checkpointed(env, path, steps: int, save_freq: int, **kwargs) -> MOMBA:
    return new_model(env, **kwargs).learn(steps, MombaCheckpointCallback(save_freq, path, keep=20))


def gone_on(path, env, callback=None) -> MOMBA:
    model = MOMBA.resume(path, env, device="cpu")
    return model.learn(model.remaining_timesteps, callback, reset_num_timesteps=False)


VARIANTS = {
    "Momba": {},
    "one objective": {"env": "Pendulum-v1"},
    "MlpPolicy, vector, mse, HER, PAR": {
        **{"policy": "MlpPolicy", "vector_values": True, "critic_loss": "mse", "her": True},
        "preference_alignment": True,
    },
    "CAPQL's exploration, a preference per step": {
        **{"deterministic_exploration": True, "preference_sampler": PerStepSampler(UniformSampler(2))},
    },
    "3-step returns, four environments": {"n_steps": 3, "n_envs": 4, "gradient_steps": -1},
    "episodes, TD3": {"train_freq": (1, "episode"), "gradient_steps": 2, "td3_noise": 0.1, "ent_coef": 0.0, "policy_delay": 2},
    "noise that remembers": {"action_noise": OrnsteinUhlenbeckActionNoise(np.zeros(3), np.full(3, 0.5))},
    "noise that remembers, three environments": {
        **{"action_noise": OrnsteinUhlenbeckActionNoise(np.zeros(3), np.full(3, 0.5)), "n_envs": 3},
    },
    "held noise, a delayed actor, centred returns of 3 steps, resets, three environments": {
        **{"noise_repeat": 6, "policy_delay": 2, "target_entropy": "std_0.15", "return_scaling": "deviation", "n_envs": 3},
        **{"reward_centering": True, "n_steps": 3, "reset_interval": 90},
    },
    "corner weights and gains, two environments": {
        "her": True,
        "her_kwargs": {"corner_probability": 0.5},
        "preference_sampler": "gain",
        "n_envs": 2,
    },
    "XqcPolicy, vector": {"policy": "XqcPolicy", "vector_values": True},
    "FlashSacPolicy, HER": {"policy": "FlashSacPolicy", "her": True},
    "fixed alpha, a falling learning rate": {"ent_coef": 0.1, "learning_rate": LinearSchedule(1e-3, 1e-5, 1.0)},
}


@pytest.mark.filterwarnings("ignore:preference_alignment assumes", "ignore:.*was not stored")
@pytest.mark.parametrize("kwargs", VARIANTS.values(), ids=VARIANTS)
def test_going_on_from_any_checkpoint_is_never_having_stopped(kwargs, tmp_path):
    kwargs = dict(kwargs)
    env, n_envs = kwargs.pop("env", "MO-Hopper-v4"), kwargs.pop("n_envs", 1)
    undisturbed = everything(new_model(make_mo_vec_env(env, n_envs), **kwargs).learn(240 * n_envs))
    observed = checkpointed(make_mo_vec_env(env, n_envs), tmp_path, 240 * n_envs, 53 * n_envs, **kwargs)
    assert_same_tree(everything(observed), undisturbed)
    folders = checkpoints_in(tmp_path)
    assert len(folders) >= 2
    for folder in folders[::2]:
        resumed = gone_on(folder, make_mo_vec_env(env, n_envs))
        assert_same_tree(everything(resumed), undisturbed)


def test_going_on_in_processes_of_their_own(tmp_path):
    def make():
        return make_mo_vec_env("MO-Hopper-v4", 2, vec_env_cls=SubprocVecEnv)

    env = make()
    undisturbed = everything(checkpointed(env, tmp_path, 200, 70))
    env.close()
    env = make()
    resumed = everything(gone_on(checkpoints_in(tmp_path)[-1], env))
    env.close()
    assert_same_tree(resumed, undisturbed)


def test_a_buffer_that_has_gone_round_many_times(tmp_path):
    undisturbed = everything(checkpointed(StubEnv(), tmp_path, 500, 40, buffer_size=64))
    for folder in checkpoints_in(tmp_path)[::4]:
        assert_same_tree(everything(gone_on(folder, stub_at(folder))), undisturbed)


def stub_at(folder: Path) -> StubEnv:
    """StubEnv counts its steps over all episodes: one that begins where the running episode began."""
    env = StubEnv()
    (state,), steps = read_tree(folder / "state.zip")[0]["environments"], int(folder.name[5:])
    env.n_steps = steps - len(state["actions"])
    return env


# ------------------------------------------------------------------------------------------------- the weaker promise


class OwnRandomness(StubEnv):
    """Draws its observations from a stream that Gymnasium does not know."""

    def step(self, action):
        observation, *others = super().step(action)
        return observation + np.random.default_rng().random(3), *others


def test_an_environment_that_cannot_be_brought_back_is_named(tmp_path):
    checkpointed(OwnRandomness(), tmp_path, 65, 100, preference_sampler="gain")
    with pytest.warns(UserWarning, match=r"Environments \[0\] could not be brought back.*as truncated"):
        model = MOMBA.resume(tmp_path, OwnRandomness())
    last = model.replay_buffer.pos - 1
    assert model.replay_buffer.dones[last] == 1
    assert model.replay_buffer.timeouts[last] == 1
    assert (model.policy.return_scale.running_returns == 0).all()
    assert model._last_obs[0, 0] % 1 == 0.5  # a new episode
    assert len(model.get_env().envs[0].get_wrapper_attr("_played")) == 6  # Those that have ended are remembered.
    model.learn(20, reset_num_timesteps=False)


class Machine(StubEnv):
    """Counts how often it has moved."""

    moves = 0

    def step(self, action):
        Machine.moves += 1
        return super().step(action)


def test_a_machine_does_not_move_by_itself(tmp_path, recwarn):
    checkpointed(Machine(), tmp_path, 65, 100)
    Machine.moves = 0
    model = MOMBA.resume(tmp_path, Machine(), replay=False)
    assert Machine.moves == 0
    assert [str(warning.message) for warning in recwarn] == []
    last = model.replay_buffer.pos - 1
    assert (model.replay_buffer.dones[last], model.replay_buffer.timeouts[last]) == (1, 1)
    model.learn(20, reset_num_timesteps=False)
    assert Machine.moves == 20


class OwnRewards(StubEnv):
    """Draws its rewards from such a stream, and shows nothing of it."""

    def step(self, action):
        observation, reward, *others = super().step(action)
        return observation, reward + np.random.default_rng().random(2), *others


def test_rewards_that_differ_are_noticed_too(tmp_path):
    checkpointed(OwnRewards(), tmp_path, 65, 100)
    env = OwnRewards()
    env.n_steps = 60
    with pytest.warns(UserWarning, match=r"Environments \[0\] could not be brought back"):
        MOMBA.resume(tmp_path, env)


def test_frames_that_are_stacked_begin_anew(tmp_path):
    def make():
        return VecFrameStack(DummyVecEnv([lambda: Monitor(gym.make("Pendulum-v1"))]), 3)

    checkpointed(make(), tmp_path, 65, 100)
    with pytest.warns(UserWarning, match="could not be brought back.*VecFrameStack around them"):
        model = MOMBA.resume(tmp_path, make())
    assert model.learn(20, reset_num_timesteps=False).num_timesteps == 85


def test_wrapped_environments_remember_the_episodes_that_have_ended(tmp_path):
    def make():
        return VecMonitor(DummyVecEnv([lambda: PreferenceWrapper(StubEnv())]))

    for steps, ended in ((5, 0), (65, 6)):
        checkpointed(make(), tmp_path / str(steps), steps, 100, preference_sampler="gain")
        with pytest.warns(UserWarning, match="could not be brought back.*VecMonitor around them"):
            first, second = (MOMBA.resume(tmp_path / str(steps), make()) for _ in range(2))
        assert len(first.get_env().get_attr("_played")[0]) == ended
        assert np.array_equal(first._last_obs, second._last_obs)  # The preference is drawn from the same numbers.


# ----------------------------------------------------------------------------------------------------------- callbacks


@pytest.mark.parametrize("bars", [(False, True), (True, False)])
def test_a_progress_bar_changes_nothing(bars, tmp_path):
    def evaluation():
        return ParetoEvalCallback(StubEnv, eval_freq=20, n_preferences=3, n_episodes=1)

    before, after = bars
    new_model(StubEnv()).learn(60, [evaluation(), MombaCheckpointCallback(30, tmp_path)], progress_bar=before)
    folder, resumed = checkpoints_in(tmp_path)[1], evaluation()
    model = MOMBA.resume(folder, stub_at(folder))
    model.learn(model.remaining_timesteps, [resumed], reset_num_timesteps=False, progress_bar=after)
    assert resumed.timesteps == [20, 40, 60]


def test_a_callback_that_stops_the_training_leaves_no_half_step(tmp_path, caplog):
    class Stop(BaseCallback):
        def _on_step(self):
            return self.num_timesteps < 33

    new_model(StubEnv()).learn(60, [Stop(), MombaCheckpointCallback(20, tmp_path)])
    assert newest(tmp_path).steps == 20
    assert "stopped the training in the middle of a step: the newest checkpoint is that at 20 steps" in caplog.text
    assert gone_on(tmp_path, stub_at(checkpoints_in(tmp_path)[0])).num_timesteps == 60


def test_a_callback_serves_one_training(tmp_path):
    """The segments of another buffer are never mixed in."""
    callback = MombaCheckpointCallback(20, tmp_path)
    model = new_model(StubEnv()).learn(40, callback)
    other = new_model(StubEnv())
    for _ in range(2):  # again, too
        with pytest.raises(ValueError, match=r"holds checkpoints of another training, up to 40 steps"):
            other.learn(40, callback)
    model.save_replay_buffer(tmp_path / "buffer")
    model.load_replay_buffer(tmp_path / "buffer")
    model.learn(35, callback, reset_num_timesteps=False)
    resumed = MOMBA.resume(tmp_path, stub_at(checkpoints_in(tmp_path)[0]))
    assert_same_tree(everything(resumed)["buffer"], everything(model)["buffer"])


def test_callbacks_go_on_where_they_were(tmp_path):
    def callbacks(path, folder):
        evaluation = ParetoEvalCallback("MO-Hopper-v4", eval_freq=60, n_preferences=3, n_episodes=1, log_path=folder)
        every = EveryNTimesteps(45, Counter())
        return CallbackList([evaluation, every, MombaCheckpointCallback(50, path, keep=9)])

    undisturbed = callbacks(tmp_path / "a", tmp_path / "x")
    new_model("MO-Hopper-v4").learn(200, undisturbed)
    resumed = callbacks(tmp_path / "b", tmp_path / "y")
    gone_on(checkpoints_in(tmp_path / "a")[-2], "MO-Hopper-v4", resumed)
    ours, theirs = (one.callbacks[0].state_dict() for one in (resumed, undisturbed))
    for state in (ours, theirs):
        assert min(state.pop("evaluation_seconds").values()) > 0
    assert ours["timesteps"] == [60, 120, 180, 200]
    assert_same_tree(ours, theirs)
    assert resumed.callbacks[1].callback.steps == [s for s in undisturbed.callbacks[1].callback.steps if s > 100]
    with np.load(tmp_path / "y" / "pareto_evaluations.npz") as file:
        assert file["timesteps"].tolist() == [60, 120, 180, 200]


class Counter(BaseCallback):
    def __init__(self):
        super().__init__()
        self.steps = []

    def _on_step(self):
        self.steps.append(self.num_timesteps)
        return True


def test_a_checkpoint_says_only_what_callbacks_remember():
    callback = EvalCallback(StubEnv(), log_path="ours")
    (place,) = states_of_callbacks(callback)
    remembered = {"n_calls": 7, "log_path": "elsewhere", "best_model_save_path": "elsewhere", "_on_step": None}
    set_states_of_callbacks(callback, {place: {"remembered": remembered, "own": None}})
    assert callback.n_calls == 7
    assert (callback.log_path, callback.best_model_save_path) == (str(Path("ours") / "evaluations"), None)
    assert callable(callback._on_step)


def test_a_callback_that_is_missing_is_said(tmp_path):
    evaluation = ParetoEvalCallback(StubEnv, eval_freq=30, n_preferences=3, n_episodes=1)
    new_model(StubEnv()).learn(40, [evaluation, MombaCheckpointCallback(20, tmp_path)])
    model = MOMBA.resume(tmp_path, stub_at(checkpoints_in(tmp_path)[0]))
    with pytest.warns(UserWarning, match="state of a callback .*ParetoEvalCallback, which is not given now"):
        model.learn(5, reset_num_timesteps=False)


def test_the_number_kept_and_what_they_share(tmp_path):
    new_model(StubEnv(), buffer_size=64).learn(300, MombaCheckpointCallback(30, tmp_path, keep=3))
    assert [number_of(folder) for folder in checkpoints_in(tmp_path)] == [10, 9, 8]
    assert [folder.name for folder in checkpoints_in(tmp_path)] == ["0010-000000300", "0009-000000270", "0008-000000240"]
    shared = {file.name for file in (tmp_path / "shared").iterdir()}
    assert shared == {name for folder in checkpoints_in(tmp_path) for name in newest(folder).shared}
    assert min(rows_of(name)[1] for name in shared) > 240 - 64  # what is overwritten in all of them is gone


def test_segments_are_written_once(tmp_path):
    checkpointed(StubEnv(), tmp_path, 60, 20)
    before = {file.name: file.stat().st_mtime_ns for file in (tmp_path / "shared").iterdir()}
    gone_on(checkpoints_in(tmp_path)[-1], stub_at(checkpoints_in(tmp_path)[-1]), MombaCheckpointCallback(20, tmp_path, keep=20))
    after = {file.name: file.stat().st_mtime_ns for file in (tmp_path / "shared").iterdir()}
    assert {name: after[name] for name in before} == before


def test_a_segment_that_is_gone_is_written_again(tmp_path):
    class Delete(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 45:
                min((tmp_path / "shared").iterdir()).unlink()
            return True

    model = new_model(StubEnv()).learn(60, [Delete(), MombaCheckpointCallback(20, tmp_path)])
    resumed = MOMBA.resume(checkpoints_in(tmp_path)[0], stub_at(checkpoints_in(tmp_path)[0]))
    assert_same_tree(everything(resumed), everything(model))


@pytest.mark.parametrize("after", [5, 70])  # fewer transitions than before, and more than the buffer holds
def test_a_buffer_that_was_emptied_is_written_anew(tmp_path, after):
    callback = MombaCheckpointCallback(20, tmp_path)
    model = new_model(StubEnv()).learn(45, callback)
    model.replay_buffer.reset()
    assert model.replay_buffer.size() == len(model.replay_buffer.newest_returns()) == 0
    model.learn(after, callback, reset_num_timesteps=False)
    resumed = MOMBA.resume(tmp_path, stub_at(checkpoints_in(tmp_path)[0]))
    assert_same_tree(everything(resumed)["buffer"], everything(model)["buffer"])


def test_files_of_others_are_left_alone(tmp_path):
    (tmp_path / "shared" / "folder").mkdir(parents=True)
    (tmp_path / "shared" / "thesis.npz").touch()
    new_model(StubEnv()).learn(60, MombaCheckpointCallback(20, tmp_path, keep=1))
    assert {"folder", "thesis.npz"} < {file.name for file in (tmp_path / "shared").iterdir()}


def test_the_folder_stays_where_it_was(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    callback = MombaCheckpointCallback(20, "checkpoints")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    new_model(StubEnv()).learn(30, callback)
    assert newest(tmp_path / "checkpoints").steps == 30


def test_a_training_that_diverges_keeps_its_last_good_checkpoints(tmp_path, monkeypatch, caplog):
    model = new_model(StubEnv()).learn(40, MombaCheckpointCallback(20, tmp_path))
    critic_loss = model._critic_loss
    monkeypatch.setattr(model, "_critic_loss", lambda *args: (critic_loss(*args)[0] * np.nan, {}))
    with pytest.raises(ArithmeticError, match="20 updates in a row"):
        model.learn(40, MombaCheckpointCallback(5, tmp_path, keep=1), reset_num_timesteps=False)
    assert newest(tmp_path).steps == 40
    assert "the critic's loss is nan" in caplog.text
    assert "No checkpoint at 45 steps: updates are being skipped" in caplog.text


# -------------------------------------------------------------------------------------------------------------- damage


@pytest.fixture
def three_checkpoints(tmp_path) -> Path:
    checkpointed(StubEnv(), tmp_path, 60, 20)
    return tmp_path


@pytest.mark.parametrize("file", ["manifest.json", "model.zip", "state.zip"])
@pytest.mark.parametrize("damage", ["a flipped bit", "truncated", "deleted"])
def test_row_34_a_damaged_checkpoint_is_passed_over_and_named(file, damage, three_checkpoints, caplog):
    latest, before = checkpoints_in(three_checkpoints)[:2]
    break_file(latest / file, damage)
    assert newest(three_checkpoints).folder == before
    assert file in caplog.text
    assert damage == "deleted" or file == "manifest.json" or "its manifest states" in caplog.text
    with pytest.raises(FileFormatError, match=file):
        MOMBA.resume(latest, StubEnv())
    assert MOMBA.resume(three_checkpoints, stub_at(before)).num_timesteps == 40


def break_file(file: Path, damage: str) -> None:
    content = bytearray(file.read_bytes())
    if damage == "deleted":
        file.unlink()
    elif damage == "truncated":
        file.write_bytes(content[: len(content) // 2])
    else:
        content[len(content) // 2] ^= 1
        file.write_bytes(content)


def test_a_damaged_segment_condemns_every_checkpoint_that_needs_it(three_checkpoints):
    first = min((three_checkpoints / "shared").iterdir())
    break_file(first, "a flipped bit")
    with pytest.raises(FileFormatError, match=rf"None of the 3 checkpoints in .* is whole.*{first.name}"):
        newest(three_checkpoints)


def test_no_checkpoint_is_said(tmp_path):
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(FileNotFoundError, match="has no checkpoint"):
            MOMBA.resume(path, StubEnv())


def test_another_format_is_named(three_checkpoints):
    writer = CheckpointWriter(three_checkpoints)
    folder = writer.write(70, {"other.zip": {"a": 1}}, [])
    with pytest.raises(FileFormatError, match=r"is not a whole checkpoint: it has no model\.zip"):
        MOMBA.resume(folder, StubEnv())
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["content"]["version"] = 99
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(FileFormatError, match="checksum"):
        newest(folder)


def test_row_37_another_environment_is_refused(three_checkpoints):
    with pytest.raises(ValueError, match="The model was trained with n_objectives=2"):
        MOMBA.resume(three_checkpoints, StubEnv(n_objectives=3))


def test_another_number_of_environments_is_refused(three_checkpoints):
    with pytest.raises(FileFormatError, match="has 1 environments, not 2: give as many"):
        MOMBA.resume(three_checkpoints, make_mo_vec_env(StubEnv, 2))


def test_settings_that_cannot_be_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"env=None: resuming .* needs the training's environment"):
        MOMBA.resume(tmp_path, None)
    with pytest.raises(ValueError, match="seed=5: the random numbers of a checkpoint go on"):
        MOMBA.resume(tmp_path, StubEnv(), seed=5)
    with pytest.raises(ValueError, match="save_freq=0"):
        MombaCheckpointCallback(0, tmp_path)
    with pytest.raises(ValueError, match="keep=0"):
        MombaCheckpointCallback(10, tmp_path, keep=0)


# ------------------------------------------------------------------------------------------------------------- signals

SIGNALLED = """
import os, signal, sys
from sb3_momba import MombaCheckpointCallback
from stable_baselines3.common.callbacks import BaseCallback
from tests.stubs import StubEnv
from tests.test_checkpoints import new_model

class Signal(BaseCallback):
    def _on_step(self):
        if self.num_timesteps == 57:
            for _ in range(2):  # to the process, and to its group
                os.kill(os.getpid(), int(sys.argv[2]))
        return True

new_model(StubEnv()).learn(100_000, [Signal(), MombaCheckpointCallback(50_000, sys.argv[1])])
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_row_33_a_signal_writes_a_checkpoint_and_ends_the_training(number, tmp_path):
    command = [sys.executable, "-c", SIGNALLED, str(tmp_path), str(int(number))]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert ended.returncode == (143 if number == signal.SIGTERM else -signal.SIGINT), ended.stderr
    checkpoint = newest(tmp_path)
    assert checkpoint.steps == 57
    assert MOMBA.resume(tmp_path, stub_at(checkpoint.folder)).num_timesteps == 57


IN_PROCESSES = """
import os, signal, sys
from sb3_momba import MombaCheckpointCallback, make_mo_vec_env
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import SubprocVecEnv
from tests.stubs import StubEnv
from tests.test_checkpoints import new_model

class CtrlC(BaseCallback):
    def _on_step(self):
        if self.num_timesteps == 58:
            os.killpg(os.getpgid(0), signal.SIGINT)
        return True

if __name__ == "__main__":
    env = make_mo_vec_env(StubEnv, 2, vec_env_cls=SubprocVecEnv)
    new_model(env).learn(100_000, [CtrlC(), MombaCheckpointCallback(50_000, sys.argv[1])])
"""


def test_ctrl_c_at_a_terminal_reaches_the_environments_too_and_costs_nothing(tmp_path):
    (tmp_path / "script.py").write_text(IN_PROCESSES)
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent.parent), os.environ.get("PYTHONPATH", "")]),
    }
    command = [sys.executable, tmp_path / "script.py", tmp_path / "checkpoints"]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, start_new_session=True)
    assert ended.returncode == -signal.SIGINT, ended.stderr
    assert newest(tmp_path / "checkpoints").steps == 58


def test_a_signal_at_the_very_end_is_not_lost(tmp_path):
    class AtTheEnd(BaseCallback):
        def _on_step(self):
            return True

        def _on_training_end(self):
            signal.raise_signal(signal.SIGINT)

    callback = MombaCheckpointCallback(20, tmp_path)
    model = new_model(StubEnv())
    with pytest.raises(KeyboardInterrupt):
        model.learn(30, [AtTheEnd(), callback])
    assert newest(tmp_path).steps == 30
    assert model.learn(5, callback, reset_num_timesteps=False).num_timesteps == 35


def test_a_second_signal_does_not_wait_for_the_checkpoint(tmp_path, monkeypatch):
    class Impatient(BaseCallback):
        def _on_step(self):
            signal.raise_signal(signal.SIGINT)
            monkeypatch.setattr(callback, "received_at", -math.inf)  # a while ago
            signal.raise_signal(signal.SIGINT)
            return True

    callback = MombaCheckpointCallback(100, tmp_path)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # A job in the background begins with SIGINT ignored.
    try:
        with pytest.raises(KeyboardInterrupt):
            new_model(StubEnv()).learn(10, [Impatient(), callback])
    finally:
        signal.signal(signal.SIGINT, before)
    assert checkpoints_in(tmp_path) == []


def test_handlers_are_the_users_again_after_an_error(tmp_path):
    class Fails(BaseCallback):
        def _on_step(self):
            assert signal.getsignal(signal.SIGINT) is not before
            raise KeyError

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyError):
        new_model(StubEnv()).learn(10, [MombaCheckpointCallback(100, tmp_path), Fails()])
    assert signal.getsignal(signal.SIGINT) is before
    assert os.listdir(tmp_path) == [".lock"]


def test_row_39_two_trainings_in_one_folder_are_refused(tmp_path):
    with alone_in(tmp_path), pytest.raises(ValueError, match="Another process writes into"):
        new_model(StubEnv()).learn(5, MombaCheckpointCallback(100, tmp_path))
    new_model(StubEnv()).learn(5, MombaCheckpointCallback(100, tmp_path))
