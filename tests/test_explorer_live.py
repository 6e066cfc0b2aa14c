"""The decision kit: its mathematics by hand, its server by requests, its page in a browser."""

import http.client
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
from playwright.sync_api import sync_playwright

from sb3_momba import MOMBA
from sb3_momba.envs.preferences import simplex_lattice
from sb3_momba.envs.wrappers import make_env
from sb3_momba.explorer.__main__ import main
from sb3_momba.explorer.decisions import (
    Bound,
    exchange_rates,
    find_alternatives,
    leave_one_out_errors,
    local_error,
    predict_returns,
    rank_for_bound,
)
from sb3_momba.explorer.kit import DecisionKit
from sb3_momba.explorer.live import LiveServer, NewestFirst, SupersededError, is_loopback, listen
from sb3_momba.explorer.opening import open_kit, write_calibration
from sb3_momba.explorer.prediction import CRITIC, FRONT, predictors_of, share_close
from sb3_momba.explorer.reading import final_front, read_run
from sb3_momba.explorer.rendering import Policy
from sb3_momba.explorer.rollouts import Rollouts, critic_returns, entropy_bonus, roll_out
from sb3_momba.pareto.evaluation import ParetoFront, evaluate_front
from sb3_momba.records import read_record
from tests.explorer_browser import OPTIONS, PHONE, TIMEOUT, Watched, text, wait_until
from tests.explorer_runs import TINY, chromium, needs_browser, needs_gl, train_tiny, write_run

TWO = np.array([[0.0, 1.0], [0.25, 0.75], [0.5, 0.5], [1.0, 0.0]])


# -------------------------------------------------------------------------------------------------------- prediction


def test_between_two_preferences_returns_are_linear():
    returns = np.array([[0.0, 10.0], [4.0, 8.0], [6.0, 6.0], [10.0, 0.0]])
    wanted = np.array([[0.125, 0.875], [0.5, 0.5], [0.75, 0.25], [1.0, 0.0]])
    np.testing.assert_allclose(predict_returns(wanted, TWO, returns), [[2, 9], [6, 6], [8, 3], [10, 0]])


@pytest.mark.parametrize("n_objectives", [2, 3, 5, 10], ids="{} objectives".format)
def test_linear_fronts_are_predicted_exactly(n_objectives):
    rng = np.random.default_rng(0)
    preferences = simplex_lattice(n_objectives, 4 if n_objectives < 5 else 2)
    slopes = rng.normal(size=(n_objectives, n_objectives))
    wanted = rng.dirichlet(np.ones(n_objectives), size=10)
    np.testing.assert_allclose(predict_returns(wanted, preferences, preferences @ slopes), wanted @ slopes, atol=1e-6)


def test_three_objectives_are_interpolated_in_the_triangle_around():
    """w = (1/2, 1/4, 1/4) lies in the middle of (1, 0, 0) and (0, 1/2, 1/2); beside these there is (0, 1, 0) and (0, 0, 1)."""
    preferences = np.array([[1, 0, 0], [0, 0.5, 0.5], [0, 1, 0], [0, 0, 1.0]])
    returns = np.array([[8.0], [2.0], [100.0], [200.0]])
    np.testing.assert_allclose(predict_returns(np.array([[0.5, 0.25, 0.25]]), preferences, returns), [[5.0]])


def test_outside_of_the_evaluated_preferences_the_nearest_one_speaks():
    inner, returns = np.array([[0.3, 0.7], [0.6, 0.4]]), np.array([[1.0], [2.0]])
    np.testing.assert_array_equal(predict_returns(np.array([[0.0, 1.0], [1.0, 0.0]]), inner, returns), [[1.0], [2.0]])
    triangle = np.array([[0.6, 0.2, 0.2], [0.2, 0.6, 0.2], [0.2, 0.2, 0.6]])
    np.testing.assert_array_equal(predict_returns(np.eye(3)[:1], triangle, np.array([[1.0], [2.0], [3.0]])), [[1.0]])


def test_leave_one_out_by_hand():
    """0.25 between 0 and 0.5 -> 3 instead of 4; 0.5 between 0.25 and 1 -> 4 + 6/3 = 6; the ends have no neighbours."""
    errors = leave_one_out_errors(TWO, np.array([[0.0], [4.0], [6.0], [10.0]]))
    np.testing.assert_allclose(errors, [[np.nan], [-1.0], [0.0], [np.nan]])
    assert np.isnan(leave_one_out_errors(np.array([[0.5, 0.5]]), np.array([[1.0, 2.0]]))).all()


def test_a_local_error_is_the_root_mean_square_of_the_nearest():
    preferences = np.stack([np.linspace(0, 1, 6), np.linspace(1, 0, 6)], axis=1)
    errors = np.array([[np.nan], [3.0], [-1.0], [1.0], [1.0], [np.nan]])
    np.testing.assert_allclose(local_error(np.array([[0.1, 0.9]]), preferences, errors), [[np.sqrt(12 / 4)]])
    assert np.isnan(local_error(TWO, TWO, np.full((4, 2), np.nan))).all()


def test_a_share_counts_rows_that_are_close_in_every_objective():
    measured = np.array([[100.0, -10.0], [100.0, -10.0], [100.0, -10.0], [0.0, 1.0]])
    predicted = np.array([[104.0, -10.4], [104.0, -10.6], [94.0, -10.0], [0.0, 1.0]])
    assert share_close(predicted, measured) == 0.5


# --------------------------------------------------------------------------------------------------------- decisions


def test_exchange_rates_are_the_slope_of_the_front():
    """On (10 w, 20 (1 - w)) one unit of the first objective is worth two of the second, and 1/2 the other way."""
    rates = exchange_rates(lambda w: w * [10.0, 20.0], np.array([0.4, 0.6]), np.array([10.0, 20.0]))
    np.testing.assert_allclose(rates, [[np.nan, 2.0], [0.5, np.nan]])


def test_three_objectives_have_a_rate_for_each_pair():
    rates = exchange_rates(lambda w: w * [1.0, 2.0, 8.0], np.full(3, 1 / 3), np.array([1.0, 2.0, 8.0]))
    np.testing.assert_allclose(rates, [[np.nan, 2, 8], [0.5, np.nan, 4], [1 / 8, 1 / 4, np.nan]])


def test_no_rate_where_nothing_is_traded():
    flat = exchange_rates(lambda w: np.ones((len(w), 2)), np.array([0.4, 0.6]), np.ones(2))
    both_fall = exchange_rates(lambda w: w[:, :1] * [1.0, 2.0], np.array([0.4, 0.6]), np.ones(2))
    at_the_end = exchange_rates(lambda w: w * [10.0, 20.0], np.array([1.0, 0.0]), np.array([10.0, 20.0]))
    assert np.isnan(flat).all()
    assert np.isnan(both_fall).all()
    np.testing.assert_allclose(at_the_end, [[np.nan, 2.0], [0.5, np.nan]])  # The slope of the one side there is.


def test_a_bound_is_kept_with_the_most_of_the_rest():
    candidates = np.array([[0.0, 0.5, 0.5], [0.2, 0.4, 0.4], [0.6, 0.2, 0.2], [1.0, 0.0, 0.0]])
    returns = np.array([[0.0, 9.0, 9.0], [5.0, 6.0, 1.0], [6.0, 1.0, 6.0], [9.0, 0.0, 0.0]])
    bound = Bound(0, 5.0)
    assert rank_for_bound(bound, np.array([0.0, 0.9, 0.1]), candidates, returns).tolist() == [1, 2, 3]
    assert rank_for_bound(bound, np.array([0.0, 0.1, 0.9]), candidates, returns).tolist() == [2, 1, 3]
    # Without a weight on the others they count alike: 7, 7 and 0, and of equal ones the nearest is first.
    assert rank_for_bound(bound, np.array([1.0, 0.0, 0.0]), candidates, returns).tolist() == [2, 1, 3]
    assert rank_for_bound(Bound(0, 9.1), np.array([1.0, 0.0, 0.0]), candidates, returns).tolist() == []


def test_alternatives_return_alike_and_move_differently():
    returns = np.array([[1.0, 1.0], [1.1, 0.9], [1.1, 0.9], [5.0, 1.0]])
    behaviour = np.array([[0.0, 0.0, 7.0], [0.0, 0.2, 7.0], [2.0, 0.0, 7.0], [2.0, 4.0, 7.0]])
    found = find_alternatives(returns[0], behaviour[0], returns, behaviour, np.array([0.2, 0.2]))
    assert [(one.index, one.feature) for one in found] == [(2, 0), (1, 1)]  # neither itself nor the one that returns more
    scaled = behaviour[:, :2] / behaviour[:, :2].std(axis=0)
    pairs = [np.sqrt(((scaled[i] - scaled[j]) ** 2).sum() / 3) for i in range(4) for j in range(i)]
    assert found[0].distance == pytest.approx(np.sqrt(scaled[2, 0] ** 2 / 3) / np.mean(pairs))


# ------------------------------------------------------------------------------------------------------------ critics


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


def test_the_entropy_bonus_by_hand(vector_model):
    """gamma H_1 + gamma^2 H_2, and behind a time limit gamma^3 / (1 - gamma) of the mean entropy; alpha 0.1, scale 0.1."""
    model = MOMBA.load(vector_model)
    model.actor.action_log_prob = lambda s: (None, -model.policy.return_scale.max_return.new_tensor([5.0, 1.0, 3.0]))
    observations, w = np.zeros((3, model.policy.observation_dim), dtype=np.float32), np.array([0.5, 0.5], dtype=np.float32)
    alone = 0.99 * 1 + 0.99**2 * 3
    assert entropy_bonus(model, observations, w, False) == pytest.approx(0.1 * alone / 0.1)
    assert entropy_bonus(model, observations, w, True) == pytest.approx(0.1 * (alone + 0.99**3 / 0.01 * 3) / 0.1, rel=1e-5)


def test_a_critics_returns_are_unscaled_and_less_the_bonus(vector_model):
    """The mean over critics and starts of (1, 3) and (2, 4), divided by the scale 0.1."""
    model = MOMBA.load(vector_model)
    values = model.policy.return_scale.max_return.new_tensor([[[1.0, 2.0], [3.0, 4.0]]])
    model.policy.value.mean = lambda _: values.expand(4, 2, 2)
    starts = np.zeros((2, model.policy.observation_dim), dtype=np.float32)
    found = critic_returns(model, starts, np.array([[0.5, 0.5], [1.0, 0.0]]), np.array([1.0, 2.0]))
    np.testing.assert_allclose(found, [[19.0, 29.0], [18.0, 28.0]])


def test_the_predictor_with_the_smaller_error_is_used(vector_model):
    model = MOMBA.load(vector_model)
    preferences = np.stack([np.linspace(0, 1, 5), np.linspace(1, 0, 5)], axis=1)
    starts = np.zeros((1, model.policy.observation_dim), dtype=np.float32)
    expected = critic_returns(model, starts, preferences, np.full(5, 7.0))[:, None]
    noise = np.array([[0.0], [9.0], [-9.0], [9.0], [0.0]])[:, None]
    for returns, first in ((expected, CRITIC), (preferences[:, None] * 100, FRONT)):
        front = ParetoFront(preferences, returns, returns, np.ones((5, 1), dtype=np.int64))
        surveyed = Rollouts(front, np.zeros((5, 2)), np.full(5, 7.0), starts)
        assert predictors_of(model, surveyed, front)[0].name == first
    noisy = ParetoFront(preferences, expected + noise, expected + noise, np.ones((5, 1), dtype=np.int64))
    one = predictors_of(model, surveyed, noisy)[0]
    assert one.name == CRITIC
    np.testing.assert_allclose(one.errors, -np.broadcast_to(noise[:, 0], (5, 2)), atol=1e-4)
    assert one.size(np.array([1.0, 3.0])) == pytest.approx(np.sqrt((3 * 81 + 3 * 9) / 10), rel=1e-4)
    assert one.size(np.array([0.0, 1.0])) == pytest.approx(np.sqrt(3 * 81 / 5), rel=1e-4)  # in its own unit then


# ---------------------------------------------------------------------------------------------------------- the kit


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory) -> Path:
    return train_tiny(tmp_path_factory.mktemp("live") / "run")


@pytest.fixture(scope="module")
def kit(run_folder, tmp_path_factory) -> Iterator[DecisionKit]:
    with open_kit(run_folder, seeds=[run_folder], folder=tmp_path_factory.mktemp("kept")) as kit:
        yield kit


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
    np.testing.assert_allclose(kit.around(kit.check([0.0, 1.0]))["seeds"], [kit.measured[0]])


def test_spread_is_the_deviation_over_episodes(kit, monkeypatch):
    """1 and 3, 3 and 7: the means 2 and 5, the deviations sqrt(2) and 2 sqrt(2)."""
    w = kit.check([0.4, 0.6])
    discounted = np.array([[[1.0, 3.0], [3.0, 7.0]]])
    front = ParetoFront(w[None], 10 * discounted, discounted, np.array([[5, 8]]))
    monkeypatch.setitem(kit._rollouts, w.tobytes(), Rollouts(front, kit.survey.behaviour[:1], np.zeros(1), kit.survey.starts))
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


def test_a_bound_that_nothing_meets_gives_the_closest(kit):
    found = kit.meet(kit.check([0.5, 0.5]), 0, at_least=1e6)
    assert not found["met"]
    assert found["discounted"][0] == pytest.approx(kit.measured[:, 0].max())


def test_a_prediction_that_was_too_good_is_corrected(kit, monkeypatch):
    """Where the predictor promises too much, a bound is asked for more strictly, until the rollout keeps it."""
    target = float(np.quantile(kit.measured[:, 0], 0.6))
    monkeypatch.setattr(kit, "candidate_returns", kit.candidate_returns + np.array([0.3 * kit.ranges[0], 0]))
    found = kit.meet(kit.check([0.1, 0.9]), 0, at_least=target)
    assert found["met"]
    assert found["n_rollouts"] > 1
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
        np.testing.assert_array_equal(loaded.predict(observation, preference=w, deterministic=True)[0], shown)
        observation, *_ = env.step(shown)
    assert loaded.preference_sampler == w.tolist()
    assert kit.model.preference_sampler is None


def test_a_model_alone_is_surveyed(vector_model, monkeypatch):
    with open_kit(vector_model, "MO-Hopper-v4", films=False) as kit:
        assert len(kit.front.preferences) == 41
        assert {one.name for one in kit.predictors} == {FRONT, CRITIC}
        assert kit.no_film == "none are wanted"
        assert kit.objectives == ["forward speed", "jumping height"]
        begins = {FRONT: "Interpolated between the 41", CRITIC: "Predicted by the vector critic less its entropy bonus"}
        for predictors in (kit.predictors, kit.predictors[::-1]):
            monkeypatch.setattr(kit, "predictors", predictors)
            assert kit.about_prediction().startswith(begins[predictors[0].name])
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


# ---------------------------------------------------------------------------------------------------------- bad input


def fail(arguments: list[Any], words: str) -> None:
    with pytest.raises(SystemExit, match=words):
        main([str(one) for one in arguments])


def with_model(folder: Path, model: Path) -> Path:
    (folder / "model.zip").write_bytes(model.read_bytes())
    return folder


def test_what_cannot_be_chosen_from_is_refused(run_folder, vector_model, tmp_path):
    fail(["live", tmp_path / "nothing"], "is no run: it does not exist")
    fail(["live", run_folder / "model.zip"], "is a file, not a folder")
    fail(["live", run_folder, "--env", "MO-Hopper-v4"], "is no file")
    fail(["live", run_folder / "model.zip", "--env", "MO-HalfCheetah-v4"], "observation_space has shape")
    fail(["live", run_folder / "model.zip", "--env", "Nonsense-v0"], "Nonsense")
    values = np.array([[1.0, 2.0], [2.0, 1.0]])
    no_model = write_run(tmp_path / "no_model", values, np.eye(2))
    fail(["live", no_model], "has no policy to choose a preference for.*model.zip")
    one = np.array([[0.5, 0.5]])
    one_point = write_run(tmp_path / "one", values[:1], one, returns=values[None, :1])
    fail(["live", with_model(one_point, vector_model)], "has one point")
    other = write_run(tmp_path / "other", values, np.eye(2), env="MO-HalfCheetah-v4")
    fail(["live", with_model(other, vector_model)], "observation_space has shape")
    fail(["live", run_folder, "--seeds", other], "not of .* on MO-Hopper-v4")
    fail(["calibrate", run_folder, "--preferences", "0"], "give at least 1")


def test_a_single_objective_is_no_trade_off(tmp_path):
    MOMBA("MlpPolicy", "Pendulum-v1", policy_kwargs=TINY, buffer_size=10).save(tmp_path / "model.zip")
    fail(["live", tmp_path / "model.zip", "--env", "Pendulum-v1"], "has one objective")


def test_a_damaged_final_front_is_named(run_folder, tmp_path):
    lines = (run_folder / "record.jsonl").read_text().splitlines()
    end = json.loads(lines[-1])
    end["front"]["discounted_returns"] = [[1.0]]
    (tmp_path / "record.jsonl").write_text("\n".join([*lines[:-1], json.dumps(end)]) + "\n")
    with pytest.raises(ValueError, match=r"record.jsonl: its final front .* do not go together"):
        read_run(tmp_path)


# ----------------------------------------------------------------------------------------------------------- the server


@pytest.fixture(scope="module")
def server(kit) -> Iterator[LiveServer]:
    with LiveServer(kit, listen("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def request(
    server: LiveServer, path: str, body: Any = None, headers: dict[str, str] | None = None
) -> tuple[int, dict[str, str], bytes]:
    """A GET, or with a body a POST."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=60)
    content = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
    given = {"Content-Type": "application/json", **(headers or {})}
    connection.request("GET" if body is None else "POST", path, content, given)
    answer = connection.getresponse()
    result = answer.status, dict(answer.headers), answer.read()
    connection.close()
    return result


def error_of(answer: tuple[int, dict[str, str], bytes]) -> tuple[int, str]:
    return answer[0], json.loads(answer[2])["error"]


def test_the_page_is_served_with_a_policy_of_its_own(server):
    status, headers, content = request(server, "/")
    assert status == 200
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert b"http" not in content.replace(b'"http', b"")


@pytest.mark.parametrize("path", ["/../record.jsonl", "/..%2f..%2fetc/passwd", "/etc/passwd", "//etc/passwd", "/live.py"])
def test_no_other_file_is_served(path, server):
    assert error_of(request(server, path)) == (404, "There is no such page.")


def test_only_the_page_is_answered(server):
    question = {"preference": [0.5, 0.5]}
    port = server.server_address[1]
    assert request(server, "/predict", question, {"Origin": f"http://127.0.0.1:{port}"})[0] == 200
    assert request(server, "/predict", question, {"Host": f"localhost:{port}"})[0] == 200
    assert request(server, "/", None, {"Host": "evil.example"})[0] == 403
    assert request(server, "/predict", question, {"Host": f"evil.example:{port}"})[0] == 403
    assert request(server, "/predict", question, {"Origin": "http://evil.example"})[0] == 403
    assert request(server, "/predict", question, {"Content-Type": "text/plain"})[0] == 415
    assert request(server, "/predict", b"x" * 70_000)[0] == 413
    assert request(server, "/predict")[0] == 404


@pytest.mark.parametrize(
    ("path", "question", "words"),
    [
        ("/predict", b"{", "Expecting"),
        ("/predict", [], "no JSON object"),
        ("/predict", {}, "give a list of 2 weights"),
        ("/predict", {"preference": "x"}, "give a list of 2 weights"),
        ("/predict", {"preference": [[0.5, 0.5]]}, "give a list of 2 weights"),
        ("/predict", {"preference": [1, 1]}, "sums to 2"),
        ("/predict", {"preference": [2, -1]}, "negative"),
        ("/predict", {"preference": [1, 0, 0]}, "2 weights"),
        ("/bound", {"preference": [0.5, 0.5], "objective": 2, "less": 1}, "from 0 to 1"),
        ("/bound", {"preference": [0.5, 0.5], "objective": True, "less": 1}, "from 0 to 1"),
        ("/bound", {"preference": [0.5, 0.5], "objective": 0}, "one of at_least and less"),
        ("/bound", {"preference": [0.5, 0.5], "objective": 0, "less": -1}, "0 or more"),
        ("/bound", {"preference": [0.5, 0.5], "objective": 0, "at_least": "x"}, "give a number"),
        ("/keep", {"preference": ["../x", 1]}, "not an array"),
    ],
    ids=[
        *["no JSON", "a list", "nothing", "a word", "a table", "too much", "negative", "too many"],
        *["no such objective", "a flag", "no bound", "a negative one", "a bound in words", "a path"],
    ],
)
def test_bad_questions_are_refused(path, question, words, server):
    status, error = error_of(request(server, path, question))
    assert status == 400
    assert words in error


def test_predictions_come_in_time(server):
    """Under 100 ms: the median of 20, as this machine may be busy."""
    seconds = []
    for weight in np.linspace(0, 1, 20):
        start = time.perf_counter()
        status, _, _ = request(server, "/predict", {"preference": [weight, 1 - weight]})
        seconds.append(time.perf_counter() - start)
        assert status == 200
    assert np.median(seconds) < 0.1


def test_of_those_that_wait_only_the_newest_gets_its_turn():
    queue, done = NewestFirst(), []
    started, release = threading.Event(), threading.Event()

    def wish(name: str) -> None:
        try:
            with queue.turn() as still_wanted:
                started.set()
                release.wait()
                done.append(name)
                still_wanted()
        except SupersededError:
            done.append(f"{name} superseded")

    threads = [threading.Thread(target=wish, args=(name,)) for name in ("first", "second", "third")]
    threads[0].start()
    started.wait()
    for newest, thread in enumerate(threads[1:], start=2):
        thread.start()
        while queue._newest != newest:
            time.sleep(0.001)
    release.set()
    for thread in threads:
        thread.join()
    assert done[:2] == ["first", "first superseded"]
    assert sorted(done[2:]) == ["second superseded", "third"]


def test_rollouts_asked_for_at_once_are_whole(server, kit):
    """Some are superseded; those that are answered have the numbers of the evaluation."""
    kit._rollouts.clear()
    answers: dict[int, dict[str, Any]] = {}

    def ask(k: int) -> None:
        answers[k] = json.loads(request(server, "/rollout", {"preference": kit.front.preferences[k].tolist()})[2])

    threads = [threading.Thread(target=ask, args=(k,)) for k in range(len(kit.front.preferences))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    answered = {k: answer for k, answer in answers.items() if not answer.get("superseded")}
    assert answered
    for k, answer in answered.items():
        np.testing.assert_allclose(answer["discounted"], kit.measured[k])


def test_a_port_in_use_is_named_before_anything_is_rolled_out(server, run_folder):
    port = server.server_address[1]
    fail(["live", run_folder, "--port", port], rf"127.0.0.1:{port} cannot be listened on \(.*\): try --port 0")
    fail(["live", run_folder, "--port", 70_000], "127.0.0.1:70000 cannot be listened on")


def test_everyone_is_let_in_with_a_warning_only(caplog, tmp_path):
    fail(["live", tmp_path, "--host", "0.0.0.0", "--port", "0"], "has no record.jsonl")
    assert "--host 0.0.0.0 lets everyone who reaches this machine" in caplog.text


def test_other_addresses_than_loopback_are_told_apart():
    assert [is_loopback(host) for host in ("127.0.0.1", "::1", "localhost")] == [True] * 3
    assert [is_loopback(host) for host in ("0.0.0.0", "192.168.0.2", "example.org")] == [False] * 3


# ------------------------------------------------------------------------------------------------------------- the page


def still(page: Any) -> None:
    page.wait_for_selector("body[data-state='still']", timeout=TIMEOUT)


@needs_browser
@needs_gl
def test_a_choice_by_keyboard(server, kit):
    """Preference moved, new rollout shown, bound kept, policy kept."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium() or "chromium", args=OPTIONS)
        watched = Watched(browser, server.url, viewport=PHONE)
        page = watched.page
        still(page)
        assert text(page, "#weight-text-0") == "0.50 / 0.50"
        source = page.get_attribute("#film", "src")
        page.focus("#weight-0")
        page.keyboard.press("End")
        assert text(page, "#weight-text-0") == "1.00 / 0.00"
        wait_until(page, "document.getElementById('predicted-0').textContent.startsWith("
                   f"explorer.number({kit.measured[-1, 0]}))")  # fmt: skip
        still(page)
        assert page.get_attribute("#film", "src") != source
        assert text(page, "#film-caption").startswith("1.00 forward speed, 0.00 jumping height.")
        assert page.evaluate(f"explorer.number({kit.measured[-1, 0]})") == text(page, "#rollout-0")
        marked = page.evaluate("document.getElementById('front').data.at(-1).x[0]")
        assert marked == pytest.approx(kit.measured[-1, 0])
        assert watched.overflowing() == []

        page.select_option("#bound-kind", "at_least")
        page.fill("#bound-value", "1e6")
        page.keyboard.press("Enter")
        page.wait_for_selector("#bound-answer .bad")
        assert "No policy that was found has 1 M forward speed" in text(page, "#bound-answer")

        page.focus("#keep")
        page.keyboard.press("Enter")
        page.wait_for_selector("#kept .good")
        chosen = page.evaluate("document.querySelector('#kept code').textContent")
        assert (Path(chosen) / "policy.onnx").is_file()
        still(page)
        page.evaluate("document.getElementById('film').pause()")
        assert watched.said == []
        assert all(url.startswith((server.url, "blob:", "data:")) for url in watched.asked)
        browser.close()


@needs_browser
def test_three_objectives_without_opengl(tmp_path, monkeypatch):
    """One slider each, which keep the simplex; the page says why there is no film."""
    monkeypatch.setenv("MUJOCO_GL", "disable")
    options: dict[str, Any] = {"policy_kwargs": TINY, "buffer_size": 10, "seed": 0}
    MOMBA("MlpPolicy", "MO-Hopper-3obj-v4", **options).save(tmp_path / "model.zip")
    with (
        open_kit(tmp_path / "model.zip", "MO-Hopper-3obj-v4") as kit,
        LiveServer(kit, listen("127.0.0.1", 0)) as server,
        sync_playwright() as playwright,
    ):
        threading.Thread(target=server.serve_forever).start()
        browser = playwright.chromium.launch(executable_path=chromium() or "chromium", args=OPTIONS)
        watched = Watched(browser, server.url, viewport=PHONE)
        page = watched.page
        assert "MUJOCO_GL is 'disable'" in text(page, "#no-film")
        assert page.is_visible("#no-film")
        assert not page.is_visible("#film")
        page.focus("#weight-0")
        page.keyboard.press("Home")
        assert [text(page, f"#weight-text-{i}") for i in range(3)] == ["0.00", "0.50", "0.50"]
        page.keyboard.press("End")
        assert [text(page, f"#weight-text-{i}") for i in range(3)] == ["1.00", "0.00", "0.00"]
        still(page)
        assert text(page, "#rollout-0") != ""
        assert watched.overflowing() == []
        assert watched.said == []
        browser.close()
        server.shutdown()
