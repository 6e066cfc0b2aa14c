"""The decision kit: critics by hand, what it answers about a real run, and what it refuses."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest

from sb3_momba import MOMBA
from sb3_momba.envs.making import make_env
from sb3_momba.explorer.__main__ import main
from sb3_momba.explorer.kit import DecisionKit
from sb3_momba.explorer.live import LiveServer
from sb3_momba.explorer.opening import open_kit, write_calibration
from sb3_momba.explorer.prediction import CRITIC, FRONT, predictors_of, share_close, sizes
from sb3_momba.explorer.reading import final_front, read_run
from sb3_momba.explorer.rendering import Policy
from sb3_momba.explorer.rollouts import Rollouts, critic_excess, critic_values, roll_out
from sb3_momba.pareto.evaluation import ParetoFront, evaluate_front
from sb3_momba.records import read_record
from tests.explorer_runs import TINY, fail, train_tiny, write_run


@pytest.fixture(scope="module")
def vector_model(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("vector") / "model.zip"
    options: dict[str, Any] = {"vector_values": True, "ent_coef": 0.1, "policy_kwargs": TINY, "buffer_size": 10, "seed": 0}
    model = MOMBA("MlpPolicy", "MO-Hopper-v4", **options)
    model.policy.return_scale.max_return.fill_(30.0)  # rewards are multiplied by 3 / 30
    model.save(path)
    return path


def test_rollouts_are_those_of_the_evaluation(vector_model):
    preferences = np.array([[0.25, 0.75], [1.0, 0.0]])
    front = evaluate_front(MOMBA.load(vector_model), "MO-Hopper-v4", preferences=preferences, n_episodes=2, seed=3)
    rollouts = roll_out(Policy(vector_model, "MO-Hopper-v4", {}), preferences, 2, 3)
    for name in ("returns", "discounted_returns", "episode_lengths"):
        np.testing.assert_array_equal(getattr(rollouts.front, name), getattr(front, name))
    n = front.returns.shape[1]
    env = make_env("MO-Hopper-v4")
    expected = [env.reset(seed=3 + episode)[0] for episode in range(n)]
    np.testing.assert_array_equal(rollouts.starts, np.array(expected, dtype=np.float32))
    assert rollouts.behaviour.shape == (2, 2 * (env.observation_space.shape[0] + env.action_space.shape[0]))


@pytest.mark.parametrize(
    ("n_steps", "terminated", "truncated"),
    [
        (
            1,
            0.99 * 2 + 0.99**2 * 3 + 0.99**3 * 5 + 0.99**4 * 7,
            0.99 * 2 + 0.99**2 * 3 + 0.99**3 * 5 + 0.99**4 * 7 + 0.99**5 * 11,
        ),
        (3, 0.99**3 * 5, 0.99**3 * 5 + 0.99**5 * 11),
    ],
    ids=["n = 1", "n = 3"],
)
def test_what_a_critic_holds_beyond_the_return_by_hand(n_steps, terminated, truncated, vector_model):
    """Entropies 1, 2, 3, 5, 7 and, in the state behind the last of five steps, 11, of which one counts for each bootstrap;
    alpha and the scale are 0.1. Behind a time limit there is also gamma^5 Q of that state, (1, 2) / 0.1."""
    model = MOMBA.load(vector_model)
    new_tensor = model.policy.return_scale.max_return.new_tensor
    model.n_steps = n_steps
    model.actor.action_log_prob = lambda s: (None, -new_tensor([1.0, 2.0, 3.0, 5.0, 7.0, 11.0]))
    model.policy.value.mean = lambda _: new_tensor([[[1.0, 2.0]]])
    observations, w = np.zeros((6, model.policy.observation_dim), dtype=np.float32), np.array([0.5, 0.5], dtype=np.float32)
    np.testing.assert_allclose(critic_excess(model, observations, w, False), [terminated] * 2, rtol=1e-6)
    expected = truncated + 0.99**5 * np.array([10.0, 20.0])
    np.testing.assert_allclose(critic_excess(model, observations, w, True), expected, rtol=1e-6)


@pytest.mark.parametrize("n_steps", [1, 3], ids="n = {}".format)
def test_a_critic_that_is_right_predicts_the_return_up_to_the_time_limit(n_steps, vector_model):
    """A reward of (1, -2) and an entropy of 4 at each step, for ever: its Q is known, and so is the return of 50 steps."""
    model = MOMBA.load(vector_model)
    new_tensor, gamma = model.policy.return_scale.max_return.new_tensor, model.gamma
    model.n_steps = n_steps
    after = gamma**n_steps / (1 - gamma**n_steps)  # of an entropy of 1 at each bootstrap
    value = 0.1 * np.array([1.0, -2.0]) / (1 - gamma) + 0.1 * 4 * after
    model.actor.action_log_prob = lambda s: (None, new_tensor([-4.0] * len(s)))
    model.policy.value.mean = lambda _: new_tensor(value)[None, None]
    n = 51  # a multiple of 3
    observations, w = np.zeros((n + 1, model.policy.observation_dim), dtype=np.float32), np.array([0.5, 0.5], dtype=np.float32)
    predicted = critic_values(model, observations[:1], w[None])[0] - critic_excess(model, observations, w, True)
    np.testing.assert_allclose(predicted, np.array([1.0, -2.0]) * (1 - gamma**n) / (1 - gamma), rtol=1e-5)


def test_a_critics_values_are_unscaled(vector_model):
    """The mean over critics and starts of (1, 3) and (2, 4), divided by the scale 0.1."""
    model = MOMBA.load(vector_model)
    values = model.policy.return_scale.max_return.new_tensor([[[1.0, 2.0], [3.0, 4.0]]])
    model.policy.value.mean = lambda _: values.expand(4, 2, 2)
    starts = np.zeros((2, model.policy.observation_dim), dtype=np.float32)
    np.testing.assert_allclose(critic_values(model, starts, np.array([[0.5, 0.5], [1.0, 0.0]])), [[20.0, 30.0]] * 2)


def test_the_predictor_with_the_smaller_error_is_used(vector_model):
    model = MOMBA.load(vector_model)
    preferences = np.stack([np.linspace(0, 1, 5), np.linspace(1, 0, 5)], axis=1)
    starts = np.zeros((1, model.policy.observation_dim), dtype=np.float32)
    excess = np.array([7.0, -3.0]) * preferences[:, :1]
    expected = (critic_values(model, starts, preferences) - excess)[:, None]
    noise = np.array([[0.0], [9.0], [-9.0], [9.0], [0.0]])[:, None]
    for returns, first in ((expected, CRITIC), (preferences[:, None] * 100, FRONT)):
        front = ParetoFront(preferences, returns, returns, np.ones((5, 1), dtype=np.int64))
        surveyed = Rollouts(front, np.zeros((5, 2)), excess, starts)
        assert predictors_of(model, surveyed, front)[0].name == first
    noisy = ParetoFront(preferences, expected + noise, expected + noise, np.ones((5, 1), dtype=np.int64))
    both = predictors_of(model, surveyed, noisy)
    assert both[0].name == CRITIC
    np.testing.assert_allclose(both[0].errors, -np.broadcast_to(noise[:, 0], (5, 2)), atol=1e-4)
    assert sizes(both, np.array([1.0, 3.0]))[CRITIC] == pytest.approx(np.sqrt((81 + 9) / 2), rel=1e-4)
    assert sizes(both, np.array([0.0, 1.0]))[CRITIC] == pytest.approx(9, rel=1e-4)  # in its own unit then
    # The ends, of which interpolation knows no error, count for neither.
    ends = expected + np.array([[1e3], [0.0], [0.0], [0.0], [1e3]])[:, None]
    assert sizes(predictors_of(model, surveyed, ParetoFront(preferences, ends, ends, noisy.episode_lengths)), np.ones(2))[
        CRITIC
    ] == pytest.approx(0, abs=1e-3)
    two = ParetoFront(preferences[::4], ends[::4], ends[::4], noisy.episode_lengths[::4])
    assert predictors_of(model, surveyed, two)[0].name == FRONT
    assert np.isnan([*sizes(predictors_of(model, surveyed, two), np.ones(2)).values()]).all()


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory) -> Path:
    return train_tiny(tmp_path_factory.mktemp("live") / "run")


@pytest.fixture(scope="module")
def kit(run_folder, tmp_path_factory) -> Iterator[DecisionKit]:
    folder = tmp_path_factory.mktemp("kept")
    with open_kit(run_folder, seeds=[other_seed_of(run_folder, folder / "other")], folder=folder) as kit:
        yield kit


def other_seed_of(folder: Path, into: Path, gamma: float = 0.99, **changed: Any) -> Path:
    """A run's record as that of the seed 1, whose front returned twice as much."""
    first, *between, end = map(json.loads, (folder / "record.jsonl").read_text().splitlines())
    first.update(seed=1)
    first["config"].update(seed=1, **changed)
    end["front"]["settings"]["gamma"] = gamma
    for name in ("returns", "discounted_returns"):
        end["front"][name] = (2 * np.array(end["front"][name])).tolist()
    into.mkdir()
    (into / "record.jsonl").write_text("".join(json.dumps(line) + "\n" for line in (first, *between, end)))
    return into


def test_the_final_front_is_the_records(run_folder):
    record, saved = final_front(read_record(run_folder / "record.jsonl")), ParetoFront.load(run_folder / "front.npz")
    assert record is not None
    for name in ("preferences", "returns", "discounted_returns", "episode_lengths"):
        np.testing.assert_array_equal(getattr(record, name), getattr(saved, name))


def test_the_front_is_predicted_and_rolled_out_as_it_was_evaluated(kit):
    for k, preference in enumerate(kit.front.preferences):
        w = kit.check(preference.tolist())
        np.testing.assert_allclose(kit.predict(w)["returns"], kit.measured[k], rtol=1e-5)
    rollout = kit.show_rollout(kit.check([0.0, 1.0]))
    assert kit.run.front.preferences[0].tolist() == [0.0, 1.0]
    np.testing.assert_allclose(rollout["discounted"], kit.measured[0])
    np.testing.assert_allclose(rollout["returns"], kit.run.values[0])
    np.testing.assert_allclose(kit.around(kit.check([0.0, 1.0]))["seeds"], [2 * kit.measured[0]])


def test_spread_is_the_deviation_over_episodes(kit, monkeypatch):
    """1 and 3, 3 and 7: the means 2 and 5, the deviations sqrt(2) and 2 sqrt(2)."""
    w = kit.check([0.4, 0.6])
    discounted = np.array([[[1.0, 3.0], [3.0, 7.0]]])
    front = ParetoFront(w[None], 10 * discounted, discounted, np.array([[5, 8]]))
    monkeypatch.setitem(
        kit._rollouts, w.tobytes(), Rollouts(front, kit.survey.behaviour[:1], np.zeros((1, 2)), kit.survey.starts)
    )
    shown = kit.show_rollout(w)
    assert (shown["n_episodes"], shown["steps"]) == (2, 6.5)
    for name, expected in (("discounted", [2, 5]), ("returns", [20, 50])):
        np.testing.assert_allclose(shown[name], expected)
    np.testing.assert_allclose(shown["discounted_spread"], [2**0.5, 8**0.5])
    np.testing.assert_allclose(shown["spread"], [200**0.5, 800**0.5])


def test_a_bound_is_met_in_the_rollout(kit):
    preference = kit.check([0.5, 0.5])
    for objective in (0, 1):
        middle = float(kit.measured[:, objective].mean())
        found = kit.meet(preference, objective, at_least=middle)
        assert found["met"]
        assert kit.rolled_out(np.array(found["preference"])).front.discounted_returns.mean(axis=1)[0, objective] >= middle
    here = kit.rolled_out(preference).front.discounted_returns[0].mean(axis=0)
    found = kit.meet(preference, 0, less=1.0)
    assert found["at_least"] == pytest.approx(here[0] - 1)
    assert found["met"]
    assert found["discounted"][0] >= here[0] - 1


@pytest.mark.parametrize("elsewhere", [(20.0, 5.0), (0.0, 5.0)], ids=["kept but worse", "not kept"])
def test_where_the_present_policy_is_the_best_it_stays(elsewhere, kit, monkeypatch):
    """It returns (10, 10): with at most 1 less of the first, what the prediction prefers has less of the second."""
    present = kit.check([0.5, 0.5])

    def rolled_out(w):
        returns = np.array([[(10.0, 10.0) if np.array_equal(w, present) else elsewhere]])
        front = ParetoFront(w[None], returns, returns, np.ones((1, 1), dtype=np.int64))
        return Rollouts(front, kit.survey.behaviour[:1], np.zeros((1, 2)), kit.survey.starts)

    monkeypatch.setattr(kit, "rolled_out", rolled_out)
    monkeypatch.setattr(kit, "candidate_returns", kit.candidates * 100)
    found = kit.meet(present, 0, less=1.0)
    assert (found["met"], found["at_least"], found["preference"], found["discounted"]) == (True, 9, present.tolist(), [10, 10])


def test_a_bound_that_nothing_meets_gives_the_closest(kit):
    found = kit.meet(kit.check([0.5, 0.5]), 0, at_least=1e6)
    assert not found["met"]
    assert found["discounted"][0] == pytest.approx(kit.measured[:, 0].max())


def test_a_prediction_that_was_too_good_is_corrected(kit, monkeypatch):
    """Where the predictor promises too much, a bound is asked for more strictly, until the rollout keeps it."""
    target = float(np.quantile(kit.measured[:, 0], 0.6))
    monkeypatch.setattr(kit, "candidate_returns", kit.candidate_returns + np.array([0.3 * kit.ranges[0], 0]))
    asked = []
    found = kit.meet(kit.check([0.1, 0.9]), 0, at_least=target, still_wanted=lambda: asked.append(1))
    assert found["met"]
    assert len(asked) > 2  # the present preference, one that did not keep it, and more
    assert found["discounted"][0] >= target
    assert found["preference"] not in kit.front.preferences.tolist()  # It was searched for, not only looked up.


def test_what_is_kept_acts_as_the_page_did(kit):
    w = kit.check([0.3, 0.7])
    kept = kit.keep(w)
    folder = Path(kept["folder"])
    assert kept["files"] == ["policy.onnx", "model.zip", "choice.json"]
    assert folder == kit.folder.resolve() / "0.3_0.7"
    choice = json.loads((folder / "choice.json").read_text())
    assert (choice["preference"], choice["env"]) == (w.tolist(), "MO-Hopper-v4")
    session, loaded = onnxruntime.InferenceSession(folder / "policy.onnx"), MOMBA.load(folder / "model.zip")
    env = make_env("MO-Hopper-v4")
    observation, _ = env.reset(seed=0)
    for _ in range(5):
        shown, _ = kit.model.predict(observation, preference=w, deterministic=True)
        (one,) = session.run(["action"], {"observation": observation[None].astype(np.float32)})
        np.testing.assert_allclose(one[0], shown, atol=1e-5)
        np.testing.assert_array_equal(loaded.predict(observation, deterministic=True)[0], shown)
        observation, *_ = env.step(shown)
    other = [0.7, 0.3]
    np.testing.assert_array_equal(
        loaded.predict(observation, preference=other, deterministic=True)[0],
        kit.model.predict(observation, preference=other, deterministic=True)[0],
    )
    assert kit.model.preference_sampler is None


def test_what_is_kept_of_another_model_stays(kit, monkeypatch, tmp_path):
    monkeypatch.setattr(kit, "folder", tmp_path)
    w, first = kit.check([0.3, 0.7]), tmp_path / "0.3_0.7"
    kit.keep(w)
    choice = json.loads((first / "choice.json").read_text())
    (first / "choice.json").write_text(json.dumps({**choice, "model": "/another/model.zip"}))
    before = {path: path.read_bytes() for path in first.iterdir()}
    (tmp_path / "0.3_0.7-2").mkdir()
    (tmp_path / "0.3_0.7-2" / "choice.json").write_text("damaged")
    for _ in range(2):  # Its own is written anew.
        assert Path(kit.keep(w)["folder"]) == tmp_path / "0.3_0.7-3"
    assert {path: path.read_bytes() for path in first.iterdir()} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.3_0.7", "0.3_0.7-2", "0.3_0.7-3"]


def test_nothing_is_kept_where_links_lead(kit, monkeypatch, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    precious = tmp_path / "precious.txt"
    precious.write_text("mine")
    monkeypatch.setattr(kit, "folder", tmp_path / "kept")
    (kit.folder / "0.3_0.7-2").mkdir(parents=True)
    (kit.folder / "0.3_0.7").symlink_to(tmp_path / "elsewhere")
    (kit.folder / "0.3_0.7-2" / "model.zip").symlink_to(precious)
    assert Path(kit.keep(kit.check([0.3, 0.7]))["folder"]) == kit.folder / "0.3_0.7-3"
    assert not list((tmp_path / "elsewhere").iterdir())
    assert precious.read_text() == "mine"


def test_no_page_keeps_through_a_link_in_the_runs_folder(run_folder, tmp_path, monkeypatch):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    monkeypatch.setattr(LiveServer, "serve_forever", lambda self: None)
    monkeypatch.setattr("sb3_momba.explorer.opening.N_SURVEYED", 2)
    (folder / "kept").symlink_to(tmp_path)
    fail(["live", folder, "--port", "0"], r"kept is a symbolic link to .*: .* with --keep")
    main(["live", str(folder), "--port", "0", "--keep", str(folder / "kept")])


def test_where_onnx_cannot_be_written_no_old_one_stays(kit, monkeypatch, tmp_path):
    monkeypatch.setattr(kit, "folder", tmp_path)
    w = kit.check([0.3, 0.7])
    folder = Path(kit.keep(w)["folder"])

    def export(*_):
        raise ImportError("onnx is missing")

    monkeypatch.setattr(MOMBA, "export", export)
    kept = kit.keep(w)
    assert (kept["files"], kept["notes"]) == (["model.zip", "choice.json"], ["onnx is missing"])
    assert sorted(path.name for path in folder.iterdir()) == ["choice.json", "model.zip"]


def test_a_model_alone_is_surveyed(vector_model, monkeypatch):
    with open_kit(vector_model, "MO-Hopper-v4", films=False) as kit:
        assert len(kit.front.preferences) == 41
        assert {one.name for one in kit.predictors} == {FRONT, CRITIC}
        assert kit.no_film == "none are wanted"
        assert kit.objectives == ["forward speed", "jumping height"]
        begins = {FRONT: "Interpolated between the 41", CRITIC: "Predicted by the vector critic, less entropy"}
        for predictors in (kit.predictors, kit.predictors[::-1]):
            monkeypatch.setattr(kit, "predictors", predictors)
            assert kit.about_prediction().startswith(begins[predictors[0].name])
        unknown = [replace(one, errors=np.full_like(one.errors, np.nan)) for one in kit.predictors if one.name == FRONT]
        monkeypatch.setattr(kit, "predictors", unknown)
        assert kit.about_prediction().endswith("How far that is off is not known: none of them lies between others.")
        assert kit.feature(0) == "mean of observation[0]"
        n = kit.model.policy.observation_dim
        assert kit.feature(n) == "mean of action[0]"
        assert kit.feature(n + 3) == "standard deviation of observation[0]"


def test_calibration_says_how_often_a_prediction_is_right(run_folder, tmp_path, caplog):
    caplog.set_level("INFO")
    calibration = write_calibration(run_folder, None, 6, tmp_path / "calibration.png")
    assert calibration.predicted[FRONT].shape == (6, 2)
    assert (tmp_path / "calibration.png").read_bytes().startswith(b"\x89PNG")
    share = 100 * share_close(calibration.predicted[FRONT], calibration.measured)
    assert f"within 5 % on {share:.0f} % of 6 preferences" in caplog.text


def with_model(folder: Path, model: Path) -> Path:
    (folder / "model.zip").write_bytes(model.read_bytes())
    return folder


def test_what_cannot_be_chosen_from_is_refused(run_folder, vector_model, tmp_path):
    fail(["live", tmp_path / "nothing"], "is no run: it does not exist")
    fail(["live", run_folder / "model.zip"], "model.zip is a file: say also what environment it acts in, --env ID")
    fail(["report", run_folder / "model.zip"], "is a file, not a folder")
    fail(["live", run_folder, "--env", "MO-Hopper-v4"], "is no file")
    fail(["live", run_folder / "model.zip", "--env", "MO-HalfCheetah-v4"], "observation_space has shape")
    fail(["live", run_folder / "model.zip", "--env", "Nonsense-v0"], "Nonsense")
    values = np.array([[1.0, 2.0], [2.0, 1.0]])
    no_model = write_run(tmp_path / "no_model", values, np.eye(2))
    fail(["live", no_model], "has no policy to choose a preference for.*model.zip")
    one = np.array([[0.5, 0.5]])
    one_point = write_run(tmp_path / "one", values[:1], one, returns=values[None, :1])
    fail(["live", with_model(one_point, vector_model)], r"has one point, of the preference \(0.5, 0.5\)")
    other = write_run(tmp_path / "other", values, np.eye(2), env="MO-HalfCheetah-v4")
    fail(["live", with_model(other, vector_model)], "observation_space has shape")
    fail(["live", run_folder, "--seeds", other], "a run of MO-HalfCheetah-v4, not of MO-Hopper-v4")
    fail(["live", run_folder, "--seeds", run_folder], "is the run itself")
    fail(["live", run_folder, "--seeds", write_run(tmp_path / "same", values, np.eye(2))], "no discounted returns")
    twin = shutil.copytree(run_folder, tmp_path / "twin")
    fail(["live", run_folder, "--seeds", twin], "has the seed 0 too")
    longer = other_seed_of(run_folder, tmp_path / "longer", steps=600)
    fail(["live", run_folder, "--seeds", longer], "differs by more than its seed: steps is 600.0 instead of 300.0")
    alone = ["live", vector_model, "--env", "MO-Hopper-v4", "--seeds"]
    fail(
        [*alone, other_seed_of(run_folder, tmp_path / "shorter-sighted", gamma=0.9)],
        "differs by more than its seed: gamma is 0.9 instead of 0.99",
    )
    fail(["calibrate", run_folder, "--preferences", "0"], "give at least 1")


def test_a_single_objective_is_no_trade_off(tmp_path):
    MOMBA("MlpPolicy", "Pendulum-v1", policy_kwargs=TINY, buffer_size=10).save(tmp_path / "model.zip")
    fail(["live", tmp_path / "model.zip", "--env", "Pendulum-v1"], "has one objective")


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("discounted_returns", [[1.0]], "do not go together"),
        ("episode_lengths", [[10**30]], "OverflowError"),
        ("settings", 7, "TypeError"),
        ("settings", "gamma", "ValueError"),
    ],
)
def test_a_damaged_final_front_is_named(run_folder, tmp_path, name, value, said):
    lines = (run_folder / "record.jsonl").read_text().splitlines()
    end = json.loads(lines[-1])
    end["front"][name] = value
    (tmp_path / "record.jsonl").write_text("\n".join([*lines[:-1], json.dumps(end)]) + "\n")
    with pytest.raises(ValueError, match=rf"record.jsonl: its final front .*{said}"):
        read_run(tmp_path)
