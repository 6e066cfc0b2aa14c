"""The baselines: PGMORL and GPI-LS by morl-baselines, DPMORL, and the records that all of them leave."""

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_momba import runs
from sb3_momba.baselines import dpmorl
from sb3_momba.baselines import runs as baseline_runs
from sb3_momba.baselines.__main__ import main, parse
from sb3_momba.baselines.dpmorl import rollout_steps
from sb3_momba.baselines.judging import CLIP, EPSILON
from sb3_momba.baselines.returns import UtilityReward
from sb3_momba.baselines.runs import Baseline, make_baseline, run
from sb3_momba.baselines.schedules import OF_OTHERS, SCRIPTS, Script, default_steps, iterations, schedule
from sb3_momba.baselines.settings import ALGORITHMS, BaselineSettings
from sb3_momba.baselines.utilities import linear_utilities
from sb3_momba.benchmark.__main__ import main as benchmark
from sb3_momba.envs.registry import TASKS
from sb3_momba.records import Record, read_record
from tests.stubs import TINY_SIMBA

EPISODE = 8


class Steer(gym.Env):
    """A point on a line, moved by the action; it earns for being near each of its goals. Counts the steps of all instances."""

    deterministic = True
    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"]}
    n_steps: ClassVar[int] = 0

    def __init__(self, n_objectives: int = 2, render_mode: str | None = None):
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.reward_space = spaces.Box(-np.inf, np.inf, (n_objectives,), np.float64)
        self.goals = np.linspace(-1, 1, n_objectives)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.t = 0.1, 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool, bool, dict[str, Any]]:
        Steer.n_steps += 1
        self.x, self.t = self.x + 0.3 * float(np.clip(action, -1, 1)[0]), self.t + 1
        return self._observe(), 4 - np.abs(self.x - self.goals), False, False, {}

    def _observe(self) -> np.ndarray:
        return np.array([10 * self.x, self.t / EPISODE])


class Gust(Steer):
    """The same in a wind, and over where the point leaves the field."""

    deterministic = False

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool, bool, dict[str, Any]]:
        self.x += 0.2 * self.np_random.standard_normal()
        observation, reward, _, _, info = super().step(action)
        return observation, reward, abs(self.x) > 1, False, info


gym.register("Gust2-v0", Gust, max_episode_steps=EPISODE, disable_env_checker=True)
for number in (1, 2, 3, 4):
    gym.register(
        f"Steer{number}-v0", Steer, max_episode_steps=EPISODE, disable_env_checker=True, kwargs={"n_objectives": number}
    )

ENV = "Steer2-v0"
TINY = {
    "pgmorl": {"steps_per_iteration": 16, "num_envs": 2, "num_minibatches": 2, "delta_weight": 1 / 3, "net_arch": [8]},
    "gpi_ls": {"timesteps_per_iter": 40, "gradient_updates": 1, "buffer_size": 500, "learning_starts": 20, "net_arch": [8, 8]},
    "dpmorl": {"n_policies": 4, "n_envs": 2, "n_steps": 8, "random_episodes": 3, "net_arch": [8]},
}
STEPS = {"pgmorl": 640, "gpi_ls": 120, "dpmorl": 256}  # 640 = 5 iterations of 16 steps of 2 environments for 4 policies
SMALL = {"eval_freq": 100, "n_preferences": 5, "n_episodes": 2, "seed": 3, "device": "cpu"}


def settings_of(algorithm: str, folder: Path, **changed: Any) -> BaselineSettings:
    given = {"env": ENV, "steps": STEPS[algorithm], "hyperparameters": dict(TINY[algorithm]), **SMALL, **changed}
    return BaselineSettings(algorithm, output=str(folder), **given)


def lines_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.fixture(scope="module", autouse=True)
def no_wandb() -> Iterator[None]:
    """morl-baselines imports it; nothing may ever call it."""
    import wandb

    def refuse(*args: Any, **kwargs: Any) -> None:
        raise AssertionError("W&B was called.")

    with pytest.MonkeyPatch.context() as patch:
        for name in ("init", "log", "finish", "login", "setup", "define_metric"):
            patch.setattr(wandb, name, refuse)
        yield


def run_once(algorithm: str, folder: Path) -> SimpleNamespace:
    """A run, and the algorithm that it trained."""
    settings = settings_of(algorithm, folder)
    made: list[Any] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(baseline_runs, "make_baseline", lambda *args: made.append(make_baseline(*args)) or made[0])
        result = run(settings)
    path = folder / "record.jsonl"
    lines = lines_of(path)
    return SimpleNamespace(settings=settings, result=result, lines=lines, record=read_record(path), trained=made[0])


@pytest.fixture(scope="module", params=ALGORITHMS)
def tiny(request, tmp_path_factory) -> SimpleNamespace:
    """One run of each baseline."""
    return run_once(request.param, tmp_path_factory.mktemp(request.param) / "run")


# ------------------------------------------------------------------------------------------------------------ records


def test_a_record_says_what_was_run(tiny) -> None:
    algorithm, record = tiny.settings.algorithm, tiny.record
    assert (record.label, record.env, record.seed, record.env_kwargs) == (algorithm, ENV, 3, {})
    assert record.general_policy is (algorithm == "gpi_ls")
    assert record.preferences.tolist() == [[w, 1 - w] for w in (0.0, 0.25, 0.5, 0.75, 1.0)]
    assert record.reference_point.tolist() == [0, 0]
    assert (record.config["algorithm"], record.config["steps"], record.config["n_episodes"]) == (algorithm, STEPS[algorithm], 2)
    assert "output" not in record.config
    chosen = record.config["hyperparameters"]
    assert {name: chosen[name] for name in TINY[algorithm]} == TINY[algorithm]
    assert chosen["learning_rate"] == 3e-4
    assert record.error is None


def test_a_record_has_floors_and_a_curve(tiny) -> None:
    record, is_general = tiny.record, tiny.record.general_policy
    assert [floor.policy for floor in record.floors] == ["standing still", "random actions"]
    still = EPISODE * (4 - np.abs(0.1 - np.array([-1, 1])))
    np.testing.assert_allclose(record.floors[0].values, [still] * 5)
    events = [line for line in tiny.lines if line["event"] == "evaluation"]
    steps = [event["steps"] for event in events]
    assert steps == tiny.result.timesteps == sorted(set(steps))
    assert len(steps) >= 2
    assert steps[0] >= 100
    assert steps[-1] == tiny.lines[-1]["steps"] == STEPS[tiny.settings.algorithm]
    for event in events:
        assert ("preference_regret" in event) is is_general
        assert len(event["values"]) == 5 or not is_general
        assert min(event["seconds"], event["cpu_seconds"], event["evaluation_seconds"]) >= 0
    extra = [event["extra_steps"] for event in events]
    assert extra == sorted(extra)
    assert extra[-1] == tiny.lines[-1]["extra_steps"]
    np.testing.assert_allclose(record.final_values, record.evaluations[-1].values)


def test_one_episode_stands_for_all_where_nothing_is_random(tiny) -> None:
    front = tiny.lines[-1]["front"]
    n = 5 if tiny.record.general_policy else len(tiny.record.final_values)
    assert np.shape(front["returns"]) == np.shape(front["discounted_returns"]) == (n, 1, 2)
    assert front["episode_lengths"] == [[EPISODE]] * n
    assert (front["settings"]["deterministic_policy"], front["settings"]["deterministic_env"]) == (True, True)


def test_the_same_seed_gives_the_same_record(tiny, tmp_path) -> None:
    def without_times(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
        drop = ("seconds", "cpu_seconds", "evaluation_seconds", "started")
        return [{name: value for name, value in line.items() if name not in drop} for line in lines]

    again = run_once(tiny.settings.algorithm, tmp_path / "again")
    assert without_times(again.lines) == without_times(tiny.lines)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_three_objectives(tmp_path, algorithm: str) -> None:
    steps = {**STEPS, "pgmorl": 5 * 16 * 2 * 6}[algorithm]
    settings = settings_of(algorithm, tmp_path / "run", env="Steer3-v0", eval_freq=10_000, steps=steps)
    more = {"gpi_ls": {"num_eval_episodes_for_front": 1}, "pgmorl": {"delta_weight": 0.5}, "dpmorl": {}}
    settings.hyperparameters.update(more[algorithm])
    run(settings)
    record = read_record(tmp_path / "run" / "record.jsonl")
    assert record.error is None
    assert record.final_values.shape[1] == record.preferences.shape[1] == 3


@pytest.mark.parametrize("env", [ENV, "Gust2-v0"])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_evaluations_do_not_change_the_training(tmp_path, algorithm: str, env: str) -> None:
    often, never = (run(settings_of(algorithm, tmp_path / str(n), env=env, eval_freq=n)) for n in (20, 10_000))
    assert len(often.timesteps) >= 4
    assert len(never.timesteps) == 1
    assert often.metrics[-1] == never.metrics[-1]


def test_the_report_takes_them_beside_a_record_of_momba(tmp_path_factory, tmp_path, capsys) -> None:
    hyperparameters = {"learning_starts": 20, "buffer_size": 200, "batch_size": 8, "policy_kwargs": TINY_SIMBA}
    shared = {"n_preferences": 5, "n_episodes": 2, "seed": 3, "device": "cpu"}
    runs.run(
        runs.RunSettings(ENV, str(tmp_path / "momba"), steps=60, hyperparameters=hyperparameters, progress_bar=False, **shared)
    )
    for algorithm in ("gpi_ls", "dpmorl"):
        run(settings_of(algorithm, tmp_path / algorithm, label=f"{algorithm}_mine"))
    benchmark(["report", str(tmp_path)])
    said = capsys.readouterr().out
    for name in ("momba", "gpi_ls_mine", "dpmorl_mine", "standing still"):
        assert name in said


def test_the_report_takes_each(tiny, capsys, tmp_path) -> None:
    benchmark(["report", tiny.settings.output, "--output", str(tmp_path / "report")])
    assert tiny.settings.algorithm in capsys.readouterr().out


# --------------------------------------------------------------------------------------------------------- evaluation


def roll_out(act: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """The return of one episode of the raw task, (2,).

    :param act: (observation, return so far) -> action
    """
    env = gym.make(ENV)
    observation, _ = env.reset(seed=0)
    total, ended = np.zeros(2), False
    while not ended:
        observation, reward, terminated, truncated, _ = env.step(act(observation, total))
        total, ended = total + reward, terminated or truncated
    return total


def by_hand(trained: Any, algorithm: str) -> list[np.ndarray]:
    """The returns of the policies, rolled out one by one with the networks themselves."""
    if algorithm == "gpi_ls":
        networks = [(trained.agent.policy, th.tensor([w, 1 - w])) for w in (0.0, 0.25, 0.5, 0.75, 1.0)]
        return [
            roll_out(lambda s, z, n=net, w=w: n(th.tensor(s).float()[None], w[None]).detach().numpy()[0]) for net, w in networks
        ]
    if algorithm == "pgmorl":
        return [of_pgmorl(policy.networks) for policy in trained.agent.archive.individuals]
    raise AssertionError(algorithm)


def of_pgmorl(network: Any) -> np.ndarray:
    """The return of one of PGMORL's networks, with its statistics."""
    of = network.statistics

    def act(s: np.ndarray, z: np.ndarray) -> np.ndarray:
        normalized = np.clip((s - of.mean) / np.sqrt(of.variance + EPSILON), -CLIP, CLIP)
        return np.clip(network.actor_mean(th.tensor(normalized).float()[None]).detach().numpy()[0], -1, 1)

    return roll_out(act)


def test_an_evaluation_is_a_rollout_by_hand(tiny) -> None:
    trained = tiny.trained
    values = trained.evaluate(tiny.record.preferences).values
    np.testing.assert_allclose(values, tiny.record.final_values)
    if tiny.settings.algorithm != "dpmorl":  # Its policies are not at hand: see the next test.
        np.testing.assert_allclose(values, by_hand(trained, tiny.settings.algorithm), rtol=1e-5)


def test_dpmorl_names_the_policies_that_none_dominates(tmp_path) -> None:
    made: Any = make_baseline(settings_of("dpmorl", tmp_path), 2)
    returns = [[[1.0, 2.0]], [[0.0, 1.0]], [[2.0, 1.0]]]
    fronts = [
        SimpleNamespace(returns=np.array([r]), discounted_returns=np.array([r]), episode_lengths=np.array([[8]]))
        for r in returns
    ]
    for front in fronts:
        front.settings = {"deterministic_policy": True}
    made.finished = [dpmorl.Trained(None, made.low, made.high, played=front) for front in fronts]
    found = made.evaluate(np.eye(2))
    made.close()
    assert found.values.tolist() == [[1, 2], [0, 1], [2, 1]]
    assert found.settings == {"deterministic_policy": True, "non_dominated": [0, 2]}


def test_an_evaluation_of_dpmorl_shows_its_policies_their_returns(tmp_path) -> None:
    made = make_baseline(settings_of("dpmorl", tmp_path), 2)
    made.low, made.high = np.array([-1.0, 0.0]), np.array([3.0, 50.0])
    made.model.num_timesteps = 8

    def act(s: np.ndarray, z: np.ndarray) -> np.ndarray:
        shown = np.concatenate([s, [np.log1p((z[0] + 1) / 4), np.log1p(z[1] / 50)]]).astype(np.float32)
        return made.model.predict(shown, deterministic=True)[0]

    np.testing.assert_allclose(made.evaluate(np.eye(2)).values, [roll_out(act)], rtol=1e-5)
    made.close()


def test_each_policy_of_dpmorl_is_trained_for_its_own_utility(tmp_path, monkeypatch) -> None:
    """The rewards of its episodes add up to f(z_T) - f(0), f its utility over the range of returns that was known."""
    made: Any = make_baseline(settings_of("dpmorl", tmp_path, steps=512), 2)
    generated, episodes = [], []
    generate, step_wait = dpmorl.generate_utilities, UtilityReward.step_wait
    monkeypatch.setattr(dpmorl, "generate_utilities", lambda *args: generated.extend(generate(*args)) or generated)

    def noting(self: Any) -> Any:
        observations, rewards, dones, infos = step_wait(self)
        totals = self.__dict__.setdefault("totals", np.zeros(self.num_envs))
        totals += rewards
        for i in dones.nonzero()[0]:
            episodes.append((len(made.finished), made.low, made.high, infos[i]["accumulated_return"], totals[i]))
            totals[i] = 0
        return observations, rewards, dones, infos

    monkeypatch.setattr(UtilityReward, "step_wait", noting)
    made.train(lambda: None)
    made.close()
    assert [index for index, *_ in episodes] == [i for i in range(4) for _ in range(512 // 4 // EPISODE)]
    for index, low, high, z, total in episodes:
        width = (high - low).max()
        lowest = (low + high - width) / 2
        ends = th.from_numpy(np.stack([z, np.zeros(2)]) - lowest) / width
        f = 2 * width * generated[index](ends).detach().numpy()
        assert total == pytest.approx(f[0] - f[1], abs=1e-6)
    means = [total - z.sum() for index, _, _, z, total in episodes if index > 0]
    assert max(np.abs(means)) > 0.1  # The others' rewards are not the first one's, the sum of both objectives.


@pytest.mark.parametrize(("n_envs", "said"), [(20, True), (1, False)])
def test_dpmorl_warns_where_no_policy_may_see_a_whole_return(tmp_path, caplog, n_envs: int, said: bool) -> None:
    """50,000 steps of 10 policies in 20 environments are 250 of each; an episode has 500."""
    settings = BaselineSettings(
        "dpmorl", "MO-HalfCheetah-v4", str(tmp_path / "run"), 50_000, hyperparameters={"n_envs": n_envs}
    )
    make_baseline(settings, 2).close()
    assert ("has 250 steps, fewer than an episode of MO-HalfCheetah-v4 may have (500)" in caplog.text) is said


def test_each_policy_of_dpmorl_has_a_seed_of_its_own_whatever_the_runs(tmp_path) -> None:
    """Neighbouring seeds of a run share none, and the largest 32-bit one is taken."""
    seeds = []
    for seed in (0, 1, 2**32 - 1):
        made: Any = make_baseline(settings_of("dpmorl", tmp_path, seed=seed), 2)
        seeds += [made._make_model(index, linear_utilities(2)[0]).seed for index in range(2)]
    assert len(set(seeds)) == 6


def test_the_statistics_of_pgmorl_are_of_all_its_environments(tiny) -> None:
    trained = tiny.trained
    if tiny.settings.algorithm != "pgmorl":
        assert not hasattr(trained, "judge")
        return
    seen = [env.get_wrapper_attr("obs_rms") for env in trained.agent.env.envs]
    counts = np.array([one.count for one in seen])
    mean = np.average([one.mean for one in seen], axis=0, weights=counts)
    squares = np.average([one.var + one.mean**2 for one in seen], axis=0, weights=counts)
    np.testing.assert_allclose(trained.judge.statistics.mean, mean)
    np.testing.assert_allclose(trained.judge.statistics.variance, squares - mean**2)
    assert counts.sum() > STEPS["pgmorl"]  # resets are seen too


def test_steps_of_the_algorithms_own_episodes_are_counted(tmp_path) -> None:
    made = make_baseline(settings_of("gpi_ls", tmp_path), 2)
    before = Steer.n_steps
    made.train(lambda: None)
    assert made.steps == 120
    assert made.extra_steps > 0
    assert made.extra_steps % (5 * EPISODE) == 0  # five episodes for each
    assert Steer.n_steps - before == made.steps + made.extra_steps
    made.close()


def test_the_extra_steps_by_hand(tiny) -> None:
    algorithm, extra = tiny.settings.algorithm, tiny.lines[-1]["extra_steps"]
    if algorithm == "pgmorl":  # an episode of each of 4 policies: at the start, and after each of 5 iterations
        assert extra == (1 + 5) * 4 * EPISODE
    if algorithm == "dpmorl":  # of random actions
        assert extra == 3 * EPISODE


def test_pgmorl_judges_by_raw_returns(tmp_path) -> None:
    made: Any = make_baseline(settings_of("pgmorl", tmp_path), 2)
    made.judge.begin()
    assert made.extra_steps == 4 * EPISODE
    assert (made.agent.archive.evaluations, made.agent.population.evaluations) == ([], [])
    made.judge.judge(is_generation=True)
    made.close()
    assert made.extra_steps == 2 * 4 * EPISODE
    earned = [of_pgmorl(policy.networks) for policy in made.agent.agents]
    for found in (made.agent.predictor.previous_performance, made.agent.predictor.next_performance):
        np.testing.assert_allclose(found, earned, rtol=1e-5)
    found = made.agent.archive.evaluations
    np.testing.assert_allclose(found, made.evaluate(np.eye(2)).values)
    assert 0 < len(found) <= 4
    judged = {tuple(value) for value in made.agent.predictor.next_performance}
    assert {tuple(value) for value in (*found, *made.agent.population.evaluations)} <= judged


def test_pgmorl_can_judge_as_the_library_does(tmp_path) -> None:
    """Five stochastic episodes for each policy; its numbers are not those of the record."""
    hyperparameters = {**TINY["pgmorl"], "library_evaluation": True}
    made: Any = make_baseline(settings_of("pgmorl", tmp_path, hyperparameters=hyperparameters), 2)
    made.train(lambda: None)
    made.close()
    assert made.extra_steps == 3 * 4 * 5 * EPISODE  # at the start, after the warm-up, after the one generation
    assert len(made.agent.predictor.used_weight) == 2 * 4
    values, judged = made.evaluate(np.eye(2)).values, made.agent.archive.evaluations
    assert len(values) == len(judged) > 0
    assert not any(np.allclose(value, earned) for value in values for earned in judged)


def flat_parameters(network: Any) -> tuple[float, ...]:
    return tuple(th.nn.utils.parameters_to_vector(network.parameters()).tolist())


@pytest.fixture(scope="module")
def lineage(tmp_path_factory) -> SimpleNamespace:
    """PGMORL over a warm-up of 4 iterations, generations of 2 and a last one of 1: what each policy was when it was chosen."""
    hyperparameters = {**TINY["pgmorl"], "warmup_iterations": 4, "evolutionary_iterations": 2}
    made: Any = make_baseline(
        settings_of("pgmorl", tmp_path_factory.mktemp("x"), steps=9 * 128, hyperparameters=hyperparameters), 2
    )
    agent, seen = made.agent, SimpleNamespace(made=made, parents=[], candidates=0, seeds=set())
    choose, watched = type(agent)._PGMORL__task_weight_selection, type(agent)

    def choosing(self: Any, *args: Any, **kwargs: Any) -> None:
        members = zip(agent.population.individuals, agent.population.evaluations, strict=True)
        earned = {flat_parameters(policy.networks): value for policy, value in members}
        choose(self, *args, **kwargs)
        seen.parents.append([earned[flat_parameters(policy.networks)] for policy in agent.agents])
        seen.seeds |= {policy.seed for policy in agent.agents}

    def between_steps() -> None:
        seen.candidates += 4

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(watched, "_PGMORL__task_weight_selection", choosing)
        seen.first = [policy.networks for policy in agent.agents]
        made.train(between_steps)
    made.close()
    return seen


def test_pgmorl_predicts_from_what_parents_and_children_earned(lineage) -> None:
    """Samples at the iterations 2 and 4 of the warm-up and at the ends of the generations, 6 and 8: four policies each."""
    predictor = lineage.made.agent.predictor
    before, after = (np.reshape(x, (4, 4, 2)) for x in (predictor.previous_performance, predictor.next_performance))
    assert len(lineage.parents) == 3
    np.testing.assert_array_equal(before[1], after[0])  # in the warm-up each policy is its own parent
    np.testing.assert_array_equal(before[2], lineage.parents[0])
    np.testing.assert_array_equal(before[3], lineage.parents[1])
    chosen_from_others = [not np.array_equal(parents, slots) for parents, slots in zip(before[2:], after[1:3], strict=True)]
    assert any(chosen_from_others)


def test_pgmorl_ends_with_a_generation_that_fits(lineage) -> None:
    assert lineage.made.steps == 9 * 128
    assert lineage.made.extra_steps == (1 + 9) * 4 * EPISODE


def test_what_pgmorl_keeps_has_no_rollouts_and_what_it_trains_the_runs_seed(lineage) -> None:
    agent = lineage.made.agent
    assert all(policy.batch is None for policy in (*agent.archive.individuals, *agent.population.individuals))
    assert all(policy.batch.obs.shape == (16, 2, 2) for policy in agent.agents)
    assert lineage.seeds == {3}
    assert all(policy.np_random is agent.np_random for policy in agent.agents)


# ---------------------------------------------------------------------------------------------------- tasks and sizes


@pytest.fixture(scope="module", params=ALGORITHMS)
def of_all_tasks(request, tmp_path_factory) -> tuple[str, dict[str, Baseline]]:
    """Each baseline on each task, in networks of its own size."""
    small: dict[str, dict[str, Any]] = {
        "pgmorl": {"num_envs": 1, "steps_per_iteration": 32, "num_minibatches": 4},
        "gpi_ls": {"buffer_size": 200},
        "dpmorl": {"n_envs": 1, "augment_state": False},
    }
    algorithm, made = request.param, {}
    for task in TASKS:
        n_objectives = 3 if "3obj" in task else 2
        steps = {"pgmorl": 5 * 32 * (15 if n_objectives == 3 else 6)}.get(algorithm, 10_000)
        settings = settings_of(algorithm, tmp_path_factory.mktemp("x"), env=task, steps=steps)
        settings.hyperparameters = small[algorithm]
        made[task] = make_baseline(settings, n_objectives)
    yield algorithm, made
    for one in made.values():
        one.close()


@pytest.mark.parametrize("task", ["MO-Humanoid-v4", "MO-Hopper-3obj-v4"])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_smallest_run_on_a_task(tmp_path, algorithm: str, task: str) -> None:
    """Where episodes end early: one where nothing is alike twice, one of three objectives."""
    small: dict[str, tuple[int, dict[str, Any]]] = {
        "pgmorl": (5 * 32 * 6, {"num_envs": 1, "steps_per_iteration": 32, "num_minibatches": 4, "net_arch": [8]}),
        "gpi_ls": (60, {**TINY["gpi_ls"], "timesteps_per_iter": 60, "num_eval_episodes_for_front": 1}),
        "dpmorl": (4 * 2 * 32, TINY["dpmorl"]),
    }
    steps, hyperparameters = small[algorithm]
    of_three = {"delta_weight": 0.5} if algorithm == "pgmorl" and "3obj" in task else {}
    settings = settings_of(algorithm, tmp_path / "run", env=task, steps=steps, n_preferences=3, n_episodes=1)
    settings.hyperparameters = {**hyperparameters, **of_three}
    run(settings)
    record = read_record(tmp_path / "run" / "record.jsonl")
    assert record.error is None
    assert record.evaluations[-1].steps == steps
    assert record.extra_steps > 0
    assert algorithm == "pgmorl" or len(record.final_values) == {"gpi_ls": 3, "dpmorl": 4}[algorithm]


def test_networks_are_as_large_as_the_thesis_says(of_all_tasks) -> None:
    """Table 4.2, the average of the tasks; DPMORL's are those of states without the return so far."""
    algorithm, made = of_all_tasks
    assert len(made) == 7
    sizes = [sum(one.parameters.values()) for one in made.values()]
    assert round(np.mean(sizes)) == {"pgmorl": 17_551, "gpi_ls": 259_119, "dpmorl": 17_477}[algorithm]


def test_policies_of_pgmorl_begin_with_the_gains_of_its_authors(of_all_tasks) -> None:
    """An orthogonal matrix has its gain as every singular value: 1 for mean actions, the root of 2 for values."""
    algorithm, made = of_all_tasks
    if algorithm != "pgmorl":
        return
    for baseline in made.values():
        policies: Any = baseline.agent.agents
        for policy in policies:
            for head, gain in ((policy.networks.actor_mean[-1], 1.0), (policy.networks.critic[-1], 2**0.5)):
                np.testing.assert_allclose(th.linalg.svdvals(head.weight.detach()), gain, rtol=1e-5)
                assert not head.bias.any()


def test_each_task_has_actions_for_its_start(of_all_tasks) -> None:
    algorithm, made = of_all_tasks
    for task, one in made.items():
        env = gym.make(task)
        n = env.unwrapped.reward_space.shape[0]
        s = np.concatenate([env.reset(seed=0)[0], np.full(n, 1 / n)])[None].astype(np.float32)
        if algorithm == "gpi_ls":
            actions = one.policy.predict(s)[0]
        elif algorithm == "pgmorl":
            actions = one.agent.agents[-1].networks.actor_mean(th.tensor(s[:, :-n])).detach().numpy()
            assert len(one.agent.agents) == one.hyperparameters["pop_size"] == (15 if n == 3 else 6)
        else:
            actions = dpmorl.PolicyOfReturns(one.model.policy, n).predict(s)[0]
        assert actions.shape == (1, *env.action_space.shape)
        assert np.isfinite(actions).all()


# ---------------------------------------------------------------------------------------------------------- schedules


@pytest.mark.parametrize(
    ("env", "n", "expected"),
    [
        ("MO-Swimmer-v4", 244, (40, 10)),
        ("MO-HalfCheetah-v4", 610, (80, 20)),
        ("MO-Walker2d-v4", 610, (80, 20)),
        ("MO-Ant-v4", 976, (200, 40)),
        ("MO-Hopper-v4", 976, (200, 40)),
        ("MO-Hopper-3obj-v4", 976, (200, 40)),
        ("MO-Humanoid-v4", 1220, (200, 40)),
    ],
    ids=str,
)
def test_the_schedule_of_pgmorl_is_that_of_its_authors(env: str, n: int, expected: tuple[int, int]) -> None:
    script = SCRIPTS[env]
    assert n * 2048 * script.num_envs * script.n_policies == script.steps == default_steps("pgmorl", env)
    assert schedule(n, script) == (script.warmup, script.generation) == expected


def test_the_budgets_of_pgmorl_are_those_of_table_4_2() -> None:
    """12M to 120M, of 2M to 20M for each policy."""
    steps = [script.steps for script in SCRIPTS.values()]
    assert set(SCRIPTS) == set(TASKS)
    assert (min(steps), max(steps)) == (11_993_088, 119_930_880)
    assert default_steps("pgmorl", "momba/MO-Humanoid-v4") == 119_930_880
    assert default_steps("pgmorl", "mine-v0") == OF_OTHERS.steps == 610 * 8192 * 6
    assert (default_steps("gpi_ls", "MO-Ant-v4"), default_steps("dpmorl", "MO-Ant-v4")) == (200_000, 10_000_000)


@pytest.mark.parametrize(
    ("n", "expected"), [(5, (4, 1)), (20, (4, 1)), (61, (12, 3)), (240, (40, 10)), (467, (76, 19)), (468, (200, 20))], ids=str
)
def test_the_schedule_of_a_short_training(n: int, expected: tuple[int, int]) -> None:
    assert schedule(n, Script(8_000_000, 200, 20)) == expected


def test_a_given_schedule_of_pgmorl() -> None:
    script = SCRIPTS["MO-HalfCheetah-v4"]
    assert schedule(100, script, 80, 20) == (80, 20)
    assert schedule(10, script, 5) == (5, 1)
    assert schedule(11, script, generation=2) == (8, 2)
    assert schedule(100, script, generation=20) == (80, 20)


def test_every_training_of_pgmorl_has_a_generation() -> None:
    for n in range(5, 1300):
        for script in (*SCRIPTS.values(), OF_OTHERS):
            warmup, generation = schedule(n, script)
            assert warmup >= 4 * generation
            assert n > warmup


@pytest.mark.parametrize(
    ("n", "given", "message"),
    [
        (2, (None, None), "has 2 iterations, and the warm-up 4: there must be one more"),
        (80, (80, 20), "has 80 iterations, and the warm-up 80"),
        (80, (10, 20), "warmup_iterations=10: .* evolutionary_iterations=20"),
    ],
    ids=range(3),
)
def test_a_schedule_that_cannot_be_is_refused(n: int, given: tuple[Any, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        schedule(n, OF_OTHERS, *given)


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        (1_000_000, r"49,152 steps.*give 983,040 \(20\) or 1,032,192 \(21\); 5 are the least\.$"),
        (100_000, r"give 245,760 \(5\); 5 are the least\.$"),
    ],
    ids=range(2),
)
def test_steps_that_are_no_iterations_of_pgmorl_are_refused(steps: int, message: str) -> None:
    assert iterations(983_040, 49_152) == 20
    with pytest.raises(ValueError, match=message):
        iterations(steps, 49_152)


@pytest.mark.parametrize(
    ("steps", "expected"), [(10_000_000, 2000), (1_000_000, 200), (100_000, 20), (100_000_000, 2000)], ids=str
)
def test_rollouts_of_dpmorl(steps: int, expected: int) -> None:
    n_steps = rollout_steps(steps, 10, 20, None)
    assert n_steps == expected
    assert steps % (10 * 20 * n_steps) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1_001, 10, 20, None), r"n_policies=10, each with n_envs=20.* multiple of 200, such as 1,000 or 1,200"),
        ((1_000_000, 10, 20, 2048), r"n_steps=2048: .* 1,000,000 / 10 / 20 = 5,000 steps"),
        ((200 * 5003, 10, 20, None), r"5,003 steps, which no rollout of about 200 divides: set n_steps"),
        ((10, 10, 1, 1), r"at least two transitions"),
    ],
    ids=range(4),
)
def test_steps_that_dpmorl_cannot_divide_are_refused(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rollout_steps(*arguments)


# --------------------------------------------------------------------------------------------------------- command line


def test_the_command_line() -> None:
    words = "gpi_ls --env MO-Hopper-v4 --steps 2e5 --seed 4 --output here --label gpi_ls_utd_1 --eval-freq 1e4 --n-episodes 3"
    settings = parse([*words.split(), "--set", "gradient_updates=1", "--set", "learning_rate=1e-3"])
    assert settings == BaselineSettings(
        "gpi_ls",
        "MO-Hopper-v4",
        "here",
        200_000,
        seed=4,
        label="gpi_ls_utd_1",
        hyperparameters={"gradient_updates": 1, "learning_rate": 1e-3},
        eval_freq=10_000,
        n_episodes=3,
    )
    short = parse(["dpmorl", "--env", "MO-Hopper-v4", "--steps", "1e6"])
    assert short.label == "dpmorl"
    assert short.output.startswith("runs/MO-Hopper-v4/dpmorl-")


def test_the_commands_of_the_page_are_understood() -> None:
    page = (Path(__file__).parent.parent / "docs" / "baselines.md").read_text()
    commands = re.findall(r"^python -m sb3_momba\.baselines (.+)$", page, re.MULTILINE)
    assert {parse(one.split()).algorithm for one in commands} == set(ALGORITHMS)


def command(algorithm: str, folder: Path, *more: str) -> list[str]:
    words = [algorithm, "--env", ENV, "--steps", str(STEPS[algorithm]), "--output", str(folder), "--device", "cpu"]
    words += ["--n-preferences", "5", "--n-episodes", "2", "--seed", "3"]
    tiny = [word for name, value in TINY[algorithm].items() for word in ("--set", f"{name}={value}")]
    return [*words, *tiny, *more]


def test_a_command_trains_and_prints_its_curve(tmp_path, capsys) -> None:
    main(command("dpmorl", tmp_path / "run", "--label", "mine"))
    said = capsys.readouterr().out
    assert "standing still" in said
    assert str(tmp_path / "run") in said
    assert read_record(tmp_path / "run" / "record.jsonl").label == "mine"


@pytest.mark.parametrize(
    ("algorithm", "more", "message"),
    [
        ("pgmorl", "--set pop_sise=4", r"pgmorl has no hyperparameter 'pop_sise'; it takes anneal_lr, .*pop_size"),
        ("gpi_ls", "--set pop_size=4", r"gpi_ls has no hyperparameter 'pop_size'; it takes .*gradient_updates"),
        ("dpmorl", "--set gradient_updates=4", r"dpmorl has no hyperparameter .* it takes .*n_policies"),
        ("gpi_ls", "--set dyna=true", "no hyperparameter 'dyna'"),
        ("gpi_ls", "--set log=true", "no hyperparameter 'log'"),
        ("gpi_ls", "--set gradient_updates=0", "gradient_updates=0: it must be a whole number of at least 1"),
        ("gpi_ls", "--set per=1", "per=1: it is a switch"),
        ("gpi_ls", "--set learning_rate=fast", "learning_rate='fast': give a finite number"),
        ("gpi_ls", "--set net_arch=64", r"net_arch=64: give a list such as \[256, 256\]"),
        ("gpi_ls", "--steps 130", "steps=130 is no whole number of iterations of 40: give 120 or 160"),
        ("gpi_ls", "--steps 30", "steps=30 .*: give 40, or"),
        ("pgmorl", "--steps 1000", r"1,000 is no whole number .* 128 steps .*: give 896 \(7\) or 1,024 \(8\)"),
        ("gpi_ls", "--set buffer_size=100", "buffer_size=100: a minibatch of batch_size=128 must fit"),
        ("gpi_ls", "--set learning_starts=160", "learning_starts=160 with steps=120: nothing would"),
        ("pgmorl", "--set pop_size=6", "pop_size=6: delta_weight=.* gives 4 weights"),
        ("pgmorl", "--set delta_weight=0.5", "gives 3 weights: PGMORL predicts from 4 policies.*divide 1"),
        ("pgmorl", "--set delta_weight=0", "delta_weight=0: give"),
        ("pgmorl", "--set num_minibatches=3", "num_minibatches=3: .* = 32"),
        ("pgmorl", "--env Steer4-v0", "has 4 objectives: PGMORL takes two or three"),
        ("dpmorl", "--steps 257", "multiple of 8, such as 256 or 264"),
        ("dpmorl", "--set linear_share=0", "linear_share=0"),
        ("dpmorl", "--env Steer1-v0", "has one objective"),
        ("dpmorl", "--env MO-Hoper-v4", "Did you mean"),
        ("dpmorl", "--eval-freq 0", "eval_freq=0"),
        ("dpmorl", "--seed -1", "seed=-1"),
        ("dpmorl", "--n-episodes 0", "n_episodes=0"),
        ("dpmorl", "--reference-point 0 0 0", "reference point"),
        ("dpmorl", "--set n_policies", "write NAME=VALUE"),
        ("dpmorl", "--set gamma=1.5", "gamma=1.5: it must be from 0 to 1"),
        ("dpmorl", "--set batch_size=1", "batch_size=1: it must be a whole number of at least 2"),
        ("dpmorl", "--set n_steps=2.5", "n_steps=2.5: it must be a whole number"),
        ("dpmorl", "--set clip_range=-0.2", r"clip_range=-0.2: it must be above 0\.$"),
        ("dpmorl", "--set gae_lambda=7", "gae_lambda=7: it must be from 0 to 1"),
        ("dpmorl", "--set learning_rate=0", r"learning_rate=0: it must be above 0\.$"),
        ("pgmorl", "--set clip_coef=0", "clip_coef=0: it must be above 0"),
        ("pgmorl", "--set target_kl=-1", "target_kl=-1: it must be above 0"),
        ("pgmorl", "--set warmup_iterations=2 --set evolutionary_iterations=3", "warmup_iterations=2: .*_iterations=3"),
        ("gpi_ls", "--set policy_noise=-1", r"policy_noise=-1: it must be at least 0\.$"),
        ("gpi_ls", "--set alpha=2", "alpha=2: it must be from 0 to 1"),
        *((algorithm, "--device gpu", "device='gpu' is no device .* give auto, cpu or cuda") for algorithm in ALGORITHMS),
    ],
    ids=range(42),
)
def test_what_cannot_be_is_refused_before_anything_is_written(tmp_path, algorithm: str, more: str, message: str, capfd) -> None:
    folder = tmp_path / "run"
    with pytest.raises(SystemExit) as refused:
        main(command(algorithm, folder, *more.split()))
    with pytest.raises(AssertionError, match=message):  # for its searching message
        raise AssertionError(str(refused.value))
    assert not folder.exists()


def test_a_baseline_that_is_none_is_refused(tmp_path, capsys) -> None:
    with pytest.raises(SystemExit):
        parse(["capql", "--env", ENV, "--steps", "1"])
    assert "'pgmorl', 'gpi_ls', 'dpmorl'" in capsys.readouterr().err
    with pytest.raises(ValueError, match="no baseline 'gpi-ls': did you mean 'gpi_ls'"):
        run(BaselineSettings("gpi-ls", ENV, str(tmp_path / "run"), 100))


def test_a_used_folder_is_refused_and_stays(tiny) -> None:
    record = Path(tiny.settings.output) / "record.jsonl"
    before = record.read_bytes()
    with pytest.raises(ValueError, match="not an empty folder"):
        run(tiny.settings)
    assert record.read_bytes() == before


def test_a_run_that_fails_says_so_in_its_record(tmp_path, monkeypatch) -> None:
    def fail(*args: Any) -> None:
        raise RuntimeError("no utilities")

    monkeypatch.setattr(dpmorl, "generate_utilities", fail)
    with pytest.raises(RuntimeError, match="no utilities"):
        run(settings_of("dpmorl", tmp_path / "run"))
    record: Record = read_record(tmp_path / "run" / "record.jsonl")
    assert record.error == "RuntimeError: no utilities"
    assert lines_of(tmp_path / "run" / "record.jsonl")[-1]["status"] == "failed"


@pytest.mark.parametrize("algorithm", ["pgmorl", "gpi_ls"])
def test_without_its_extra_a_baseline_names_it(tmp_path, monkeypatch, algorithm: str) -> None:
    for name in ("multi_policy.pgmorl.pgmorl", "multi_policy.gpi_pd.gpi_pd_continuous_action"):
        monkeypatch.setitem(sys.modules, f"morl_baselines.{name}", None)
    with pytest.raises(ImportError, match=r'pip install "sb3-momba\[baselines\]"'):
        run(settings_of(algorithm, tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_only_its_adapters_need_the_library() -> None:
    script = (
        "import sys, sb3_momba.baselines.__main__, sb3_momba.baselines.dpmorl, sb3_momba.baselines.pgmorl\n"
        "import sb3_momba.baselines.gpi_ls\n"
        "print(sorted({'morl_baselines', 'wandb'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.strip() == "[]"
