"""What the explorer computes, reads, draws and films; test_explorer_page.py opens its reports in a browser."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import plotly.graph_objects as go
import psutil
import pytest
from gymnasium.envs.registration import EnvSpec

from sb3_momba import MOMBA, ParetoFront, evaluate_front
from sb3_momba.envs.registry import TASKS
from sb3_momba.explorer import charts, report
from sb3_momba.explorer.__main__ import main
from sb3_momba.explorer.reading import objectives_of, read_run, read_runs
from sb3_momba.explorer.rendering import Policy, RenderingProcess, film, quieten, record_episode, stride_of
from sb3_momba.explorer.report import add_films, fill, json_in_html, page_file, spread_out, to_html
from sb3_momba.explorer.stage import RenderingError, Stage, backends, camera_on, follow
from sb3_momba.explorer.strobe import draw_strobe
from tests.explorer_runs import NUMBERS, TINY, fail, needs_gl, simplex, train_tiny, write_run
from tests.stubs import tiny_model

VALUES = np.array([[0.0, 10.0], [6.0, 6.0], [10.0, 0.0]])
PREFERENCES = np.array([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0]])


@pytest.mark.parametrize(("x", "text"), NUMBERS.items(), ids=str)
def test_numbers_have_four_digits(x, text):
    assert charts.number(x) == text


def test_regret_of_each_preference_by_hand(tmp_path):
    # Asked for objective 1 the policy earns (0, 10) where it has (10, 0): it loses 10. In the middle it loses nothing.
    run = read_run(write_run(tmp_path / "run", VALUES, PREFERENCES))
    np.testing.assert_array_equal(run.regrets, [10.0, 0.0, 10.0])
    assert report.measure(run, run.values, [0, 0])["preference_regret"] == pytest.approx(20 / 3)


def test_what_is_filmed_is_spread_out():
    line = np.stack([np.linspace(0, 1, 9), 1 - np.linspace(0, 1, 9)], axis=1)
    assert spread_out(line, 3) == [0, 4, 8]
    assert spread_out(line, 5) == [0, 2, 4, 6, 8]
    assert spread_out(line, 100) == list(range(9))
    assert spread_out(np.ones((1, 1)), 5) == [0]
    # Of three objectives first the corners.
    assert spread_out(np.array([[1, 0, 0], [0.3, 0.3, 0.4], [0, 1, 0], [0, 0, 1]]), 3) == [0, 2, 3]


def test_parallel_coordinates_by_hand():
    values = np.array([[0.0, 5.0, 1.0, 7.0], [2.0, 5.0, 3.0, 9.0]])
    drawn = charts.coordinates(values, charts.ranges_of([values]))
    assert drawn["x"] == [0, 1, 2, 3, None] * 2
    assert drawn["y"] == [0, 0.5, 0, 0, None, 1, 0.5, 1, 1, None]  # all fives: in the middle


@pytest.mark.parametrize("n_points", [1, 8], ids=["one point", "many points"])
@pytest.mark.parametrize("n_objectives", [1, 2, 3, 4, 10], ids="{} objectives".format)
def test_charts_are_plotlys_and_show_every_point(n_objectives, n_points, tmp_path):
    preferences = simplex(n_objectives, n_points)
    values = np.random.default_rng(0).normal(0, 100, preferences.shape)
    runs = [read_run(write_run(tmp_path / "run", values, preferences))]
    names = [f"objective {i}" for i in range(n_objectives)]
    front, (growth, states) = charts.front(runs, names), charts.growth(runs, names)
    every = [front, growth, charts.regret(runs, names), *charts.learning_curves(runs, np.zeros(n_objectives)).values()]
    for chart in every:
        go.Figure(chart)  # refuses what Plotly does not know
    shown = {tuple(point) for trace in front["data"] for point in trace["customdata"]}
    assert shown == {(0, k) for k in range(len(values))}
    assert [state["steps"] for state in states] == [100, 200]
    page = to_html(runs, np.zeros(n_objectives), "")
    assert page.count("<section") == page.count("</section>") == 6


def test_points_stand_where_their_returns_are(tmp_path):
    runs = [read_run(write_run(tmp_path / "run", VALUES - [[0, 0], [3, 3], [0, 0]], PREFERENCES))]
    for trace in charts.front(runs, ["a", "b"])["data"]:
        for (_, k), x, y in zip(trace["customdata"], trace["x"], trace["y"], strict=True):
            assert (x, y) == tuple(runs[0].values[k])


def test_what_hovering_shows(tmp_path):
    returns = np.stack([VALUES - 1, VALUES + 1], axis=1)
    run = read_run(write_run(tmp_path / "run", VALUES, PREFERENCES, returns=returns))
    (text,) = {
        text
        for trace in charts.front([run], ["speed", "height"])["data"]
        for (_, k), text in zip(trace["customdata"], trace["text"], strict=True)
        if k == 2
    }
    # The deviation of (x - 1, x + 1) is sqrt(2).
    assert text.split("<br>")[1:] == [
        "speed: weight 0.00, return 10 ± 1.414",
        "height: weight 1.00, return 0 ± 1.414",
        "Mean ± standard deviation of 2 episodes",
    ]


def test_growth_shows_the_newest_front_until_then(tmp_path):
    early = read_run(write_run(tmp_path / "early", VALUES, PREFERENCES, steps=(100, 200)))
    late = read_run(write_run(tmp_path / "late", VALUES, PREFERENCES, steps=(150, 300)))
    _, states = charts.growth([early, late], ["a", "b"])
    assert [state["steps"] for state in states] == [100, 150, 200, 300]

    def points(state, run):
        return sorted(x for trace in state["data"] if trace["legendgroup"] == str(run) for x in trace["x"])

    assert [len(points(state, 1)) for state in states] == [0, 3, 3, 3]
    assert points(states[0], 0) == [0, 3, 5]  # The first evaluation is half as good.
    assert points(states[2], 0) == [0, 6, 10]


def test_hostile_texts_are_only_texts(tmp_path):
    hostile = "</script><script>alert(1)</script><img src=x onerror=alert(2)>{{plotly}}"
    folder = write_run(
        tmp_path / "run", VALUES, PREFERENCES, label=hostile, env=hostile, objectives=[hostile] * 2, error=hostile
    )
    page = to_html([read_run(folder)], np.zeros(2), "")
    assert page.count("<script") == page.count("</script>") == 3
    assert "<img" not in page
    numbers = json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL)[1])
    assert numbers["runs"][0]["name"] == f"{hostile}, seed 0"
    for chart in numbers["charts"].values():
        assert "<script" not in json.dumps(chart)


def test_templates_are_filled_once():
    assert fill("{{a}} and {{b}}", {"a": "{{b}}", "b": "B"}) == "{{b}} and B"
    assert json.loads(json_in_html("</script>&\u2028")) == "</script>&\u2028"
    assert "<" not in json_in_html("</script>")
    with pytest.raises(ValueError, match="JSON"):
        json_in_html(float("nan"))


def test_the_page_names_nothing_that_is_not_in_it():
    script, page = page_file("page.js"), page_file("page.html") + page_file("regret.html")
    for name in set(re.findall(r'at\("([\w-]+)"\)', script)):
        assert f'id="{name}"' in page, name
    assert not re.findall(r"https?://(?!www\.w3\.org/2000/svg)", script + page + page_file("page.css"))


def test_names_of_objectives_import_nothing_that_a_record_names(tmp_path, monkeypatch):
    (tmp_path / "of_others.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    run = read_run(write_run(tmp_path / "run", VALUES, PREFERENCES, env="of_others:MO-Hopper-v4"))
    assert objectives_of(run.record) == ["Objective 1", "Objective 2"]
    assert "of_others" not in sys.modules
    for env in ("MO-Hopper-v4", "momba/MO-Hopper-v4"):
        run = read_run(write_run(tmp_path / env, VALUES, PREFERENCES, env=env))
        assert objectives_of(run.record) == ["forward speed", "jumping height"]


class TestFolders:
    def test_no_run(self, tmp_path):
        with pytest.raises(ValueError, match=r"missing is no run: it does not exist. Give the folder .*--output"):
            read_run(tmp_path / "missing")
        with pytest.raises(ValueError, match=r"has no record\.jsonl"):
            read_run(tmp_path)

    def test_a_run_that_has_nothing_to_show(self, tmp_path):
        folder = write_run(tmp_path / "run", VALUES, PREFERENCES, steps=(), error="MemoryError")
        with pytest.raises(ValueError, match=r"without an evaluation \(it ended with 'MemoryError'\)"):
            read_run(folder)
        (folder / "record.jsonl").write_text('{"event": "st')
        with pytest.raises(ValueError, match="cut off before it began"):
            read_run(folder)

    def test_a_failed_run_is_shown_as_far_as_it_came(self, tmp_path):
        run = read_run(write_run(tmp_path / "run", VALUES, PREFERENCES, error="ValueError: <nan>"))
        np.testing.assert_array_equal(run.values, VALUES)
        assert "did not finish (ValueError: &lt;nan&gt;)" in to_html([run], np.zeros(2), "")

    @pytest.mark.parametrize("more", ["\n", '{"event": "evalu', "\0\0\0\n"], ids=["an empty line", "a torn line", "NULs"])
    def test_what_was_cut_off_after_the_end_is_ignored(self, tmp_path, more):
        folder = write_run(tmp_path / "run", VALUES, PREFERENCES)
        with open(folder / "record.jsonl", "a") as record:
            record.write(more)
        np.testing.assert_array_equal(read_run(folder).values, VALUES)

    def test_of_an_unfinished_run_the_best_model_is_filmed(self, tmp_path):
        for error, expected in ((None, "model.zip"), ("ValueError: it fell", "best_model.zip")):
            folder = write_run(tmp_path / expected, VALUES, PREFERENCES, error=error)
            for name in ("model.zip", "best_model.zip"):
                (folder / name).touch()
            assert read_run(folder).model == folder / expected

    def test_runs_of_different_tasks(self, tmp_path):
        folders = [write_run(tmp_path / env, VALUES, PREFERENCES, env=env) for env in ("MO-Hopper-v4", "MO-Walker2d-v4")]
        with pytest.raises(ValueError, match=r"run of MO-Hopper-v4, .* one of MO-Walker2d-v4: .* Make a report of each task"):
            read_runs(folders)

    def test_runs_of_one_name_are_told_apart(self, tmp_path):
        folders = [write_run(tmp_path / name, VALUES, PREFERENCES) for name in ("one", "two")]
        assert [run.name for run in read_runs(folders)] == [f"method, seed 0, {folder}" for folder in folders]

    def test_reference_points_that_differ(self, tmp_path):
        folders = [write_run(tmp_path / str(x), VALUES, PREFERENCES, reference_point=[x, x]) for x in (0.0, -1.0)]
        with pytest.raises(ValueError, match=r"\[\(-1.0, -1.0\), \(0.0, 0.0\)\]: choose one with --reference-point"):
            report.write_report(folders, tmp_path / "report.html", 0)
        with pytest.raises(ValueError, match=r"has 2 objectives in .*, the reference point \[2.0\] has 1 numbers"):
            report.write_report(folders, tmp_path / "report.html", 0, [2])
        assert not (tmp_path / "report.html").exists()
        report.write_report(folders, tmp_path / "report.html", 0, [2, 3])
        assert (tmp_path / "report.html").exists()

    def test_a_front_of_another_evaluation_gives_no_spread(self, tmp_path):
        folder = write_run(tmp_path / "run", VALUES, PREFERENCES, returns=np.stack([VALUES, VALUES + 8], axis=1))
        assert read_run(folder).spread is None

    def test_a_set_of_solutions_has_no_preferences(self, tmp_path):
        run = read_run(write_run(tmp_path / "run", VALUES[:2], PREFERENCES, general_policy=False))
        assert run.preferences is None
        page = to_html([run], np.zeros(2), "")
        assert "regret-title" not in page
        assert "several policies" in page

    @pytest.mark.parametrize("method", ["pgmorl", "dpmorl", "gpi_ls_utd_1"])
    def test_runs_of_the_baselines_are_read(self, method):
        results = Path(__file__).parents[1] / "docs" / "results" / "comparison"
        run = read_run(next(results.glob(f"*/{method}/MO-HalfCheetah-v4/0")))
        assert (run.preferences is None) == (not run.record.general_policy)
        assert run.values.shape == run.record.final_values.shape


@pytest.mark.parametrize(
    ("command", "name"), [("report", "report.html"), ("strobe", "strobe.png"), ("calibrate", "calibration.png")]
)
def test_no_output_goes_through_a_link_in_the_runs_folder(command, name, tiny_run, tmp_path):
    folder, precious = tmp_path / "run", tmp_path / "precious.txt"
    shutil.copytree(tiny_run, folder)
    precious.write_text("mine")
    (folder / name).symlink_to("../precious.txt")
    fail([command, folder], rf"error: .*{name} is a symbolic link to \.\./precious\.txt: .* with --output")
    assert precious.read_text() == "mine"


def test_a_link_that_is_given_as_the_output_is_followed(tmp_path):
    folder = write_run(tmp_path / "run", VALUES, PREFERENCES)
    (tmp_path / "link.html").symlink_to("page.html")
    main(["report", str(folder), "--output", str(tmp_path / "link.html")])
    assert (tmp_path / "link.html").is_symlink()
    assert (tmp_path / "page.html").stat().st_size > 1_000


def test_the_command_says_what_is_wrong(tmp_path):
    with pytest.raises(SystemExit, match=r"error: .*is no run"):
        main(["report", str(tmp_path)])
    with pytest.raises(SystemExit, match="error: --films -1"):
        main(["report", str(tmp_path), "--films", "-1"])


def test_without_opengl_a_report_says_why(tiny_run, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    run = read_run(tiny_run)
    add_films(run, 2)
    assert run.films == {}
    assert "MUJOCO_GL is 'disable'" in run.no_films
    assert "MUJOCO_GL is 'disable'" in to_html([run], np.zeros(2), "")


def test_the_users_choice_of_opengl_is_the_only_one_tried(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert backends() == ("osmesa",)
    monkeypatch.setenv("MUJOCO_GL", "vulkan")
    with pytest.raises(RenderingError, match="'vulkan': leave it out, or set it to egl or osmesa"):
        backends()


def test_a_name_that_mujoco_does_not_know_is_for_whoever_draws():
    code = "import sb3_momba; from sb3_momba.explorer.stage import backends; backends()"
    environment = {**os.environ, "MUJOCO_GL": "vulkan"}
    ended = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert "RenderingError: the environment variable MUJOCO_GL is 'vulkan': leave it out" in ended.stderr


def test_what_rounding_does_to_bounds_is_no_news():
    bound = np.full(1, 0.1)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        gym.spaces.Box(-bound, bound, dtype=np.float32)
        n = len(warned)
        quieten()
        gym.spaces.Box(-bound, bound, dtype=np.float32)
    assert n > 0
    assert len(warned) == n


def test_a_model_of_another_environment(tiny_run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(tiny_run, folder)
    MOMBA("MlpPolicy", "MO-Walker2d-v4", policy_kwargs={"net_arch": [8]}, buffer_size=10).save(folder / "model.zip")
    run = read_run(folder)
    add_films(run, 2)
    assert run.films == {}
    assert run.no_films == "The model's observation_space has shape (19,), that of MO-Hopper-v4 has (13,)."


def test_a_filmed_episode_is_that_of_the_evaluation(tmp_path):
    """Where the task is random, each preference's first episode has its own place among all of them."""
    env, path = "MO-Humanoid-v4", tmp_path / "model.zip"
    model = MOMBA("MlpPolicy", env, policy_kwargs=TINY, buffer_size=10, seed=0)
    model.save(path)
    front = evaluate_front(model, env, n_preferences=3, n_episodes=2, seed=5)
    policy = Policy(path, env, {})
    for k in (0, 2):
        w = front.preferences[k]
        positions, returns = record_episode(
            policy, w, 2 * k, 5, lambda: gym.make(env), lambda one: one.unwrapped.data.qpos[0], 1
        )
        np.testing.assert_array_equal(returns[-1], front.returns[k, 0])
        assert len(positions) == len(returns) == front.episode_lengths[k, 0] + 1


def test_films_are_in_real_time_unless_they_would_be_too_long():
    class Env(gym.Env):
        def __init__(self, longest: int):
            self.spec = EnvSpec("A-v0", max_episode_steps=longest)

    assert stride_of(Env(500), 0.01) == 5  # 20 frames a second
    assert stride_of(Env(500), 0.05) == 2  # 250 frames
    assert stride_of(Env(1001), 0.05) == 5
    assert stride_of(Env(100), 1.0) == 1


def test_an_environment_that_draws_itself_is_filmed_without_opengl(tmp_path):
    env, path = "Drawing-v0", tmp_path / "model.zip"
    gym.register(env, entry_point="tests.stubs:StubEnv", max_episode_steps=8, kwargs={"episode_length": 8})
    try:
        tiny_model(env).save(path)
        one = film(Policy(path, env, {}), np.array([0.5, 0.5]), 0, 0, "")
    finally:
        del gym.registry[env]
    # Rewards of the steps 1 to 8 are (t, -10 t).
    np.testing.assert_array_equal(one.total, [36, -360])
    np.testing.assert_array_equal(one.returns[:, 0], np.cumsum(range(9)))
    assert one.steps == 8
    assert one.stride == 1
    assert one.speed is None
    assert one.video[4:8] == b"ftyp"


def look_on(task: str, backend: str, n_steps: int) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
    """The observations and rewards of two episodes of the same actions, the second one drawn, and its last image."""
    seen = []
    image = np.zeros(0)
    for is_drawn in (False, True):
        env = gym.make(task)
        observation, _ = env.reset(seed=0)
        env.action_space.seed(0)
        stage = Stage(env.unwrapped.model, 64, 48, backend) if is_drawn else None
        camera = camera_on(env.unwrapped.model, env.unwrapped.data)
        trajectory = [observation]
        for _ in range(n_steps):
            if stage is not None:
                image = stage.image(env.unwrapped.data, follow(camera, env.unwrapped.data))
            observation, reward, *_ = env.step(env.action_space.sample())
            trajectory += [observation, reward]
        seen.append(trajectory)
        if stage is not None:
            stage.close()
    return seen[0], seen[1], image


@needs_gl
def test_drawing_changes_no_trajectory_of_any_task():
    with RenderingProcess() as process:
        for task in TASKS:
            unseen, seen, image = process.call(look_on, task, process.backend, 5)
            for ours, theirs in zip(unseen, seen, strict=True):
                np.testing.assert_array_equal(ours, theirs)
            assert image.shape == (48, 64, 3)
            assert image.std() > 3, task
            # The body is in the middle: what is there is coloured, the floor is grey.
            middle = image[12:36, 20:44].astype(int)
            assert (np.ptp(middle, axis=2) > 20).any(), task


@needs_gl
def test_films_show_what_was_evaluated(tiny_run):
    run = read_run(tiny_run)
    front = ParetoFront.load(tiny_run / "front.npz")
    add_films(run, 3)
    assert run.no_films == ""
    assert list(run.films) == [0, 2, 4]
    for k, one in run.films.items():
        np.testing.assert_array_equal(one.total, front.returns[k, 0])
        assert one.steps == front.episode_lengths[k, 0]
        assert one.stride == 5
        assert one.speed == pytest.approx(1)
        assert len(one.returns) == one.steps // 5 + 1
        np.testing.assert_array_equal(one.returns[0], [0, 0])
        assert one.video[4:8] == b"ftyp"
        assert len(one.video) < 300_000


LONELY = """
import os, sys
from sb3_momba.explorer.rendering import RenderingProcess
if __name__ == "__main__":
    with RenderingProcess(needs_gl=False) as process:
        print(process.call(os.getpid), flush=True)
        sys.stdin.read()
"""


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL], ids=lambda how: how.name)
def test_no_process_is_left_behind(how, tmp_path):
    (tmp_path / "lonely.py").write_text(LONELY)
    started = subprocess.Popen([sys.executable, tmp_path / "lonely.py"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    pid = int(started.stdout.readline())
    assert psutil.pid_exists(pid)
    started.send_signal(how)
    started.communicate()
    psutil.wait_procs([psutil.Process(pid)] if psutil.pid_exists(pid) else [], timeout=30)
    assert not psutil.pid_exists(pid)


def test_a_crash_of_the_process_is_said():
    with RenderingProcess(needs_gl=False) as process, pytest.raises(RenderingError, match="crashed"):
        process.call(os._exit, 1)


@needs_gl
def test_strobe_pictures(tiny_run, tmp_path):
    preferences, path = [[1.0, 0.0], [0.0, 1.0]], tmp_path / "strobe.png"
    rows = draw_strobe(tiny_run, path, preferences, 20, 4, width=320)
    assert path.read_bytes()[:4] == b"\x89PNG"
    policy = read_run(tiny_run).policy
    for row, preference in zip(rows, preferences, strict=True):
        centres, _ = record_episode(policy, np.array(preference), 0, 0, lambda: gym.make(policy.env), mass_centre, 1)
        assert row.steps == 20
        assert row.distance == pytest.approx(centres[20] - centres[0])
        assert row.image.shape == rows[0].image.shape
        assert row.image.shape[1] == 320


def mass_centre(env: gym.Env) -> float:
    """Its place along x, computed anew: after a step the state is further than what was computed from it."""
    mujoco.mj_forward(env.unwrapped.model, env.unwrapped.data)
    return float(env.unwrapped.data.subtree_com[0, 0])


def test_strobe_pictures_that_cannot_be(tiny_run, tmp_path):
    path = tmp_path / "strobe.png"
    with pytest.raises(ValueError, match="sums to"):
        draw_strobe(tiny_run, path, [[0.5, 0.7]])
    fail(["strobe", tiny_run, "--output", path, "--preferences", "1,0", "-0.5,1.5"], "has a negative weight")
    fail(["strobe", tiny_run, "--output", path, "--preferences", "-0.5,1.5"], "has a negative weight")
    with pytest.raises(ValueError, match="--poses 0"):
        draw_strobe(tiny_run, path, n_poses=0)
    folder = write_run(tmp_path / "run", VALUES, PREFERENCES)
    with pytest.raises(ValueError, match=r"no model \(model.zip or best_model.zip\)"):
        draw_strobe(folder, path)
    assert not path.exists()


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory) -> Path:
    return train_tiny(tmp_path_factory.mktemp("explorer") / "run")
