"""The algorithm from end to end on tiny networks: it trains, repeats itself, logs, predicts and comes back from files."""

import io
import itertools
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_momba import MOMBA, MlpPolicy, PreferenceWrapper, SimbaPolicy, make_mo_vec_env
from sb3_momba.envs.preferences import FixedSampler
from tests.stubs import StubEnv, assert_same_tree, reward_of, tiny_model

OBSERVATIONS = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)


def preferences_for(n_objectives: int, n: int = 7) -> np.ndarray:
    return np.random.default_rng(1).dirichlet(np.ones(n_objectives), size=n)


def actions_of(model: MOMBA) -> np.ndarray:
    actions, _ = model.predict(OBSERVATIONS, preference=preferences_for(model.n_objectives), deterministic=True)
    return actions


def reloaded(model: MOMBA, **kwargs: Any) -> MOMBA:
    file = io.BytesIO()
    model.save(file)
    return MOMBA.load(file, **kwargs)


def assert_finite(model: MOMBA) -> None:
    for name, parameter in model.policy.state_dict().items():
        assert bool(th.isfinite(parameter).all()), name


class Recorder(KVWriter):
    """Keeps what is logged."""

    def __init__(self) -> None:
        self.logs: list[dict[str, Any]] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        self.logs.append(dict(key_values))


def logs_of(model: MOMBA, n_timesteps: int) -> list[dict[str, Any]]:
    recorder = Recorder()
    model.set_logger(Logger(None, [recorder]))
    model.learn(n_timesteps, log_interval=1)
    return recorder.logs


# ------------------------------------------------------------------------------------------------ determinism


@pytest.mark.parametrize("policy", ["SimbaPolicy", "MlpPolicy"])
def test_the_same_seed_gives_bit_equal_parameters_after_300_updates(policy):
    models = [tiny_model(StubEnv(), policy, seed=3, her=True).learn(320) for _ in range(2)]
    assert models[0]._n_updates == models[1]._n_updates == 300
    assert_same_tree(models[0].get_parameters(), models[1].get_parameters())
    for name in ("observations", "actions", "rewards", "preferences"):
        np.testing.assert_array_equal(getattr(models[0].replay_buffer, name), getattr(models[1].replay_buffer, name))


def test_another_seed_gives_other_parameters_preferences_and_actions():
    first, second = (tiny_model(StubEnv(), seed=seed).learn(30) for seed in (3, 4))
    for name, parameter in first.actor.state_dict().items():
        assert not th.equal(parameter, second.actor.state_dict()[name]), name
    ours, theirs = first.replay_buffer, second.replay_buffer
    assert (ours.actions[:30] != theirs.actions[:30]).all()
    assert (ours.preferences[:30] != theirs.preferences[:30]).all()


def test_the_same_seed_repeats_several_environments_and_subprocesses_do_not_change_that():
    def train(**kwargs: Any) -> MOMBA:
        model = tiny_model(make_mo_vec_env(partial(StubEnv, episode_length=4), 2, **kwargs)).learn(80)
        model.env.close()
        return model

    dummy, subproc = train(), train(vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": "fork"})
    assert_same_tree(dummy.get_parameters(), subproc.get_parameters())


def test_without_a_seed_two_runs_differ():
    first, second = (tiny_model(StubEnv(), seed=None).learn(5) for _ in range(2))
    assert not np.array_equal(first.replay_buffer.actions, second.replay_buffer.actions)


# ------------------------------------------------------------------------------------- every size and every variant


@pytest.mark.parametrize("n_objectives", [1, 2, 3, 6, 10])
@pytest.mark.parametrize("vector_values", [False, True], ids=["scalar", "vector"])
def test_any_number_of_objectives_and_environments_trains_saves_and_predicts_alike(n_objectives, vector_values):
    make = partial(make_mo_vec_env, StubEnv, 4, env_kwargs={"n_objectives": n_objectives})
    model = tiny_model(make(), vector_values=vector_values).learn(100)
    assert model.n_objectives == n_objectives
    assert model._n_updates == 20
    assert model.replay_buffer.rewards.shape == (250, 4, n_objectives)
    np.testing.assert_array_equal(model.replay_buffer.rewards[4, 3], reward_of(5, n_objectives))
    assert_finite(model)
    again = reloaded(model, env=make())
    np.testing.assert_array_equal(actions_of(again), actions_of(model))
    again.learn(20, reset_num_timesteps=False)
    assert again._n_updates == 25
    assert_finite(again)


def test_subprocesses_train():
    make = partial(make_mo_vec_env, StubEnv, 4, vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": "fork"})
    venv = make(seed=0)
    model = tiny_model(venv).learn(100)
    venv.close()
    assert model._n_updates == 20
    assert len(np.unique(model.replay_buffer.preferences[0], axis=0)) == 4
    np.testing.assert_array_equal(actions_of(reloaded(model)), actions_of(model))


VARIANTS: dict[str, dict[str, Any]] = {
    f"{policy} {loss} {'vector' if vector else 'scalar'}": {"policy": policy, "critic_loss": loss, "vector_values": vector}
    for policy, loss, vector in itertools.product(["SimbaPolicy", "MlpPolicy"], ["ce", "mse"], [False, True])
}
VARIANTS |= {
    f"{policy} {conditioning}": {"policy": policy, "policy_kwargs": {"conditioning": conditioning}}
    for policy, conditioning in itertools.product(["SimbaPolicy", "MlpPolicy"], ["input", "all", "film", "film+all"])
}
VARIANTS |= {
    "her": {"her": True},
    "her_kwargs": {"her": True, "her_kwargs": {"keep_probability": 0.0, "concentration": 50.0}},
    "alignment ce": {"vector_values": True, "preference_alignment": True},
    "alignment mse": {"vector_values": True, "preference_alignment": True, "critic_loss": "mse"},
    "n_steps": {"n_steps": 3},
    "no observation statistics": {"policy_kwargs": {"normalize_observations": False}},
    "no feature norms": {"policy_kwargs": {"normalize_features": False}},
    "no weight norms": {"policy_kwargs": {"normalize_weights": False}},
    "no return scale": {"best_return_scale": None},
    "one critic": {"policy_kwargs": {"n_critics": 1}},
    "five critics": {"policy_kwargs": {"n_critics": 5}},
    "net_arch of actor and critic": {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": {"pi": [4], "qf": [6, 5]}}},
    "fixed alpha": {"ent_coef": 0.1},
    "alpha from 1": {"ent_coef": "auto"},
    "target_entropy": {"target_entropy": -1.5},
    "action noise": {"action_noise": NormalActionNoise(np.zeros(2), np.full(2, 0.1))},
    "per episode": {"train_freq": (1, "episode"), "gradient_steps": 10},
    "everything": {
        "her": True,
        "n_steps": 3,
        "vector_values": True,
        "preference_alignment": True,
        "policy_kwargs": {"conditioning": "film+all"},
    },
}


@pytest.mark.parametrize("kwargs", VARIANTS.values(), ids=VARIANTS)
def test_every_variant_trains_saves_loads_continues_and_predicts_alike(kwargs):
    model = tiny_model(StubEnv(), **kwargs)
    start = {name: parameter.clone() for name, parameter in model.policy.state_dict().items()}
    model.learn(50)
    assert model._n_updates == 30
    assert_finite(model)
    trained = dict(model.policy.named_parameters())
    unmoved = [name for name, parameter in trained.items() if th.equal(parameter, start[name])]
    assert unmoved == []
    again = reloaded(model, env=StubEnv())
    np.testing.assert_array_equal(actions_of(again), actions_of(model))
    assert_same_tree(again.get_parameters(), model.get_parameters())
    again.learn(20, reset_num_timesteps=False)
    assert again.num_timesteps == 70
    assert again._n_updates == 50
    assert_finite(again)
    assert not np.array_equal(actions_of(again), actions_of(model))


def test_a_policy_can_be_given_as_a_class():
    assert type(tiny_model(StubEnv(), SimbaPolicy).policy) is SimbaPolicy
    assert type(MOMBA(MlpPolicy, StubEnv(), policy_kwargs={"net_arch": [4]}, buffer_size=10).policy) is MlpPolicy


def test_switches_do_what_they_say():
    off = tiny_model(StubEnv(), best_return_scale=None, policy_kwargs={"normalize_observations": False}).learn(25)
    assert off.policy.reward_factor == 1
    observations = th.rand(4, 5)
    assert off.policy.normalize(observations) is observations
    on = tiny_model(StubEnv(), best_return_scale=6.0).learn(25)
    # With gamma = 0.99 and [t, -10 t], the largest return is that of the second objective over the second episode.
    largest = sum(0.99 ** (20 - t) * 10 * t for t in range(11, 21))
    assert on.policy.reward_factor == pytest.approx(6.0 / largest)
    np.testing.assert_array_equal(on.policy.normalize(observations)[:, 3:], observations[:, 3:])
    weights = [module.weight for module in on.actor.modules() if type(module).__name__ == "HyperDense"]
    assert len(weights) > 4
    for weight in weights:
        np.testing.assert_allclose(weight.detach().norm(dim=-2), 1, rtol=1e-5)


@pytest.mark.parametrize(
    ("kwargs", "match"),
    [
        ({"critic_loss": "huber"}, r"critic_loss='huber' is not known: use one of ce, mse"),
        ({"preference_alignment": True}, r"preference_alignment=True .*set vector_values=True"),
        ({"her_kwargs": {"concentration": 1.0}}, r"her_kwargs=.*without her=True"),
        ({"her": True, "her_kwargs": {"corner_probability": 1.5}}, r"corner_probability=1\.5.*a probability"),
        ({"vector_values": True, "preference_alignment": 1}, 'preference_alignment=1: .*True or False, or "positive"'),
        ({"her": True, "her_kwargs": {"keep_probability": 2.0}}, r"keep_probability=2\.0.*a probability"),
        ({"her": True, "her_kwargs": {"concentration": 0.0}}, r"concentration=0\.0.*positive"),
        ({"n_steps": 0}, r"n_steps=0: it must be a whole number of at least 1"),
        ({"ent_coef": "auto_0"}, r"ent_coef='auto_0': .*a start above 0"),
        ({"ent_coef": "auto0.2"}, r"ent_coef='auto0\.2'"),
        ({"ent_coef": "none"}, r"ent_coef='none'"),
        ({"ent_coef": -0.1}, r"ent_coef=-0\.1"),
        ({"optimize_memory_usage": True}, r"optimize_memory_usage=True .*leave it False"),
        ({"policy_kwargs": {"conditioning": "concat"}}, r"conditioning='concat' is not known: use one of input, all, film"),
        ({"policy_kwargs": {"n_critics": 0}}, r"n_critics=0: it must be a whole number of at least 1"),
        ({"policy_kwargs": {"n_atoms": 1}}, r"n_atoms=1: it must be a whole number of at least 2"),
        ({"policy_kwargs": {"support": (5.0, -5.0)}}, r"support=\(5\.0, -5\.0\).*rising order"),
    ],
    ids=lambda x: str(x)[:40] if isinstance(x, dict) else "",
)
def test_settings_that_make_no_sense_are_errors_that_name_them(kwargs, match):
    with pytest.raises(ValueError, match=match):
        tiny_model(StubEnv(), **kwargs)


# ---------------------------------------------------------------------------------------------------- learning


def test_learn_accepts_a_float_and_stops_by_a_callback():
    model = tiny_model(StubEnv()).learn(1e6, callback=StopTrainingOnMaxEpisodes(max_episodes=4))
    assert model.num_timesteps == 40
    model = tiny_model(StubEnv()).learn(1e6, callback=lambda local, _: local["self"].num_timesteps < 33)
    assert model.num_timesteps == 33


def test_learn_goes_on_or_starts_over():
    model = tiny_model(StubEnv()).learn(30)
    assert model.learn(10, reset_num_timesteps=False).num_timesteps == 40
    assert model.replay_buffer.pos == 40
    assert model.learn(10).num_timesteps == 10
    assert model._n_updates == 10 + 10


@pytest.mark.parametrize("stopped_at", [4, 10, 11])  # within an episode, at its end, at the next one's start
@pytest.mark.parametrize("n_objectives", [1, 2])
def test_after_a_stop_within_a_step_learning_goes_on_with_a_reset(n_objectives, stopped_at):
    """The step at which a callback stopped was made, but not stored: its transition is missing, and no other is false."""

    def until(steps):
        return lambda local, _: local["self"].num_timesteps < steps

    model = tiny_model(StubEnv(n_objectives, episode_length=10), learning_starts=100).learn(50, callback=until(stopped_at))
    model.learn(25, reset_num_timesteps=False)
    buffer = model.replay_buffer
    n = buffer.pos
    assert n == stopped_at - 1 + 25
    steps = np.floor(buffer.next_observations[:n, 0, 0])
    assert steps.tolist() == [*range(1, stopped_at), *range(stopped_at + 1, stopped_at + 26)]
    np.testing.assert_array_equal(buffer.rewards[:n, 0, 0], steps)
    np.testing.assert_array_equal(np.floor(buffer.observations[:n, 0, 0]), steps - 1)
    assert buffer.dones[stopped_at - 2, 0] == 1
    returns, largest = np.zeros(n_objectives), 0.0
    for reward, done in zip(buffer.rewards[:n, 0], buffer.dones[:n, 0], strict=True):
        returns = 0.99 * returns + reward
        largest = max(largest, float(np.abs(returns).max()))
        returns *= 1 - done
    assert float(model.policy.return_scale.max_return) == pytest.approx(largest, rel=1e-5)


def test_after_an_error_within_a_step_learning_goes_on_with_a_reset():
    class Failing(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 4:
                raise ArithmeticError
            return True

    env = StubEnv(episode_length=10)
    model = tiny_model(env, learning_starts=100)
    with pytest.raises(ArithmeticError):
        model.learn(20, Failing())
    model.learn(3, reset_num_timesteps=False)
    np.testing.assert_array_equal(model.replay_buffer.dones[:6, 0], [0, 0, 1, 0, 0, 0])
    np.testing.assert_array_equal(np.floor(model.replay_buffer.observations[:6, 0, 0]), [0, 1, 2, 4, 5, 6])


def test_a_new_learn_ends_the_episodes_that_its_reset_cuts_off():
    model = tiny_model(StubEnv(episode_length=10), learning_starts=100).learn(4)
    buffer = model.replay_buffer
    assert not buffer.dones[:4].any()
    model.learn(3, reset_num_timesteps=False)
    assert not buffer.dones[:7].any()
    model.learn(3)
    np.testing.assert_array_equal(buffer.dones[:10, 0], [0, 0, 0, 0, 0, 0, 1, 0, 0, 0])
    np.testing.assert_array_equal(buffer.timeouts[:10, 0], buffer.dones[:10, 0])
    largest = max(sum(0.99 ** (last - t) * 10 * t for t in range(first, last + 1)) for first, last in ((1, 7), (8, 10)))
    assert float(model.policy.return_scale.max_return) == pytest.approx(largest)


@pytest.mark.parametrize(
    ("n_envs", "train_freq", "gradient_steps", "expected"),
    [
        (3, 1, -1, 42),  # rollouts of 3 steps, updates from step 21 to step 60
        (3, 1, 1, 14),
        (3, 2, -1, 42),  # rollouts of 6 steps, updates from step 24 to step 60
        (1, 1, -1, 40),
        (1, 7, -1, 49),  # rollouts of 7 steps, updates from step 21 to step 63
        (1, (1, "episode"), -1, 40),
        (2, 5, 0, 0),
    ],
)
def test_the_number_of_updates_is_exact(n_envs, train_freq, gradient_steps, expected):
    model = tiny_model(make_mo_vec_env(StubEnv, n_envs), train_freq=train_freq, gradient_steps=gradient_steps).learn(60)
    assert model._n_updates == expected


def test_nothing_is_trained_before_learning_starts():
    model = tiny_model(StubEnv(), learning_starts=50)
    start = {name: parameter.clone() for name, parameter in model.policy.named_parameters()}
    model.learn(50)
    assert model._n_updates == 0
    assert all(th.equal(parameter, start[name]) for name, parameter in model.policy.named_parameters())
    assert int(model.policy.statistics.count) == 50
    # Until then, actions are uniform: on [-1, 1] their variance is 1/3.
    assert model.replay_buffer.actions[:50].var() == pytest.approx(1 / 3, abs=0.1)


def test_statistics_count_each_stored_state_once_and_predict_leaves_them_alone():
    model = tiny_model(make_mo_vec_env(StubEnv, 2)).learn(60)
    stored = model.replay_buffer.observations[:30].reshape(60, 3)
    np.testing.assert_allclose(model.policy.statistics.mean, stored.mean(axis=0, dtype=np.float64), rtol=1e-9)
    np.testing.assert_allclose(model.policy.statistics.variance, stored.var(axis=0, dtype=np.float64), rtol=1e-9)
    before = model.policy.statistics.mean.clone()
    actions_of(model)
    assert th.equal(model.policy.statistics.mean, before)
    assert int(model.policy.statistics.count) == 60


def test_actions_of_training_reach_the_environment_within_its_bounds():
    env = StubEnv()
    model = tiny_model(env).learn(60)
    actions = np.array(env.actions)
    assert (np.abs(actions) <= 2).all()
    assert (np.abs(actions) > 1).any()
    np.testing.assert_allclose(actions, 2 * model.replay_buffer.actions[:60, 0], rtol=1e-5, atol=1e-6)


def test_a_preference_sampler_reaches_every_environment():
    model = tiny_model(make_mo_vec_env(StubEnv, 3), preference_sampler=FixedSampler((0.25, 0.75))).learn(30)
    assert (model.replay_buffer.preferences[:10] == [0.25, 0.75]).all()


def test_a_fixed_entropy_coefficient_stays():
    model = tiny_model(StubEnv(), ent_coef=0.125)
    logs = logs_of(model, 60)
    assert model.alpha == 0.125
    assert model.ent_coef_optimizer is None
    assert {log["train/ent_coef"] for log in logs if "train/ent_coef" in log} == {0.125}
    again = reloaded(model)
    assert again.alpha == 0.125
    assert "ent_coef_optimizer" not in model.get_parameters()


@pytest.mark.parametrize(("target_entropy", "direction"), [(100.0, 1), (-100.0, -1)])
def test_a_learned_entropy_coefficient_moves_towards_its_target(target_entropy, direction):
    model = tiny_model(StubEnv(), ent_coef="auto_0.5", target_entropy=target_entropy, learning_rate=1e-2)
    assert float(model.alpha) == pytest.approx(0.5)
    model.learn(60)
    assert direction * (float(model.alpha) - 0.5) > 0.1


def test_the_target_entropy_is_minus_the_action_dimension_by_default():
    assert tiny_model(StubEnv(action_dim=3)).target_entropy == -3.0


def test_a_schedule_sets_the_learning_rate_of_every_optimiser():
    model = tiny_model(StubEnv(), learning_rate=LinearSchedule(1e-2, 1e-3, 1.0))
    logs = logs_of(model, 100)
    for optimizer in (model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer):
        assert optimizer.param_groups[0]["lr"] == pytest.approx(1e-3)
    rates = [log["train/learning_rate"] for log in logs if "train/learning_rate" in log]
    # Episode n ends at step 10 n; its log shows the update of the step before.
    np.testing.assert_allclose(rates, [1e-2 - 9e-3 * (10 * n - 1) / 100 for n in range(3, 11)])
    again = reloaded(model)
    assert again.learning_rate(0.5) == again.lr_schedule(0.5) == pytest.approx(5.5e-3)


def test_a_function_sets_the_learning_rate():
    model = tiny_model(StubEnv(), learning_rate=lambda progress: 1e-3 if progress > 0.5 else 1e-5).learn(100)
    assert model.actor.optimizer.param_groups[0]["lr"] == 1e-5


def test_a_discount_of_zero_leaves_nothing_but_the_reward():
    model = tiny_model(StubEnv(), gamma=0.0, critic_loss="mse", best_return_scale=None, learning_rate=1e-2, ent_coef=0.0)
    assert_finite(model.learn(60))


# ------------------------------------------------------------------------------------------------------ logging

ALWAYS_LOGGED = {
    "train/critic_loss",
    "train/actor_loss",
    "train/entropy",
    "train/ent_coef",
    "train/ent_coef_loss",
    "train/return_scale",
    "train/target_end_mass",
    "train/feature_norm",
    "train/critic_weight_norm",
    "train/actor_weight_norm",
    "train/n_updates",
    "train/learning_rate",
    "rollout/ep_rew_mean",
    "rollout/ep_len_mean",
    "time/total_timesteps",
}


@pytest.mark.parametrize("policy", ["SimbaPolicy", "MlpPolicy"])
@pytest.mark.parametrize(
    ("n_objectives", "vector_values", "values"),
    [(2, False, {"q"}), (2, True, {"q_0", "q_1"}), (3, True, {"q_0", "q_1", "q_2"}), (1, True, {"q"})],
)
def test_what_is_logged(policy, n_objectives, vector_values, values):
    model = tiny_model(StubEnv(n_objectives), policy, vector_values=vector_values)
    logs = logs_of(model, 60)
    assert len(logs) == 6
    assert not any(name.startswith("train/") for name in logs[0])
    last = logs[-1]
    assert set(last) >= ALWAYS_LOGGED | {f"train/{name}" for name in values}
    assert {name for name in last if name.startswith("train/q")} == {f"train/{name}" for name in values}
    assert all(np.isfinite(value) for value in last.values())
    assert last["train/n_updates"] == 39
    assert last["time/total_timesteps"] == 60
    assert 0 <= last["train/target_end_mass"] <= 1
    assert last["train/return_scale"] == pytest.approx(model.policy.reward_factor, rel=1e-6)
    if policy == "SimbaPolicy":
        assert last["train/feature_norm"] == pytest.approx(1, rel=1e-4)
    norm = th.cat([parameter.flatten() for parameter in model.critic.parameters()]).detach().norm()
    assert last["train/critic_weight_norm"] == pytest.approx(float(norm), rel=1e-2)


def test_the_log_holds_means_since_the_last_log(monkeypatch):
    model = tiny_model(StubEnv())
    losses = []
    original = model._critic_loss
    monkeypatch.setattr(model, "_critic_loss", lambda *args: losses.append(original(*args)) or losses[-1])
    logs = logs_of(model, 60)
    means = [log["train/critic_loss"] for log in logs if "train/critic_loss" in log]
    # The log of an episode is written before the update that follows its last step.
    numbers = [float(loss.detach()) for loss, _ in losses]
    expected = [np.mean(numbers[:9]), np.mean(numbers[9:19]), np.mean(numbers[19:29]), np.mean(numbers[29:39])]
    np.testing.assert_allclose(means, expected, rtol=1e-5)


def test_an_mse_critic_has_no_mass_on_an_end():
    logs = logs_of(tiny_model(StubEnv(), critic_loss="mse"), 60)
    assert logs[-1]["train/target_end_mass"] == 0


def blind_model(**kwargs: Any) -> MOMBA:
    return tiny_model(StubEnv(), learning_starts=5, **kwargs)


def test_a_blind_critic_is_said_once_and_with_the_cure(monkeypatch, recwarn):
    monkeypatch.setattr("sb3_momba.diagnostics.BLIND_UPDATES", 10)
    blind_model(ent_coef=50.0).learn(60)
    said = [str(warning.message) for warning in recwarn if "target mass" in str(warning.message)]
    assert len(said) == 1
    assert said[0].startswith("For 10 updates more than half")
    assert 'ent_coef="auto_0.01"' in said[0]


@pytest.mark.parametrize("kwargs", [{"ent_coef": 0.0}, {"ent_coef": 50.0, "critic_loss": "mse"}], ids=["alpha 0", "mse"])
def test_a_critic_that_sees_is_not_called_blind(kwargs, monkeypatch, recwarn):
    monkeypatch.setattr("sb3_momba.diagnostics.BLIND_UPDATES", 10)
    blind_model(**kwargs).learn(60)
    assert [warning for warning in recwarn if "target mass" in str(warning.message)] == []


def test_blindness_must_last_without_a_break(monkeypatch, recwarn):
    monkeypatch.setattr("sb3_momba.diagnostics.BLIND_UPDATES", 10)
    model = tiny_model(StubEnv(), ent_coef=50.0, learning_starts=50).learn(50)

    def update(n: int, alpha: float) -> int:
        """The number of warnings so far, after n updates with this entropy coefficient."""
        model.ent_coef_tensor.fill_(alpha)
        model.train(gradient_steps=n, batch_size=16)
        return len([warning for warning in recwarn if "target mass" in str(warning.message)])

    # Blind in 18 of 20 updates, but never in 10 without a break.
    assert [update(4, 50.0), update(1, 0.0), update(9, 50.0), update(1, 0.0), update(5, 50.0)] == [0] * 5
    assert update(10, 50.0) == 1


# ---------------------------------------------------------------------------------------------------- predicting


@pytest.fixture(scope="module")
def trained() -> MOMBA:
    return tiny_model(StubEnv()).learn(60)


def test_a_preference_beside_the_observation_equals_one_inside_it(trained):
    w = np.float32([0.25, 0.75])
    for observation in (OBSERVATIONS[0], OBSERVATIONS):
        inside = np.concatenate([observation, np.broadcast_to(w, (*observation.shape[:-1], 2))], axis=-1)
        beside = trained.predict(observation, preference=[0.25, 0.75], deterministic=True)[0]
        np.testing.assert_array_equal(beside, trained.predict(inside, deterministic=True)[0], strict=True)


def test_shapes_of_predictions(trained):
    each = preferences_for(2)
    assert trained.predict(OBSERVATIONS[0], preference=[0.5, 0.5])[0].shape == (2,)
    assert trained.predict(OBSERVATIONS, preference=[0.5, 0.5])[0].shape == (7, 2)
    assert trained.predict(OBSERVATIONS[:1], preference=[[0.5, 0.5]])[0].shape == (1, 2)
    batch = trained.predict(OBSERVATIONS, preference=each, deterministic=True)[0]
    assert batch.shape == (7, 2)
    for i in range(7):
        single = trained.predict(OBSERVATIONS[i], preference=each[i], deterministic=True)[0]
        np.testing.assert_allclose(single, batch[i], rtol=1e-4, atol=1e-6)


def test_predictions_depend_on_the_preference_and_the_observation(trained):
    observation, other = OBSERVATIONS[:2]
    action = trained.predict(observation, preference=[1, 0], deterministic=True)[0]
    assert not np.allclose(action, trained.predict(observation, preference=[0, 1], deterministic=True)[0])
    assert not np.allclose(action, trained.predict(other, preference=[1, 0], deterministic=True)[0])


def test_deterministic_predictions_repeat_and_others_vary_within_the_bounds(trained):
    many = np.tile(OBSERVATIONS[0], (500, 1))
    deterministic = trained.predict(many, preference=[0.5, 0.5], deterministic=True)[0]
    np.testing.assert_allclose(deterministic, np.tile(deterministic[0], (500, 1)), rtol=1e-5)
    sampled = trained.predict(many, preference=[0.5, 0.5])[0]
    assert len(np.unique(sampled, axis=0)) == 500
    assert (np.abs(sampled) <= 2).all()
    assert (np.abs(sampled) > 1).any()


def test_predict_hands_the_state_through(trained):
    state = (np.ones(1),)
    assert trained.predict(OBSERVATIONS, state, np.ones(7), preference=[0.5, 0.5])[1] is state


@pytest.mark.parametrize("cast", [list, np.float64, np.float16, np.array], ids=lambda cast: cast.__name__)
def test_an_observation_of_any_numbers_is_accepted(trained, cast):
    observation = np.array([1.0, -2.0, 0.5])
    w = [0.25, 0.75]
    expected = trained.predict(observation.astype(np.float32), preference=w, deterministic=True)[0]
    np.testing.assert_array_equal(trained.predict(cast(observation), preference=w, deterministic=True)[0], expected)
    inside = cast(np.array([*observation, *w]))
    np.testing.assert_array_equal(trained.predict(inside, deterministic=True)[0], expected)


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int64])
def test_an_observation_of_any_numbers_is_accepted_with_one_objective(dtype):
    model = tiny_model(StubEnv(n_objectives=None))
    expected = model.predict(np.float32([1, 2, 3]), deterministic=True)[0]
    np.testing.assert_array_equal(model.predict(np.array([1, 2, 3], dtype), deterministic=True)[0], expected)


def test_one_objective_needs_no_preference_and_accepts_only_one():
    model = tiny_model(StubEnv(n_objectives=1))
    action = model.predict(OBSERVATIONS, deterministic=True)[0]
    np.testing.assert_array_equal(model.predict(OBSERVATIONS, preference=[1.0], deterministic=True)[0], action)
    with pytest.raises(ValueError, match="give 1 weights"):
        model.predict(OBSERVATIONS, preference=[0.5, 0.5])


@pytest.mark.parametrize(
    "sampler",
    [[0.25, 0.75], {"name": "fixed", "preference": [0.25, 0.75]}, FixedSampler((0.25, 0.75))],
    ids=["list", "name", "object"],
)
def test_a_model_of_one_preference_needs_none(sampler):
    model = tiny_model(StubEnv(), preference_sampler=sampler)
    for observation in (OBSERVATIONS, OBSERVATIONS[0]):
        expected = model.predict(observation, preference=[0.25, 0.75], deterministic=True)[0]
        np.testing.assert_array_equal(model.predict(observation, deterministic=True)[0], expected)
        other = model.predict(observation, preference=[0.75, 0.25], deterministic=True)[0]
        assert not np.array_equal(other, expected)


WITH_PREFERENCE = np.zeros((7, 5), dtype=np.float32)
PREDICTION_ERRORS = [
    (OBSERVATIONS, None, r"no preference.*preference=.* 2 weights"),
    (OBSERVATIONS[0], None, r"no preference.*preference=.* 2 weights"),
    (WITH_PREFERENCE, [0.5, 0.5], r"3 wide, not 5, which carries a preference already"),
    (np.zeros(4), [0.5, 0.5], r"3 wide, not 4\."),
    (np.zeros(4), None, r"shape"),
    (np.float32(1), [0.5, 0.5], r"3 wide, not 0"),
    (np.float32(1), None, r"shape"),
    (OBSERVATIONS, preferences_for(2, 6), r"shape \(7, 3\) and preferences of shape \(6, 2\) do not match"),
    (OBSERVATIONS, preferences_for(2, 1), r"shape \(7, 3\) and preferences of shape \(1, 2\) do not match"),
    (OBSERVATIONS[0], preferences_for(2), r"shape \(3,\) and preferences of shape \(7, 2\) do not match"),
    (OBSERVATIONS, preferences_for(3), r"shape \(7, 3\): give 2 weights"),
]


@pytest.mark.parametrize(("observation", "preference", "match"), PREDICTION_ERRORS)
def test_a_prediction_that_cannot_be_made_is_an_error_that_says_why(trained, observation, preference, match):
    with pytest.raises(ValueError, match=match):
        trained.predict(observation, preference=preference)


def test_predict_does_not_change_its_arguments(trained):
    observations, w = OBSERVATIONS.copy(), np.array([-1e-7, 1.0])
    trained.predict(observations, preference=w)
    np.testing.assert_array_equal(observations, OBSERVATIONS)
    np.testing.assert_array_equal(w, [-1e-7, 1.0])


# ------------------------------------------------------------------------------------------------- environments


def test_evaluate_policy_of_stable_baselines3_returns_the_scalarised_return(trained):
    env = PreferenceWrapper(StubEnv(episode_length=4), FixedSampler((0.25, 0.75)))
    returns, lengths = evaluate_policy(trained, Monitor(env), n_eval_episodes=2, return_episode_rewards=True, warn=False)
    vectors = np.array([reward_of(t, 2) for t in range(1, 9)]).reshape(2, 4, 2).sum(axis=1)
    np.testing.assert_allclose(returns, vectors @ [0.25, 0.75], rtol=1e-6)
    assert lengths == [4, 4]
    venv = make_mo_vec_env(partial(StubEnv, episode_length=4), 2, preference_sampler=FixedSampler((0.25, 0.75)))
    mean, std = evaluate_policy(trained, venv, n_eval_episodes=2)
    assert (mean, std) == (pytest.approx(returns[0]), 0)


def test_set_env_goes_on_in_another_environment():
    model = tiny_model(StubEnv(), preference_sampler=FixedSampler((0.25, 0.75))).learn(30)
    env = StubEnv()
    model.set_env(env)
    model.learn(12, reset_num_timesteps=False)
    assert env.n_steps == 12
    assert model.num_timesteps == 42
    np.testing.assert_array_equal(model.replay_buffer.rewards[30:42, 0], [reward_of(t, 2) for t in range(1, 13)])
    assert (model.replay_buffer.preferences[30:42] == [0.25, 0.75]).all()
    model.set_env(make_mo_vec_env(StubEnv))
    assert model.learn(5, reset_num_timesteps=False).num_timesteps == 47


@pytest.mark.parametrize(
    ("env_kwargs", "n_envs", "match"),
    [
        ({"n_objectives": 3, "observation_dim": 2}, 1, r"2 objectives, .* 3|Observation spaces do not match"),
        ({"observation_dim": 4}, 1, "Observation spaces do not match"),
        ({"action_dim": 3}, 1, "Action spaces do not match"),
        ({}, 2, r"2 != 1"),
    ],
)
def test_set_env_with_another_kind_of_environment_is_an_error_and_keeps_the_old_one(env_kwargs, n_envs, match):
    model = tiny_model(StubEnv()).learn(5)
    old = model.env
    with pytest.raises((ValueError, AssertionError), match=match):
        model.set_env(make_mo_vec_env(StubEnv, n_envs, env_kwargs=env_kwargs))
    assert model.env is old
    assert model.learn(5, reset_num_timesteps=False).replay_buffer.pos == 10


def bounded_env(observation_dim: int, n_objectives: int) -> StubEnv:
    """Observations on [0, 1], like preferences: only the sum of both shows in the space of the wrapped environment."""
    return StubEnv(n_objectives, observation_dim=observation_dim, observation_space=spaces.Box(0.0, 1.0, (observation_dim,)))


def test_set_env_keeps_the_old_one_where_only_the_number_of_objectives_differs():
    model = tiny_model(bounded_env(observation_dim=3, n_objectives=2))
    old = model.env
    with pytest.raises(ValueError, match=r"2 objectives, the environment 3"):
        model.set_env(bounded_env(observation_dim=2, n_objectives=3))
    assert model.env is old


def test_an_id_makes_the_environment():
    model = tiny_model("mo-hopper-2obj-v5", learning_starts=5).learn(12)
    assert model.n_objectives == 2
    assert model._n_updates == 7
    assert model.predict(model.env.reset()[0, :11], preference=[0.3, 0.7])[0].shape == (3,)
    model.env.close()


@pytest.mark.parametrize("steps", [-5, float("nan"), "1e6", True], ids=str)
def test_wrong_numbers_of_steps_are_named(steps):
    with pytest.raises(ValueError, match=f"total_timesteps={steps!r}: give a number"):
        tiny_model(StubEnv()).learn(steps)
