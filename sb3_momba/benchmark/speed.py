"""`python -m sb3_momba.benchmark speed`: updates, steps and evaluations per second on this machine, beside what its matrix
products allow. Rates of different lines compare; they do not carry over to another machine or another moment.
"""

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from matplotlib.figure import Figure
from torch.utils.flop_counter import FlopCounterMode

from sb3_momba.benchmark.report import describe
from sb3_momba.benchmark.tables import markdown
from sb3_momba.envs.making import make_mo_vec_env
from sb3_momba.momba import MOMBA
from sb3_momba.nn.products import fast_float32_products, onednn_keeps_float32
from sb3_momba.nn.speed import has_compiler
from sb3_momba.pareto.evaluation import evaluate_front
from sb3_momba.pareto.plotting import save_figure
from sb3_momba.system import machine

TASK = "MO-Hopper-v4"
EVALUATION_TASK = "MO-HalfCheetah-v4"
DTYPES = {"float32": th.float32, "bfloat16": th.bfloat16}
CAPQL: dict[str, Any] = {"critic_loss": "mse", "vector_values": True, "best_return_scale": None, "ent_coef": 0.2}
# What is varied, and how: each line is one setting away from the default.
SCALING: dict[str, list[dict[str, Any]]] = {
    "critic_hidden_dim": [{"policy_kwargs": {"critic_hidden_dim": width}} for width in (64, 128, 256, 512)],
    "batch_size": [{"batch_size": size} for size in (64, 128, 256, 512)],
    "n_objectives": [{"n_objectives": n, "vector_values": vector} for vector in (False, True) for n in (1, 2, 3, 6, 10)],
}
LOOPS: list[dict[str, Any]] = [
    {},
    {"compile": True},
    {"precision": "bfloat16"},
    {"precision": "bfloat16", "compile": True},
    *({"gradient_steps": n} for n in (2, 4, 8)),
    *({"n_envs": n, "gradient_steps": -1} for n in (4, 16)),
]


class Blank(gym.Env[np.ndarray, np.ndarray]):
    """Costs nothing: Hopper's shapes, any number of objectives."""

    def __init__(self, n_objectives: int = 2):
        self.observation_space = spaces.Box(-1, 1, (11,), np.float32)
        self.action_space = spaces.Box(-1, 1, (3,), np.float32)
        self.reward_space = spaces.Box(-1, 1, (n_objectives,), np.float32)
        self.t = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.t = 0
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool, bool, dict[str, Any]]:  # type: ignore[override]
        self.t += 1
        return self.observation_space.sample(), self.reward_space.sample(), False, self.t == 500, {}


def filled_model(policy: str = "SimbaPolicy", n_objectives: int = 2, **kwargs: Any) -> MOMBA:
    """A model with random transitions to learn from."""
    model = MOMBA(policy, Blank(n_objectives), seed=0, learning_starts=600, buffer_size=1_000, **kwargs)
    return model.learn(600)


def seconds_per_call(call: Callable[[], Any], calls: int, repetitions: int = 5) -> float:
    """The best of some repetitions: the others were disturbed."""
    call()
    best = np.inf
    for _ in range(repetitions):
        started = time.perf_counter()
        for _ in range(calls):
            call()
        best = min(best, (time.perf_counter() - started) / calls)
    return float(best)


def updates_per_second(model: MOMBA, updates: int = 10) -> float:
    return 1 / seconds_per_call(lambda: model.train(1, model.batch_size), updates)


def products_of_an_update(model: MOMBA) -> float:
    """Floating-point operations in the matrix products of one update."""
    onednn_keeps_float32()  # Its probe, in the first update of a process, is no product of the update.
    with FlopCounterMode(display=False) as counter:
        model.train(1, model.batch_size)
    return float(counter.get_total_flops())


def product_rate(precision: str) -> float:
    """Floating-point operations per second in products of the update's largest shapes."""
    factors = [(th.randn(2, m, k), th.randn(2, k, n)) for m, k, n in ((256, 256, 1024), (256, 1024, 256), (1024, 256, 256))]
    factors = [(a.to(DTYPES[precision]), b.to(DTYPES[precision])) for a, b in factors]
    operations = sum(2 * 2 * a.shape[1] * a.shape[2] * b.shape[2] for a, b in factors)
    with fast_float32_products():
        return operations / seconds_per_call(lambda: [th.bmm(a, b) for a, b in factors], 20)


def speed_table() -> str:
    """Updates per second beside the limit: the update's products at the rate of the largest of them alone."""
    rows = [["update", "updates/s", "products, GFLOP/update", "products, GFLOP/s", "limit, updates/s", "share of the limit"]]
    for precision in DTYPES:
        for compile in (False, True) if has_compiler() else (False,):
            model = filled_model(precision=precision)
            operations = products_of_an_update(model)
            for network in (model.actor, model.critic, model.critic_target):
                network.compiled = compile
            rate, limit = updates_per_second(model), product_rate(precision)
            allowed = limit / operations
            numbers = [
                f"{rate:.1f}",
                f"{operations / 1e9:.2f}",
                f"{limit / 1e9:.0f}",
                f"{allowed:.1f}",
                f"{rate / allowed:.0%}",
            ]
            rows.append([precision + (", compiled" if compile else ""), *numbers])
    capql = filled_model("MlpPolicy", batch_size=128, **CAPQL)
    rows.append(["CAPQL, float32, batch 128", f"{updates_per_second(capql):.1f}", "", "", "", ""])
    return markdown(rows)


def scaling_table(picture: Path | None = None) -> str:
    """What an update costs with one setting changed, beside what the critics grow by.

    :param picture: where to draw the same
    """
    rows = [["setting", "ms/update", "times the default's", "critic parameters", "times the default's"]]
    default, default_parameters = cost_of_update({})
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    for axes, (name, several) in zip(figure.subplots(1, len(SCALING), sharey=True), SCALING.items(), strict=True):
        lines: dict[str, list[tuple[float, float]]] = {}
        for settings in several:
            seconds, parameters = cost_of_update(settings)
            times, size = seconds / default, parameters / default_parameters
            cells = [f"{1e3 * seconds:.1f}", f"{times:.2f}", f"{parameters:,}", f"{size:.2f}"]
            rows.append([describe(settings.get("policy_kwargs", settings)), *cells])
            value = {**settings, **settings.get("policy_kwargs", {})}[name]
            lines.setdefault("vector" if settings.get("vector_values") else "scalarised", []).append((value, times))
        for label, points in lines.items():
            axes.plot(*zip(*points, strict=True), marker="o", label=f"{label} critic")
        axes.set(xlabel=name, xscale="log")
        values = [value for value, _ in points]
        axes.set_xticks(values, [str(value) for value in values])
        axes.minorticks_off()
        axes.legend()
    if picture is not None:
        figure.supylabel("time of an update / the default's")
        save_figure(figure, picture, dpi=120)
    return markdown(rows)


def cost_of_update(settings: dict[str, Any]) -> tuple[float, int]:
    """Seconds, and the critics' parameters."""
    model = filled_model(**settings)
    return 1 / updates_per_second(model, 5), sum(p.numel() for p in model.critic.parameters())


def loop_table(updates: int = 320) -> str:
    """Environment steps per second of `learn`, updates included, and the share of what is not an update."""
    rows = [["setting", "env steps/s", "updates/s", "not in updates"]]
    for settings in LOOPS:
        if settings.get("compile") and not has_compiler():
            continue
        n_envs = settings.get("n_envs", 1)
        env = make_mo_vec_env(TASK, n_envs)
        others = {name: value for name, value in settings.items() if name != "n_envs"}
        steps = updates // max(settings.get("gradient_steps", 1), 1)
        model = MOMBA("SimbaPolicy", env, seed=0, learning_starts=300, buffer_size=2_000, **others)
        model.learn(300 + 10 * n_envs)
        in_updates, before = Stopwatch(model.train), model._n_updates
        model.train = in_updates  # type: ignore[method-assign,assignment]
        started = time.perf_counter()
        model.learn(steps, reset_num_timesteps=False)
        seconds = time.perf_counter() - started
        rates = [f"{steps / seconds:.1f}", f"{(model._n_updates - before) / seconds:.1f}"]
        rows.append([describe(settings) or "default", *rates, f"{1 - in_updates.seconds / seconds:.1%}"])
    return markdown(rows)


class Stopwatch:
    """A function that knows how long its calls took."""

    def __init__(self, function: Callable[..., Any]):
        self.function, self.seconds = function, 0.0

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        started = time.perf_counter()
        try:
            return self.function(*args, **kwargs)
        finally:
            self.seconds += time.perf_counter() - started


def evaluation_table(n_preferences: int = 100, n_episodes: int = 5, cores: int = 2) -> str:
    """Seconds of an evaluation, every episode run, beside those of a loop that predicts one action at a time."""
    model = MOMBA("SimbaPolicy", EVALUATION_TASK, seed=0, buffer_size=10)
    rows = [["way", "seconds"]]
    for n_workers in range(1, cores + 1):
        evaluate_front(model, all_episodes, n_preferences=2, n_workers=n_workers)  # The workers' first start is apart.
        started = time.perf_counter()
        front = evaluate_front(model, all_episodes, n_preferences, n_episodes, n_workers=n_workers)
        rows.append([f"evaluate_front, n_workers={n_workers}", f"{time.perf_counter() - started:.1f}"])
    env = gym.make(EVALUATION_TASK)
    started, steps, n_tried = time.perf_counter(), 0, 4
    for w in front.preferences[:: len(front.preferences) // n_tried][:n_tried]:
        observation, _ = env.reset(seed=0)
        done = False
        while not done:
            action, _ = model.predict(observation, preference=w, deterministic=True)
            observation, _, terminated, truncated, _ = env.step(action)
            done, steps = terminated or truncated, steps + 1
    per_step = (time.perf_counter() - started) / steps
    total = per_step * float(front.episode_lengths.sum())
    rows.append([f"predict in a loop, {n_episodes} episodes each (from {n_tried} episodes)", f"{total:.0f}"])
    return markdown(rows)


def all_episodes() -> gym.Env[Any, Any]:
    """The task without the knowledge that one of its episodes stands for all."""
    env = gym.make(EVALUATION_TASK)
    env.unwrapped.deterministic = False  # type: ignore[attr-defined]
    return env


def memory_table(size: int = 1_000_000) -> str:
    """Bytes of a full replay buffer of each task's shapes."""
    rows = [["task", f"replay buffer of {size:,} transitions, GB"]]
    for task in (TASK, EVALUATION_TASK, "MO-Humanoid-v4"):
        buffer = MOMBA("SimbaPolicy", task, buffer_size=1_000).replay_buffer
        arrays = [value for value in vars(buffer).values() if isinstance(value, np.ndarray)]
        rows.append([task, f"{sum(array.nbytes for array in arrays) * size / 1_000 / 1e9:.2f}"])
    return markdown(rows)


PARTS = ("updates", "loop", "scaling", "evaluation", "memory")


def tables(parts: Sequence[str], picture: Path | None = None) -> Iterator[str]:
    makers: dict[str, Callable[[], str]] = {
        "updates": speed_table,
        "loop": loop_table,
        "scaling": partial(scaling_table, picture),
        "evaluation": evaluation_table,
        "memory": memory_table,
    }
    yield f"{describe(machine())}\n"
    for part in parts:
        yield f"### {part.capitalize()}\n\n{makers[part]()}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; by default all")
    parser.add_argument("--threads", type=int, help="of torch; by default its own choice")
    parser.add_argument("--picture", type=Path, help="file for a picture of the scaling")


def main(given: argparse.Namespace) -> None:
    unknown = [part for part in given.parts if part not in PARTS]
    if unknown:
        raise ValueError(f"{unknown[0]!r} is no part of the measurement: choose from {', '.join(PARTS)}.")
    if given.picture is not None and given.parts and "scaling" not in given.parts:
        raise ValueError(f"--picture {given.picture} is of the scaling: ask for that part too.")
    if given.threads is not None and given.threads < 1:
        raise ValueError(f"--threads {given.threads}: give at least one.")
    if given.threads is not None:
        th.set_num_threads(given.threads)
    for table in tables(given.parts or PARTS, given.picture):
        print(table, flush=True)
