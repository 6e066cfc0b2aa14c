"""What MOMBA can do beyond the thesis, one argument each: hand-computed numbers first, then what they refuse."""

import math

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.noise import NormalActionNoise

from sb3_momba import MOMBA, MombaCheckpointCallback, buffers, make_mo_vec_env
from sb3_momba.envs.preferences import corner_weights
from sb3_momba.exploration import HeldNoise, td3_smoothed
from sb3_momba.nn.normalization import DeviationScale, RewardCenter
from sb3_momba.policies import SHIPPED_POLICIES
from sb3_momba.settings import parse_target_entropy
from tests.stubs import TINY_SIMBA, StubEnv, tiny_model


def parameters_of(network: th.nn.Module) -> list[th.Tensor]:
    return [parameter.detach().clone() for parameter in network.parameters()]


def same(first: list[th.Tensor], second: list[th.Tensor], tolerance: float = 0.0) -> bool:
    return all(float((a - b).abs().max()) <= tolerance for a, b in zip(first, second, strict=True))


def trained(**kwargs) -> MOMBA:
    """A model with 40 transitions and no update yet."""
    return tiny_model(StubEnv(), learning_starts=100, **kwargs).learn(40)


# ------------------------------------------------------------------------------------------------------ policy_delay


def test_the_actor_and_alpha_move_with_every_third_update_and_the_critics_with_all():
    model = trained(policy_delay=3, learning_rate=1e-3)
    moved = []
    for _ in range(6):
        before = parameters_of(model.actor), parameters_of(model.critic), model.alpha.clone()
        model.train(1, 8)
        after = parameters_of(model.actor), parameters_of(model.critic), model.alpha
        # Unit rows are projected again in any case, which may change their last bit.
        moved.append(
            (not same(before[0], after[0], 1e-6), not same(before[1], after[1], 1e-6), not th.equal(before[2], after[2]))
        )
    assert moved == [(True, True, True), (False, True, False), (False, True, False)] * 2


def test_a_metric_is_the_mean_over_the_updates_that_had_it():
    model = trained(policy_delay=2)
    model.train(4, 8)
    assert model._metrics.counts["actor_loss"] == 2
    assert model._metrics.counts["critic_loss"] == 4
    logged = {}
    model._metrics.sums["actor_loss"] = th.tensor(3.0)
    model._metrics.record(type("Log", (), {"record": lambda _, name, value: logged.update({name: value})})())
    assert logged["train/actor_loss"] == 1.5


# --------------------------------------------------------------------------------------------------- entropy target


def test_the_target_of_a_standard_deviation():
    """FlashSAC's number: -0.478 for each dimension at 0.15."""
    assert parse_target_entropy("std_0.15", 1) == pytest.approx(-0.47818, abs=1e-5)
    assert parse_target_entropy("std_0.15", 6) == pytest.approx(6 * parse_target_entropy("std_0.15", 1))
    gaussian = th.distributions.Normal(0, 0.3).entropy()
    assert parse_target_entropy("std_0.3", 2) == pytest.approx(2 * float(gaussian), rel=1e-6)
    assert (parse_target_entropy("auto", 3), parse_target_entropy(-1.5, 3)) == (-3.0, -1.5)
    assert trained(target_entropy="std_0.15").target_entropy == pytest.approx(math.log(2 * math.pi * math.e * 0.0225))


@pytest.mark.parametrize("wrong", ["std_", "std_0", "std_-1", "std_inf", "std_x", "0.15", True, None], ids=str)
def test_a_wrong_target_is_named(wrong):
    with pytest.raises(ValueError, match=r"target_entropy=.*std_0\.15"):
        tiny_model(StubEnv(), target_entropy=wrong)


def test_alpha_has_a_learning_rate_of_its_own():
    """Adam's first step is the learning rate, whatever the gradient."""
    model = trained(ent_coef="auto_0.2", ent_coef_learning_rate=0.05, learning_rate=1e-3)
    model.train(1, 8)
    assert abs(math.log(float(model.alpha) / 0.2)) == pytest.approx(0.05, rel=1e-3)
    assert model.critic.optimizer.param_groups[0]["lr"] == model.actor.optimizer.param_groups[0]["lr"] == 1e-3


# ------------------------------------------------------------------------------------------------------ held noise


def lengths_of(noises: list[th.Tensor]) -> list[int]:
    """How long each value of a sequence stays."""
    changes = [i for i in range(1, len(noises)) if not th.equal(noises[i], noises[i - 1])]
    return np.diff([0, *changes]).tolist()


def test_noise_is_held_for_zeta_distributed_times_by_each_environment():
    """P(n) = n^-2 / (1 + 1/4 + 1/9) for n <= 3: 0.7347, 0.1837, 0.0816. Tolerances are four standard errors."""
    th.manual_seed(0)
    held = HeldNoise(3)
    noises = th.stack([held(th.zeros(2, 4)) for _ in range(20_000)])
    lengths = np.array(lengths_of(list(noises[:, 0])))
    assert set(lengths) == {1, 2, 3}
    np.testing.assert_allclose(np.bincount(lengths)[1:] / len(lengths), [36 / 49, 9 / 49, 4 / 49], atol=0.016)
    assert abs(float(noises.mean())) < 0.03
    assert float(noises.std()) == pytest.approx(1, abs=0.03)
    assert not th.equal(noises[:, 0], noises[:, 1])
    assert len(set(map(float, noises[0].flatten()))) == 8


def test_the_noise_of_longest_one_is_new_at_every_step():
    held = HeldNoise(1)
    assert set(lengths_of([held(th.zeros(1, 2)) for _ in range(50)])) == {1}


def test_actions_are_the_mean_and_the_deviation_under_the_held_noise():
    model = tiny_model(StubEnv(), noise_repeat=8, learning_starts=5)
    model.learn(30)
    last_obs = th.as_tensor(model._last_obs)
    with th.no_grad():
        mean, log_std = model.actor.distribution(model.policy.normalize(last_obs))
    _, scaled = model._sample_action(0)
    np.testing.assert_array_equal(scaled, th.tanh(mean + log_std.exp() * model._held_noise.noise).numpy())
    assert model._held_noise.steps_left.min() >= 0


def test_action_noise_is_added_to_held_noise():
    shifted = NormalActionNoise(np.full(2, 0.25), np.zeros(2))
    model = tiny_model(StubEnv(), noise_repeat=4, learning_starts=5, action_noise=shifted).learn(20)
    with th.no_grad():
        mean, log_std = model.actor.distribution(model.policy.normalize(th.as_tensor(model._last_obs)))
    _, scaled = model._sample_action(0, shifted)
    sampled = th.tanh(mean + log_std.exp() * model._held_noise.noise).numpy()
    np.testing.assert_allclose(scaled, np.clip(sampled + 0.25, -1, 1), rtol=1e-6)


@pytest.mark.filterwarnings("ignore:Environments .* could not be brought back")
def test_going_on_may_hold_noise_for_another_time(tmp_path):
    tiny_model(StubEnv(), noise_repeat=8, learning_starts=5).learn(30, MombaCheckpointCallback(30, tmp_path))
    again = MOMBA.resume(tmp_path, StubEnv(), noise_repeat=2)
    assert len(again._held_noise.probabilities) == again.noise_repeat == 2
    assert again._held_noise.noise is not None


# ----------------------------------------------------------------------------------------------------------- resets


@pytest.mark.parametrize("policy", [policy.__name__ for policy in SHIPPED_POLICIES])
def test_networks_start_again_and_the_rest_stays(policy):
    model = tiny_model(StubEnv(), policy=policy, learning_starts=100, reset_interval=3, learning_rate=1e-3).learn(40)
    first = parameters_of(model.critic)
    model.train(3, 8)
    trained_for_long, alpha = parameters_of(model.critic), model.alpha.clone()
    statistics = model.policy.statistics.state_dict()
    model.policy.reset_networks()
    new = parameters_of(model.critic)
    assert not same(first, new, 1e-3)
    assert not same(trained_for_long, new, 1e-3)
    assert same(new, parameters_of(model.critic_target))
    assert not any(parameter.requires_grad for parameter in model.critic_target.parameters())
    assert not model.critic.optimizer.state
    assert not model.actor.optimizer.state
    assert th.equal(alpha, model.alpha)
    assert all(th.equal(value, model.policy.statistics.state_dict()[name]) for name, value in statistics.items())
    model.train(2, 8)
    assert not same(new, parameters_of(model.critic), 1e-6)


def test_a_reset_comes_before_each_update_whose_number_the_interval_divides(monkeypatch):
    model, resets = trained(reset_interval=3), []
    monkeypatch.setattr(model.policy, "reset_networks", lambda: resets.append(model._n_updates))
    model.train(8, 8)
    assert resets == [3, 6]


def test_an_update_that_is_tried_again_has_had_its_reset(monkeypatch):
    model, resets = trained(reset_interval=3), []
    monkeypatch.setattr(model.policy, "reset_networks", lambda: resets.append(model._n_updates))
    model.train(3, 8)
    actor_loss = model._actor_loss
    monkeypatch.setattr(model, "_actor_loss", lambda *given: (actor_loss(*given)[0] * th.nan, None, {}))
    model.train(2, 8)
    monkeypatch.setattr(model, "_actor_loss", actor_loss)
    model.train(1, 8)
    assert model._n_updates == 4
    assert resets == [3]


@pytest.mark.parametrize("wrong", [0, 1.5, True], ids=str)
def test_a_wrong_interval_is_named(wrong):
    with pytest.raises(ValueError, match=f"reset_interval={wrong}.*whole number"):
        tiny_model(StubEnv(), reset_interval=wrong)


# ------------------------------------------------------------------------------------------------------------- TD3


def test_td3_explores_under_noise_around_the_mean_action():
    model = trained(td3_noise=0.1, ent_coef=0.0)
    mean = model.policy.scale_action(model.predict(model._last_obs, deterministic=True)[0])
    actions = np.array([model._sample_action(0)[1] for _ in range(1_000)])
    deviations = np.clip(actions, -0.999, 0.999) - mean
    assert np.abs(mean).max() < 0.5  # so that nothing is clipped
    np.testing.assert_allclose(deviations.mean(axis=0), 0, atol=4 * 0.1 / 1_000**0.5)
    np.testing.assert_allclose(deviations.std(axis=0), 0.1, rtol=0.09)


@pytest.mark.parametrize("policy", MOMBA.policy_aliases)
def test_td3_predicts_its_mean_action_whether_asked_for_a_sample_or_not(policy, tmp_path):
    model = tiny_model(StubEnv(), policy=policy, td3_noise=0.1, ent_coef=0.0)
    observation = StubEnv().observation_space.sample()
    model.policy.save(tmp_path / "policy")
    for one in (model.policy, type(model.policy).load(tmp_path / "policy", "cpu")):
        actions = [one.predict(np.append(observation, [0.5, 0.5]), deterministic=flag)[0] for flag in (False, False, True)]
        assert np.array_equal(*actions[:2])
        assert np.array_equal(*actions[1:])


def test_td3_targets_are_smoothed_by_twice_the_noise_and_clipped_at_five_times():
    th.manual_seed(0)
    noise = td3_smoothed(th.full((100_000, 1), 0.1), 0.1) - 0.1
    assert float(noise.abs().max()) == pytest.approx(0.5)
    # Of a normal deviate x, E[min(|x|, 2.5)^2] = 0.9776.
    assert float(noise.std()) == pytest.approx(0.2 * 0.9776**0.5, rel=0.01)
    assert float(td3_smoothed(th.ones(1_000, 1), 0.1).max()) == 1
    assert th.equal(td3_smoothed(th.full((3, 2), 0.3), 0.0), th.full((3, 2), 0.3))


def test_td3_learns_the_mean_action_alone():
    """The gradient of -min Q at the mean action, by hand; the standard deviation has none."""
    model = trained(td3_noise=0.1, ent_coef=0.0)
    batch = model._sample(8)
    loss, log_prob, _ = model._actor_loss(batch, model.alpha)
    actions = model.actor(batch.observations, deterministic=True)
    by_hand = -model.policy.value.mean(model.critic(batch.observations, actions)).squeeze(-1).min(dim=1).values.mean()
    assert float(loss.detach()) == pytest.approx(float(by_hand.detach()), rel=1e-6)
    assert not log_prob.any()
    gradients = th.autograd.grad(loss, list(model.actor.parameters()), allow_unused=True)
    named = zip(dict(model.actor.named_parameters()), gradients, strict=True)
    without = [name for name, gradient in named if gradient is None or not gradient.any()]
    assert without
    assert all(name.startswith("log_std_head") for name in without)
    before = parameters_of(model.actor)
    model.train(1, 8)
    assert not same(before, parameters_of(model.actor), 1e-6)
    assert model.alpha == 0


def test_td3_has_no_entropy_in_its_targets():
    model = trained(td3_noise=0.0, ent_coef=0.0, critic_loss="mse")
    batch = model._sample(8)
    loss, _ = model._critic_loss(batch, model.alpha)
    with th.no_grad():
        next_actions = model.actor(batch.next_observations, deterministic=True)
        next_q = model.critic_target(batch.next_observations, next_actions).flatten(1).min(dim=1).values
        rewards = (batch.rewards * batch.preferences).sum(dim=1)
        targets = rewards + batch.discounts * (1 - batch.dones) * next_q
        q = model.critic(batch.observations, batch.actions).flatten(1)
    assert float(loss.detach()) == pytest.approx(float((q - targets[:, None]).square().sum(dim=1).mean()), rel=1e-5)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"td3_noise": 0.1}, r"td3_noise=0\.1 with ent_coef='auto_0\.2'.*0\.0"),
        ({"td3_noise": -1.0, "ent_coef": 0.0}, r"td3_noise=-1\.0: give a deviation"),
        ({"td3_noise": 0.1, "ent_coef": 0.0, "deterministic_exploration": True}, "leave one of them out"),
        ({"noise_repeat": 2, "deterministic_exploration": True}, "noise_repeat=2 with deterministic_exploration"),
        ({"ent_coef": 0.1, "ent_coef_learning_rate": 1e-3}, "ent_coef_learning_rate=0.001 with ent_coef=0.1, which is fixed"),
        ({"replay_buffer_kwargs": {"n_relabels": 2}}, "n_relabels=2, where no preference is relabelled"),
        ({"replay_buffer_kwargs": {"corner_probability": 0.5}}, "corner_probability=0.5, where no preference is relabelled"),
        ({"her": True, "her_kwargs": {"n_relabels": 2, "keep_probability": 1.0}}, "n_relabels=2, where no"),
        ({"her": True, "replay_buffer_kwargs": {"n_relabels": 3}, "batch_size": 8}, "does not divide batch_size=8"),
        (
            {"reward_centering": True, "vector_values": True, "preference_alignment": "positive"},
            "preference_alignment='positive'",
        ),
        ({"reward_centering": True, "gamma": 1.0}, "reward_centering=True with gamma=1"),
    ],
    ids=[
        "TD3 with entropy",
        "negative noise",
        "two ways to explore",
        "noise of the mean",
        "rate of a fixed alpha",
        "relabels without HER",
        "corners without HER",
        "relabels that all keep",
        "rows",
        "cosines of centred values",
        "centres without bound",
    ],
)
def test_what_would_be_ignored_is_refused(arguments, said):
    with pytest.raises(ValueError, match=said):
        tiny_model(StubEnv(), **arguments)


def test_the_first_actions_stay_uniform():
    model = tiny_model(StubEnv(), noise_repeat=8, learning_starts=30).learn(20)
    assert model._held_noise.noise is None


# ------------------------------------------------------------------------------------------------------- relabelling


def test_several_relabels_of_each_transition():
    model = tiny_model(StubEnv(), her=True, her_kwargs={"n_relabels": 4, "keep_probability": 0.0}, learning_starts=100)
    model.learn(60)
    model.replay_buffer.preferences[:] = 0.5  # In a corner all four may be the corner itself.
    batch = model.replay_buffer.sample(32)
    actions = batch.actions.reshape(8, 4, -1)
    assert th.equal(actions, actions[:, :1].expand(-1, 4, -1))
    assert len(th.unique(actions[:, 0], dim=0)) > 1
    assert all(len(th.unique(w, dim=0)) == 4 for w in batch.preferences.reshape(8, 4, -1))
    model.train(2, 8)


@pytest.mark.parametrize(("n_relabels", "said"), [(3, "does not divide batch_size=8"), (0, "whole number"), (1.5, "whole")])
def test_wrong_numbers_of_relabels_are_named(n_relabels, said):
    with pytest.raises(ValueError, match=rf"n_relabels={n_relabels}.*{said}"):
        tiny_model(StubEnv(), her=True, her_kwargs={"n_relabels": n_relabels}, batch_size=8)


def test_relabelling_toward_corner_weights():
    """Returns (0, 10), (6, 8) and (10, 0) tie at w_1 = 1/4 and 2/3; (3, 3) is below the others everywhere."""
    model = tiny_model(
        StubEnv(), her=True, her_kwargs={"keep_probability": 0.0, "corner_probability": 0.5}, learning_starts=100, seed=0
    )
    model.learn(50)
    buffer = model.replay_buffer
    buffer.dones[:] = 0
    buffer.dones[[1, 11, 21, 31, 41]] = 1
    buffer.rewards[:50], buffer.preferences[:50] = 0, 0.5
    buffer.rewards[[1, 2, 11, 12, 13, 30, 41], 0] = [[90, 90], [0, 7], [0, 3], [2, 8], [4, 0], [10, 0], [3, 3]]
    assert buffer.newest_returns().tolist() == [[0, 10], [6, 8], [10, 0], [3, 3]]
    drawn = buffer.sample(4_000).preferences[:, 0].numpy()
    for corner in (0, 1 / 4, 2 / 3, 1):
        assert np.isclose(drawn, corner, atol=1e-6).mean() == pytest.approx(1 / 8, abs=0.03)


def test_corner_weights_are_computed_once_for_the_same_returns(monkeypatch):
    calls = []
    monkeypatch.setattr("sb3_momba.buffers.corner_weights", lambda values: calls.append(len(values)) or corner_weights(values))
    model = tiny_model(
        StubEnv(episode_length=5), her=True, her_kwargs={"keep_probability": 0.0, "corner_probability": 0.5}, learning_starts=10
    )
    model.learn(24)
    assert calls == [1, 2, 3]
    model.replay_buffer.end_episodes()
    model.replay_buffer.sample(8)
    assert calls == [1, 2, 3, 4]


def test_corner_weights_of_many_objectives_are_refused():
    kwargs = {"her": True, "her_kwargs": {"corner_probability": 0.5}}
    tiny_model(StubEnv(6), **kwargs)
    with pytest.raises(ValueError, match=r"corner_probability=0\.5 with 7 objectives.*beyond 6: set it to 0"):
        tiny_model(StubEnv(7), **kwargs)


def test_before_two_episodes_have_ended_there_are_no_corners():
    model = tiny_model(StubEnv(), her=True, her_kwargs={"corner_probability": 1.0}, learning_starts=100).learn(3)
    assert len(model.replay_buffer.newest_returns()) == 0
    assert len(th.unique(model.replay_buffer.sample(64).preferences[:, 0])) > 10


def test_newest_returns_go_round_the_end_of_the_memory():
    whole, ring = (tiny_model(StubEnv(), buffer_size=size, learning_starts=1_000, seed=0).learn(130) for size in (1_000, 50))
    expected, returns = whole.replay_buffer.newest_returns(), ring.replay_buffer.newest_returns()
    assert 0 < len(returns) < len(expected)
    np.testing.assert_allclose(returns, expected[-len(returns) :])


def test_newest_returns_are_of_each_environment_and_of_the_newest_transitions(monkeypatch):
    model = MOMBA(
        "SimbaPolicy",
        make_mo_vec_env(StubEnv, 3),
        buffer_size=300,
        learning_starts=1_000,
        policy_kwargs=TINY_SIMBA,
        device="cpu",
    ).learn(60)
    buffer = model.replay_buffer
    buffer.rewards[:20], buffer.dones[:20] = 1, 0
    buffer.dones[[3, 9, 14], 0] = buffer.dones[[7, 19], 2] = 1  # in the second environment no episode ends
    assert buffer.newest_returns().tolist() == [[6, 6], [5, 5], [12, 12]]
    monkeypatch.setattr(buffers, "EPISODES_OF_FRONT", 3)
    assert buffer.newest_returns().tolist() == [[5, 5], [12, 12]]
    monkeypatch.setattr(buffers, "STEPS_OF_FRONT", 3 * 12)  # the rows from 8 on
    assert buffer.newest_returns().tolist() == [[5, 5]]


def test_nearly_equal_solutions_have_the_corners_of_one():
    values = 5 + 1e-13 * np.random.default_rng(0).normal(size=(18, 4))
    assert sorted(corner_weights(values).tolist()) == np.eye(4)[::-1].tolist()


@pytest.mark.parametrize("values", [np.ones((3, 1)), np.ones((0, 2)), np.array([[1.0, np.nan]])], ids=["one", "none", "NaN"])
def test_values_without_corners_are_refused(values):
    with pytest.raises(ValueError, match="give finite ones of one solution or more, two objectives or more"):
        corner_weights(values)


@pytest.mark.parametrize("n_objectives", [2, 3, 4])
def test_at_a_corner_weight_as_many_solutions_tie_as_weights_are_positive(n_objectives):
    values = np.random.default_rng(0).normal(size=(20, n_objectives))
    corners = corner_weights(values)
    assert {tuple(corner) for corner in np.eye(n_objectives)} < {tuple(w) for w in corners.tolist()}
    for w in corners:
        utilities = np.sort(values @ w)
        positive = int((w > 1e-9).sum())
        np.testing.assert_allclose(utilities[-positive:], utilities[-1], atol=1e-6)


def test_corner_weights_of_a_single_solution_are_the_corners_of_the_simplex():
    assert corner_weights(np.array([[1.0, -2.0, 3.0]])).tolist() == [[0, 0, 1], [0, 1, 0], [1, 0, 0]]
    assert corner_weights(np.zeros((4, 2))).tolist() == [[0, 1], [1, 0]]


# ---------------------------------------------------------------------------------------------------- return scaling


def test_rewards_are_divided_by_the_largest_deviation_or_by_what_keeps_the_maximum_within_bounds():
    """gamma = 0.5. Rewards (4, 1), (0, 1), (0, 1): G is (4, 1), (2, 1.5), (1, 1.75). Its first part has the variance 14/9
    and the maximum 4."""
    scale = DeviationScale(5.0, 0.5, 2)
    assert scale.factor() == 1
    for reward in ([4.0, 1.0], [0.0, 1.0], [0.0, 1.0]):
        scale.update(np.array([reward]), np.array([False]))
    assert 4 / 5 < (14 / 9) ** 0.5
    assert scale.factor() == pytest.approx((9 / 14) ** 0.5)
    tight = DeviationScale(2.0, 0.5, 2)
    for reward in ([4.0, 1.0], [0.0, 1.0], [0.0, 1.0]):
        tight.update(np.array([reward]), np.array([False]))
    assert tight.factor() == pytest.approx(2 / 4)
    assert tight.factor(8.0) == pytest.approx(2 / 8)
    two_environments = DeviationScale(5.0, 0.5, 1)
    two_environments.update(np.array([[1.0], [3.0]]), np.array([False, False]))
    assert two_environments.factor() == pytest.approx(1 / 1)


def test_returns_that_are_all_equal_have_no_deviation_to_divide_by():
    scale = DeviationScale(5.0, 0.0, 1)
    for _ in range(3):
        scale.update(np.array([[2.0], [2.0]]), np.array([False, False]))
    assert scale.factor() == pytest.approx(5 / 2)


def test_the_deviation_scales_a_training_and_is_saved(tmp_path):
    model = tiny_model(StubEnv(), return_scaling="deviation", best_return_scale=5.0).learn(60)
    scale = model.policy.return_scale
    assert isinstance(scale, DeviationScale)
    assert float(scale.statistics.count) == 60
    model.save(tmp_path / "model")
    assert MOMBA.load(tmp_path / "model").policy.reward_factor == scale.factor() != 1
    with pytest.raises(ValueError, match="return_scaling='deviation' with best_return_scale=None"):
        tiny_model(StubEnv(), return_scaling="deviation", best_return_scale=None)
    with pytest.raises(ValueError, match="return_scaling='mean' is not known"):
        tiny_model(StubEnv(), return_scaling="mean")


# --------------------------------------------------------------------------------------------------- reward centring


def seen_by_a_center() -> RewardCenter:
    """Rewards (2, 0) and (4, 2), on average (3, 1), which are worth (6, 2) for ever with gamma = 0.5."""
    center = RewardCenter(2, 0.5)
    center.statistics.update(np.array([[2.0, 0.0], [4.0, 2.0]]))
    return center


def test_what_critics_learn_is_less_by_what_the_mean_reward_is_worth():
    center = seen_by_a_center()
    assert center.value.tolist() == [6, 2]
    discounts = th.tensor([0.5, 0.25, 0.0])  # one step, two, the end
    assert center(th.ones(3, 2), discounts).tolist() == [[-2, 0], [-3.5, -0.5], [-5, -1]]
    # R + d Q for any Q is by V more than what becomes of it.
    rewards, values = th.rand(3, 2), th.rand(3, 2)
    without = rewards + discounts[:, None] * values
    with_it = center(rewards, discounts) + discounts[:, None] * (values - center.value)
    th.testing.assert_close(without - center.value, with_it, check_dtype=False)


def test_the_scale_of_centred_returns_knows_what_an_end_is_worth_before_one_comes():
    """Rewards (2, 0), (4, 2) and (-18, -2), whose means (2, 0), (3, 1) and (-4, 0) are worth (4, 0), (6, 2) and (-8, 0) with
    gamma = 0.5. Less the mean they are (0, 0), (1, 1) and (-14, -2): G is the same, after an end between the last two."""
    policy = tiny_model(StubEnv(), reward_centering=True, gamma=0.5).policy
    for reward, done, largest in (([2.0, 0.0], False, 4), ([4.0, 2.0], True, 6), ([-18.0, -2.0], False, 14)):
        policy.observe_rewards(np.array([reward]), np.array([done]))
        assert policy.reward_factor == pytest.approx(3 / largest)


def test_what_the_first_mean_was_worth_is_not_kept():
    """One bad step, then good ones: the mean -100 is worth -200, later 1 - 101/400 is worth 1.5."""
    policy = tiny_model(StubEnv(n_objectives=1), reward_centering=True, gamma=0.5).policy
    policy.observe_rewards(np.array([[-100.0]]), np.array([True]))
    assert policy.reward_factor == pytest.approx(3 / 200)
    for _ in range(399):
        policy.observe_rewards(np.array([[1.0]]), np.array([False]))
    assert policy.reward_center.value.item() == pytest.approx(2 * (1 - 101 / 400))
    assert policy.reward_factor == pytest.approx(3 / float(policy.return_scale.max_return))
    assert float(policy.return_scale.max_return) < 100


def test_equal_rewards_leave_no_rounding_to_be_scaled_up():
    policy = tiny_model(StubEnv(n_objectives=1), reward_centering=True).policy
    for _ in range(300):
        policy.observe_rewards(np.full((2, 1), -0.1, dtype=np.float32), np.zeros(2, dtype=bool))
    assert policy.return_scale.factor() == 1
    assert policy.reward_factor == pytest.approx(3 / 10)


@pytest.mark.parametrize(("ending", "n_steps"), [("terminated", 1), ("terminated", 3), ("truncated", 1), ("truncated", 3)])
@pytest.mark.parametrize("vector", [True, False], ids=["vector", "scalarised"])
def test_centred_critics_learn_the_values_that_others_learn(ending, n_steps, vector):
    """(1, 3), then (5, 1), with gamma = 0.5: (3.5, 3.5) and (5, 1) where episodes end after two steps. Where a time limit cuts
    what would go on in turns, (1, 3) comes with 1 / (1 - 1/4) of (3.5, 3.5), (5, 1) with as much of (5.5, 2.5)."""
    rewards = {t: np.array([1.0, 3.0] if t % 2 == 1 else [5.0, 1.0]) for t in range(2_000)}
    observations = {t: np.full(3, t % 2, dtype=np.float32) for t in range(2_000)}
    env = StubEnv(episode_length=2, ending=ending, rewards=rewards, observations=observations)
    settings = {"gamma": 0.5, "n_steps": n_steps, "vector_values": vector, "critic_loss": "mse", "ent_coef": 0.0}
    model = tiny_model(env, reward_centering=True, learning_rate=3e-3, tau=0.1, **settings).learn(600)
    batch = model.replay_buffer.sample(200)
    with th.no_grad():
        q = model.policy.value.mean(model.critic(model.policy.normalize(batch.observations), batch.actions)).mean(dim=1).numpy()
    w = batch.preferences.numpy()
    first, second = ([3.5, 3.5], [5, 1]) if ending == "terminated" else ([14 / 3, 14 / 3], [22 / 3, 10 / 3])
    expected = np.where(batch.observations[:, :1].numpy() == 0, first, second)
    error = model.policy.in_reward_units(q, w) - (expected if vector else (expected * w).sum(axis=1, keepdims=True))
    assert np.abs(error).mean() < 0.3


def test_the_center_is_saved(tmp_path):
    model = tiny_model(StubEnv(ending="terminated"), reward_centering=True).learn(60)
    model.save(tmp_path / "model")
    loaded = MOMBA.load(tmp_path / "model").policy
    assert float(loaded.reward_center.statistics.count) == 60
    assert th.equal(loaded.reward_center.value, model.policy.reward_center.value)


@pytest.mark.parametrize("vector", [True, False], ids=["vector", "scalarised"])
def test_values_in_the_units_of_the_rewards_by_hand(vector):
    """V = (6, 2), and rewards were halved."""
    policy = tiny_model(StubEnv(), vector_values=vector, reward_centering=True, gamma=0.5).policy
    policy.reward_center = seen_by_a_center()
    policy.return_scale.max_return.fill_(6.0)
    w = np.array([[0.5, 0.5], [0.25, 0.75]])
    values = np.array([[1.0, 2.0], [3.0, 4.0]]) if vector else np.array([[1.0], [2.0]])
    assert policy.in_reward_units(values, w).tolist() == ([[8, 6], [12, 10]] if vector else [[6], [7]])


# -------------------------------------------------------------------------------------------------------- all of it


@pytest.mark.parametrize("name", ["policy_delay", "noise_repeat"])
@pytest.mark.parametrize("wrong", [0, -1, 1.5, True], ids=str)
def test_wrong_whole_numbers_are_named(name, wrong):
    with pytest.raises(ValueError, match=rf"{name}={wrong}.*whole number of at least 1"):
        tiny_model(StubEnv(), **{name: wrong})


@pytest.mark.parametrize("wrong", [-1e-3, "fast", float("nan")], ids=str)
def test_a_wrong_learning_rate_of_alpha_is_named(wrong):
    with pytest.raises(ValueError, match="ent_coef_learning_rate="):
        tiny_model(StubEnv(), ent_coef_learning_rate=wrong)
