"""The variants of chapter 4: conditioning, normalisation, preference samplers, shipped configurations and the command line."""

import csv
import itertools
import json
from pathlib import Path
from unittest.mock import Mock

import mo_gymnasium
import numpy as np
import pytest
import torch as th
import yaml
from mo_gymnasium.wrappers.wrappers import LinearReward

from sb3_momba import MOMBA, ParetoEvalCallback, ParetoFront, PreferenceWrapper
from sb3_momba.envs.preferences import ConeSampler, FixedSampler, GainSampler, PerStepSampler, UniformSampler, make_sampler
from sb3_momba.envs.registry import TASKS
from sb3_momba.nn.layers import Film, HyperDense
from sb3_momba.nn.networks import CONDITIONINGS
from sb3_momba.train import main, parse
from sb3_momba.zoo.configuration import (
    SHIPPED,
    check_hyperparameters,
    read_configuration,
    shipped_configurations,
    with_schedules,
)
from tests.stubs import TINY_MLP, TINY_SIMBA, StubEnv

POLICIES = {"SimbaPolicy": TINY_SIMBA, "MlpPolicy": TINY_MLP, "FlashSacPolicy": TINY_SIMBA}
POLICIES["XqcPolicy"] = {**TINY_SIMBA, "actor_blocks": 2, "critic_blocks": 2}  # the first reads the input


def model_of(policy: str = "SimbaPolicy", **policy_kwargs) -> MOMBA:
    kwargs = {**POLICIES[policy], **policy_kwargs}
    return MOMBA(policy, StubEnv(), seed=0, device="cpu", buffer_size=100, policy_kwargs=kwargs)


def observations_of(model: MOMBA, n: int = 16) -> th.Tensor:
    """[s, w] of the model's shape, as networks read them."""
    rng = np.random.default_rng(0)
    w = rng.dirichlet(np.ones(model.n_objectives), n)
    return th.as_tensor(np.concatenate([rng.normal(size=(n, model.policy.observation_dim)), w], axis=1), dtype=th.float32)


# -------------------------------------------------------------------------------------------------- conditioning, 4.3.4


def first_layer(network: th.nn.Module) -> th.nn.Module:
    return network.trunk.embedder.dense if hasattr(network.trunk, "embedder") else network.trunk.layers[0]


def hide_preference_from_the_first_layer(model: MOMBA) -> None:
    """Zero the weights of w in the layers that read the input: what still depends on w gets it further in."""
    n, d = model.policy.observation_dim, model.n_objectives
    for network in (model.actor, model.critic):
        first_layer(network).weight.data[..., n : n + d, :] = 0


def perturb_films(model: MOMBA) -> None:
    for module in model.policy.modules():
        if isinstance(module, Film):
            th.nn.init.normal_(module.affine.weight)


def preference_gradients(model: MOMBA) -> list[float]:
    """Largest gradient of the actor's and of the critics' outputs with respect to w.

    The norm of SimbaV2's embedder mixes all inputs into each: that path is cut by scaling w, not s, to nothing."""
    observations = observations_of(model)
    s, w = observations[:, : model.policy.observation_dim], observations[:, model.policy.observation_dim :]
    w = w.clone().requires_grad_(True)
    outputs = (model.actor.distribution(th.cat([s, w], 1))[0], model.critic(th.cat([s, w], 1), th.zeros(len(s), 2)))
    return [th.autograd.grad(output.square().sum(), w)[0].abs().max().item() for output in outputs]


@pytest.mark.parametrize("policy", POLICIES)
def test_film_equals_input_at_the_start(policy: str) -> None:
    plain, film = model_of(policy), model_of(policy, conditioning="film")
    for name, parameter in plain.policy.named_parameters():
        film.policy.get_parameter(name).data.copy_(parameter)
    observations = observations_of(plain)
    actions = th.zeros(len(observations), 2)
    th.testing.assert_close(film.actor.distribution(observations), plain.actor.distribution(observations))
    th.testing.assert_close(film.critic(observations, actions), plain.critic(observations, actions))


@pytest.mark.parametrize(("conditioning", "depends"), [("input", False), ("all", True), ("film", True), ("film+all", True)])
@pytest.mark.parametrize("policy", POLICIES)
def test_stronger_conditioning_reaches_beyond_the_first_layer(policy: str, conditioning: str, depends: bool) -> None:
    model = model_of(policy, conditioning=conditioning, **({"normalize_features": False} if policy == "SimbaPolicy" else {}))
    perturb_films(model)
    assert min(preference_gradients(model)) > 0
    hide_preference_from_the_first_layer(model)
    gradients = preference_gradients(model)
    assert min(gradients) > 1e-6 if depends else max(gradients) == 0


def test_conditioning_widens_what_it_says() -> None:
    """Tiny networks, 8 wide with one block of 32; d = 2. all: 2 x 32 more; film: 2 x 16 weights and 16 biases more."""
    counts = {c: sum(p.numel() for p in model_of(conditioning=c).actor.parameters()) for c in CONDITIONINGS}
    more = {c: counts[c] - counts["input"] for c in CONDITIONINGS}
    assert more == {"input": 0, "all": 64, "film": 48, "film+all": 112}


def test_an_unknown_conditioning_is_an_error_that_names_the_known() -> None:
    with pytest.raises(ValueError, match=r"conditioning='hyper' is not known: use one of input, all, film, film\+all"):
        model_of(conditioning="hyper")


def test_one_objective_has_nothing_to_condition_on() -> None:
    kwargs = {"buffer_size": 10, "policy_kwargs": {**TINY_SIMBA, "conditioning": "film"}}
    with pytest.raises(ValueError, match="no preference to condition on"):
        MOMBA("SimbaPolicy", StubEnv(n_objectives=None), **kwargs)


# ------------------------------------------------------------------------------------------------- normalisation, 4.3.3


def weight_norms(model: MOMBA) -> np.ndarray:
    layers = [m for network in (model.actor, model.critic) for m in network.modules() if isinstance(m, HyperDense)]
    return np.concatenate([layer.weight.detach().norm(dim=-2).flatten().numpy() for layer in layers])


def trained_with(**switches: bool) -> MOMBA:
    model = model_of(**switches)
    model.learning_starts = 20
    return model.learn(40)


@pytest.mark.parametrize("on", [True, False])
def test_weight_normalisation_keeps_unit_rows_and_nothing_else_does(on: bool) -> None:
    model = trained_with(normalize_weights=on)
    assert np.allclose(weight_norms(model), 1, atol=1e-6) == on


def test_without_weight_normalisation_training_changes_weight_norms() -> None:
    model = model_of(normalize_weights=False)
    before = weight_norms(model)
    model.learning_starts = 20
    model.learn(40)
    assert not np.allclose(weight_norms(model), before, atol=1e-4)


@pytest.mark.parametrize("on", [True, False])
def test_feature_normalisation_puts_features_on_the_sphere(on: bool) -> None:
    model = model_of(normalize_features=on)
    observations = observations_of(model)
    norms = model.critic.values_and_features(observations, th.zeros(len(observations), 2))[1].norm(dim=-1)
    assert th.allclose(norms, th.ones_like(norms), atol=1e-5) == on


@pytest.mark.parametrize("on", [True, False])
def test_observation_normalisation_touches_observations_only(on: bool) -> None:
    model = model_of(normalize_observations=on)
    model.policy.statistics.update(np.array([[1.0, 2, 3], [3.0, 4, 9]]))
    raw = th.tensor([[3.0, 2.0, 6.0, 0.25, 0.75]])
    expected = [1, -1, 0, 0.25, 0.75] if on else [3, 2, 6, 0.25, 0.75]
    np.testing.assert_allclose(model.policy.normalize(raw)[0], expected, rtol=1e-5)


def test_each_switch_leaves_the_other_two_alone() -> None:
    """Same seed, same start: a switch changes neither parameters nor outputs that are not its own."""
    reference = model_of()
    for switch in ("normalize_features", "normalize_observations", "normalize_weights"):
        model = model_of(**{switch: False})
        same = all(th.equal(p, q) for p, q in zip(reference.policy.parameters(), model.policy.parameters(), strict=True))
        assert same == (switch != "normalize_weights")
        assert (weight_norms(model).max() - 1 < 1e-6) == (switch != "normalize_weights" or weight_norms(model).max() - 1 < 1e-6)
        observations = observations_of(model)
        norms = model.critic.values_and_features(observations, th.zeros(len(observations), 2))[1].norm(dim=-1)
        assert th.allclose(norms, th.ones_like(norms), atol=1e-5) == (switch != "normalize_features")


# ----------------------------------------------------------------------------------------------------------- samplers


@pytest.mark.parametrize("n_objectives", [2, 3, 6])
def test_cone_stays_within_its_angle_and_fills_it(n_objectives: int) -> None:
    rng = np.random.default_rng(0)
    draws = np.array([ConeSampler(n_objectives, 22.5)(rng) for _ in range(4_000)])
    np.testing.assert_allclose(draws.sum(axis=1), 1)
    cosines = draws.sum(axis=1) / (np.linalg.norm(draws, axis=1) * np.sqrt(n_objectives))
    angles = np.rad2deg(np.arccos(np.clip(cosines, -1, 1)))
    assert angles.max() <= 22.5 + 1e-6
    assert angles.mean() == pytest.approx(11.25, abs=0.5)  # uniform in the angle
    np.testing.assert_allclose(draws.mean(axis=0), 1 / n_objectives, atol=0.02)


def test_gain_is_where_the_latest_answer_is_far_from_the_best() -> None:
    """The answer to (1, 0) earns 1 of it, the one to (0, 1) 3: around (1, 0) there are 2 to gain. Around (0, 1) nothing."""
    sampler, rng = GainSampler(2, candidates=100), np.random.default_rng(0)
    preferences, returns = np.array([[1.0, 0.0], [0.0, 1.0]]), np.array([[1.0, 0.0], [3.0, 1.0]])
    draws = np.array([sampler(rng, preferences, returns) for _ in range(20)])
    assert (draws[:, 0] > 0.9).all()
    np.testing.assert_allclose(draws.sum(axis=1), 1)
    better = np.array([*returns, [4.0, 0.0]])  # the latest answer to (1, 0) counts: nothing to gain there
    draws = np.array([sampler(rng, np.array([*preferences, [1.0, 0.0]]), better) for _ in range(20)])
    assert (draws[:, 0] > 0.9).mean() < 0.5
    nothing = np.zeros((0, 2))
    assert np.mean([sampler(rng, nothing, nothing)[0] for _ in range(400)]) == pytest.approx(0.5, abs=0.05)


def test_a_sampler_with_a_memory_is_told_of_the_latest_episodes() -> None:
    told: list[tuple[np.ndarray, np.ndarray]] = []

    class Asked:
        remembered_episodes = 2

        def __call__(self, rng: np.random.Generator, preferences: np.ndarray, returns: np.ndarray) -> np.ndarray:
            told.append((preferences, returns))
            return np.array([len(told), 10 - len(told)]) / 10

    env = PreferenceWrapper(StubEnv(), Asked())
    earned = []
    for _ in range(4):
        env.reset()
        earned.append(play(env))
    assert [len(preferences) for preferences, _ in told] == [0, 1, 2, 2]
    np.testing.assert_allclose(told[-1][0], [[0.2, 0.8], [0.3, 0.7]], rtol=1e-6)
    np.testing.assert_allclose(told[-1][1], earned[1:3], rtol=1e-6)
    env.reset(seed=0)  # Everything from here on follows from the seed.
    assert len(told[-1][0]) == 0
    play(env)
    env.set_preference_sampler(Asked())  # of another training
    env.reset()
    assert len(told[-1][0]) == 0


def play(env: PreferenceWrapper) -> np.ndarray:
    """What the rest of an episode earns, (n_objectives,)."""
    vector_return, over = np.zeros(2), False
    while not over:
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        vector_return, over = vector_return + info["vector_reward"], terminated or truncated
    return vector_return


def test_samplers_from_literals() -> None:
    assert make_sampler("uniform", 3) == UniformSampler(3)
    assert make_sampler({"name": "cone", "angle": 10.0}, 2) == ConeSampler(2, 10.0)
    assert make_sampler({"name": "fixed", "preference": [0.25, 0.75]}, 2) == FixedSampler((0.25, 0.75))
    assert make_sampler({"name": "gain", "remembered_episodes": 9}, 2) == GainSampler(2, remembered_episodes=9)
    assert make_sampler({"name": "uniform", "per_step": True}, 2) == PerStepSampler(UniformSampler(2))
    own = UniformSampler(2)
    assert make_sampler(own, 2) is own


@pytest.mark.parametrize(
    ("spec", "match"),
    [
        ("sphere", "name must be uniform, cone, gain or fixed, not 'sphere'"),
        ({"name": "gain", "remembered_episodes": 0}, "remembered_episodes=0: it must be a whole number of at least 1"),
        ({"name": "gain", "per_step": True}, "leave per_step out"),
        ({"name": "cone", "radius": 3}, "radius"),
        ({"name": "fixed"}, "preference"),
        ({"name": "fixed", "preference": [0.5, 0.6]}, "sums to 1.1"),
    ],
)
def test_a_sampler_that_is_not_understood_is_an_error(spec, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        MOMBA("SimbaPolicy", StubEnv(), buffer_size=10, preference_sampler=spec, policy_kwargs=TINY_SIMBA)


def test_fixed_preference_training() -> None:
    """Section 4.2.4: one preference for the whole training, in every stored transition."""
    sampler = {"name": "fixed", "preference": [0.3, 0.7]}
    model = MOMBA(
        "SimbaPolicy", StubEnv(), buffer_size=50, learning_starts=10, preference_sampler=sampler, policy_kwargs=TINY_SIMBA
    )
    model.learn(30)
    np.testing.assert_allclose(model.replay_buffer.preferences[:30, 0], np.tile([0.3, 0.7], (30, 1)), rtol=1e-6)


def test_deterministic_exploration_collects_the_mean_action() -> None:
    env = PreferenceWrapper(StubEnv())
    model = MOMBA(
        "SimbaPolicy",
        env,
        buffer_size=50,
        learning_starts=5,
        deterministic_exploration=True,
        gradient_steps=0,
        policy_kwargs=TINY_SIMBA,
    )
    model.learn(15)
    buffer = model.replay_buffer
    seen = np.concatenate([buffer.observations[6:15, 0], buffer.preferences[6:15, 0]], axis=1)
    # The statistics have gone on since: compare with those of the last step only.
    action = model.policy.scale_action(model.predict(seen[-1], deterministic=True)[0])
    np.testing.assert_allclose(buffer.actions[14, 0], action, atol=0.05)


# ------------------------------------------------------------------------------------------------------ configurations


@pytest.mark.parametrize("name", shipped_configurations())
def test_shipped_configurations_build_models(name: str) -> None:
    configuration = read_configuration(name, "StubEnv-v0")
    assert configuration.n_timesteps == (200_000 if name == "momba_plus" else 1_000_000)
    hyperparameters = with_schedules({**configuration.hyperparameters, "buffer_size": 10})
    model = MOMBA(configuration.policy, StubEnv(), device="cpu", **hyperparameters)
    assert model.policy_kwargs == configuration.hyperparameters.get("policy_kwargs", {})


@pytest.mark.parametrize("env_id", sorted(TASKS))
def test_momba_plus_differs_between_tasks_in_what_stands_here_alone(env_id: str) -> None:
    hopper = {"n_steps", "tau"}
    own = {
        "MO-HalfCheetah-v4": {"gamma"},
        "MO-Hopper-v4": hopper,
        "MO-Hopper-3obj-v4": hopper,
        "MO-Walker2d-v4": hopper,
        "MO-Swimmer-v4": hopper | {"gamma", "noise_repeat"},
    }
    default, entry = (read_configuration("momba_plus", name) for name in ("StubEnv-v0", env_id))
    settings, own_settings = ({**x.hyperparameters.pop("policy_kwargs"), **x.hyperparameters} for x in (default, entry))
    differing = {name for name in settings | own_settings if settings.get(name) != own_settings.get(name)}
    assert differing == own.get(env_id, set())
    assert entry.n_timesteps == default.n_timesteps


def test_momba_yml_is_the_default() -> None:
    hyperparameters = {**read_configuration("momba", "x").hyperparameters, "buffer_size": 10}
    written = MOMBA("SimbaPolicy", StubEnv(), device="cpu", seed=0, **hyperparameters)
    default = MOMBA("SimbaPolicy", StubEnv(), device="cpu", seed=0, buffer_size=10)
    different = {
        name
        for name, value in vars(default).items()
        if isinstance(value, int | float | str | bool | None) and value != getattr(written, name)
    }
    assert different == set()
    pairs = zip(written.policy.parameters(), default.policy.parameters(), strict=True)
    assert all(th.equal(p, q) for p, q in pairs)


def test_the_grids_of_chapter_4_are_complete() -> None:
    names = set(shipped_configurations())
    value = {
        f"value_{a}_{loss}_{v}" for a, loss, v in itertools.product(("simba", "mlp"), ("ce", "mse"), ("scalarised", "vector"))
    }
    switches = ("fn", "on", "wn")
    normalisation = {
        "normalization_" + ("_".join(kept) or "none") for n in range(3) for kept in itertools.combinations(switches, n)
    }
    conditioning = {"conditioning_all", "conditioning_film", "conditioning_film_all"}
    assert value | normalisation | conditioning | {"her", "par", "her_par", "utd_8", "momba", "capql", "capql_uniform"} <= names


def test_an_entry_of_the_environment_goes_before_the_default(tmp_path) -> None:
    path = tmp_path / "mine.yml"
    path.write_text("default:\n  gamma: 0.9\nHop-v1:\n  gamma: 0.8\n  n_timesteps: !!float 2e4\n  train_freq: [1, 'episode']\n")
    assert read_configuration(str(path), "Run-v1").hyperparameters == {"gamma": 0.9}
    mine = read_configuration(str(path), "Hop-v1")
    assert mine.hyperparameters == {"gamma": 0.8, "train_freq": [1, "episode"]}
    assert mine.n_timesteps == 20_000


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("default:\n  learnin_rate: 1.0\n", "no hyperparameter 'learnin_rate': did you mean 'learning_rate'"),
        ("default:\n  policy_kwargs:\n    actor_block: 1\n", "no argument 'actor_block': did you mean 'actor_blocks'"),
        ("default:\n  policy_kwargs: 'dict(actor_blocks=1)'\n", "nothing is evaluated"),
        ("default:\n  policy: 'SimbPolicy'\n", "'SimbPolicy' is not known: did you mean 'SimbaPolicy'"),
        ("default:\n  normalize: true\n", "normalises observations and rewards itself"),
        ("default: !!python/object/apply:os.system ['true']\n", "not valid yaml, or asks for Python objects"),
        ("other:\n  gamma: 0.9\n", "no entry 'Hop-v1' and no 'default'"),
        ("- 1\n", "no entry 'Hop-v1'"),
    ],
)
def test_a_bad_configuration_is_an_error_that_names_the_nearest(tmp_path, text: str, match: str) -> None:
    path = tmp_path / "bad.yml"
    path.write_text(text)
    with pytest.raises(ValueError, match=match):
        read_configuration(str(path), "Hop-v1")


def test_a_missing_configuration_names_the_nearest_shipped_one() -> None:
    with pytest.raises(ValueError, match="'capq' is neither a yaml file nor a shipped configuration: did you mean 'capql'"):
        read_configuration("capq", "x")


def test_shipped_yaml_is_plain_and_only_momba_plus_knows_tasks() -> None:
    for name in shipped_configurations():
        entries = yaml.safe_load((SHIPPED / f"{name}.yml").read_text())
        assert "default" in entries
        assert set(entries) - {"default"} <= (set(TASKS) if name == "momba_plus" else set())


def test_dense_policies_have_no_weight_normalisation_to_switch() -> None:
    with pytest.raises(ValueError, match="MlpPolicy has no argument 'normalize_weights'"):
        check_hyperparameters("MlpPolicy", {"policy_kwargs": {"normalize_weights": False}})


# -------------------------------------------------------------------------------------------------------- command line


def test_options_of_table_a_1() -> None:
    line = "--env E --architecture mlp --critic-loss mse --vector-values --her --preference-alignment-regularization"
    settings = parse(line.split())
    assert settings.policy == "MlpPolicy"
    assert settings.hyperparameters == {"critic_loss": "mse", "vector_values": True, "her": True, "preference_alignment": True}
    assert (settings.steps, settings.seed, settings.n_envs) == (1_000_000, 0, 1)


def test_the_command_line_goes_before_the_configuration() -> None:
    line = "--env E --conf capql --steps 2e4 --critic-loss ce --set gamma=0.95 --set policy_kwargs.net_arch=[64,64]"
    settings = parse(line.split())
    assert settings.steps == 20_000
    assert settings.hyperparameters["critic_loss"] == "ce"
    assert settings.hyperparameters["gamma"] == 0.95
    assert settings.hyperparameters["policy_kwargs"]["net_arch"] == [64, 64]
    assert settings.hyperparameters["policy_kwargs"]["ortho_init"] is True
    assert parse(["--env", "E", "--conf", "capql"]).steps == 1_000_000


def test_a_run_leaves_its_folder(tmp_path, capsys) -> None:
    line = f"--env mo-hopper-2obj-v5 --steps 120 --output {tmp_path}/run --eval-freq 60 --n-preferences 3 --n-episodes 1"
    line += " --no-progress-bar --set learning_starts=50 --set buffer_size=200 --set batch_size=8"
    line += " --set policy_kwargs.actor_hidden_dim=8 --set policy_kwargs.critic_hidden_dim=8"
    main(line.split())
    folder = tmp_path / "run"
    files = {path.name for path in folder.iterdir()}
    assert {
        "record.jsonl",
        "model.zip",
        "best_model.zip",
        "front.npz",
        "front.png",
        "pareto_evaluations.npz",
        "progress.csv",
    } <= files
    start = json.loads((folder / "record.jsonl").read_text().splitlines()[0])
    assert start["config"]["hyperparameters"]["learning_starts"] == 50
    with np.load(folder / "pareto_evaluations.npz", allow_pickle=False) as evaluations:
        assert evaluations["timesteps"].tolist() == [60, 120]
        assert evaluations["values"].shape == (2, 3, 2)
        hypervolumes = evaluations["hypervolume"]
    front = ParetoFront.load(folder / "front.npz")
    assert front.hypervolume() == hypervolumes[-1]
    with open(folder / "progress.csv") as file:
        assert {"pareto/hypervolume", "pareto/preference_regret"} <= set(csv.DictReader(file).fieldnames or ())
    assert MOMBA.load(folder / "model.zip").num_timesteps == 120
    assert str(folder / "front.png") in capsys.readouterr().out


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("--env mo-hopper-2obj-v5 --conf capq", "did you mean 'capql'"),
        ("--env mo-hopper-2obj-v5 --set gama=1", "did you mean 'gamma'"),
        ("--env mo-hopper-2obj-v5 --set gamma", "write NAME=VALUE"),
        ("--env mo-hoper-2obj-v5", "mo-hopper"),
        ("--env mo-hopper-2obj-v5 --preference-alignment-regularization", "vector_values=True"),
    ],
)
def test_a_bad_command_line_is_one_line_of_error(tmp_path, line: str, match: str) -> None:
    with pytest.raises(SystemExit, match=match):
        main([*line.split(), "--output", str(tmp_path / "run")])


def test_a_run_does_not_overwrite_another(tmp_path) -> None:
    (tmp_path / "something").touch()
    with pytest.raises(SystemExit, match=r"not an empty folder: choose another --output\.$"):
        main(["--env", "mo-hopper-2obj-v5", "--output", str(tmp_path)])
    (tmp_path / "checkpoints" / "0001-000010000").mkdir(parents=True)
    with pytest.raises(SystemExit, match=f"or go on with its run: --resume {tmp_path}"):
        main(["--env", "mo-hopper-2obj-v5", "--output", str(tmp_path)])


@pytest.mark.parametrize(("ending", "code"), [(KeyboardInterrupt(), 130), (SystemExit(143), 143)], ids=["SIGINT", "SIGTERM"])
def test_a_signal_says_how_to_go_on(ending: BaseException, code: int, monkeypatch, capsys, tmp_path) -> None:
    monkeypatch.setattr("sb3_momba.train.run", Mock(side_effect=ending))
    for checkpoint, message in ((None, "Interrupted."), ("0001-000010000", f"Interrupted. Go on with --resume {tmp_path}.")):
        if checkpoint is not None:
            (tmp_path / "checkpoints" / checkpoint).mkdir(parents=True)
        with pytest.raises(SystemExit) as raised:
            main(["--env", "mo-hopper-2obj-v5", "--output", str(tmp_path)])
        assert raised.value.code == code
        assert capsys.readouterr().err.strip() == message


@pytest.mark.parametrize(
    ("options", "told"),
    [("", {}), ("--checkpoint-freq 1e3 --keep-checkpoints 6", {"checkpoint_freq": 1_000, "keep_checkpoints": 6})],
)
def test_a_resumption_is_told_what_the_command_line_gives_and_no_defaults(monkeypatch, options: str, told: dict) -> None:
    """Those would win over what the run's folder says."""
    resume = Mock()
    monkeypatch.setattr("sb3_momba.train.resume", resume)
    monkeypatch.setattr("sb3_momba.train.report", str)
    main(["--resume", "runs/hopper", "--no-progress-bar", *options.split()])
    resume.assert_called_once_with(Path("runs/hopper"), progress_bar=False, **told)


def test_a_command_line_needs_a_task_or_a_run(capsys) -> None:
    with pytest.raises(SystemExit):
        main(["--steps", "1e3"])
    assert "one of the arguments --env --resume is required" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("sign", "alignment", "warns"), [(1, True, False), (-1, True, True), (-1, np.True_, True), (-1, "positive", False)]
)
def test_preference_alignment_warns_once_of_negative_returns(sign: int, alignment: bool | str, warns: bool, recwarn) -> None:
    rewards = {t: np.array([1.0, sign * 2.0]) for t in range(1, 31)}
    kwargs = {"buffer_size": 50, "learning_starts": 50, "policy_kwargs": TINY_SIMBA}
    MOMBA("SimbaPolicy", StubEnv(rewards=rewards), vector_values=True, preference_alignment=alignment, **kwargs).learn(30)
    assert sum("not negative" in str(warning.message) for warning in recwarn) == int(warns)


def test_numbers_that_yaml_reads_as_strings_are_numbers(tmp_path) -> None:
    settings = parse(["--env", "E", "--set", "learning_rate=1e-3", "--set", "buffer_size=1e4", "--set", "ent_coef=auto_0.1"])
    assert settings.hyperparameters == {"learning_rate": 0.001, "buffer_size": 10_000, "ent_coef": "auto_0.1"}
    assert isinstance(settings.hyperparameters["buffer_size"], int)
    path = tmp_path / "mine.yml"
    path.write_text("default:\n  learning_rate: 3e-4\n  policy_kwargs:\n    support: [-1e1, 1e1]\n")
    hyperparameters = read_configuration(str(path), "E").hyperparameters
    assert hyperparameters == {"learning_rate": 3e-4, "policy_kwargs": {"support": [-10, 10]}}


@pytest.mark.parametrize(
    ("option", "match"),
    [
        ("--reference-point 0", r"reference point \[0.0\] has shape \(1,\)"),
        ("--objectives a", "2 names are needed"),
        ("--n-preferences 0", "must be at least 1"),
        ("--eval-freq 0", "eval_freq=0"),
        ("--steps 0", "steps=0"),
        ("--n-envs 0", "n_envs=0"),
        ("--set gamma=2", "gamma=2"),
        ("--set batch_size=0", "batch_size=0"),
    ],
)
def test_a_refused_run_writes_nothing(tmp_path, option: str, match: str) -> None:
    with pytest.raises(SystemExit, match=match):
        main(["--env", "mo-hopper-2obj-v5", "--output", str(tmp_path / "run"), *option.split()])
    assert not (tmp_path / "run").exists()


def test_an_interrupted_run_leaves_its_model(tmp_path, monkeypatch) -> None:
    def interrupted(model, *args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(MOMBA, "learn", interrupted)
    with pytest.raises(SystemExit) as stop:
        main(["--env", "mo-hopper-2obj-v5", "--output", str(tmp_path / "run"), "--set", "buffer_size=100"])
    assert stop.value.code == 130
    MOMBA.load(tmp_path / "run" / "model.zip")


def test_mo_gymnasiums_linear_reward_is_one_objective() -> None:
    env = LinearReward(mo_gymnasium.make("mo-hopper-2obj-v5"), weight=np.array([0.25, 0.75]))
    model = MOMBA("SimbaPolicy", env, buffer_size=50, learning_starts=10, policy_kwargs=TINY_SIMBA).learn(20)
    assert model.n_objectives == 1
    assert model.observation_space.shape == (11,)


def test_wrappers_take_samplers_as_literals_and_weights() -> None:
    assert PreferenceWrapper(StubEnv(), "uniform").preference_sampler == UniformSampler(2)
    assert PreferenceWrapper(StubEnv(), [0.25, 0.75]).preference_sampler == FixedSampler((0.25, 0.75))


def test_values_below_the_reference_point_are_said_and_the_best_model_is_that_of_the_largest_utility(caplog) -> None:
    callback = ParetoEvalCallback(StubEnv, eval_freq=10, n_preferences=3, n_episodes=1)
    MOMBA("SimbaPolicy", StubEnv(), buffer_size=50, learning_starts=50, policy_kwargs=TINY_SIMBA).learn(20, callback=callback)
    assert callback.best_score[0] == 0  # the second objective of the stub is negative
    assert np.isfinite(callback.best_score[1])
    assert caplog.text.count("No value lies above the reference point [0.0, 0.0]") == 1
