"""`python -m sb3_momba.benchmark speed`: updates, steps and evaluations per second on this machine, beside what its matrix
products allow. Rates of different lines compare; they do not carry over to another machine or another moment.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from torch.utils.flop_counter import FlopCounterMode

from sb3_momba.benchmark.report import describe
from sb3_momba.benchmark.tables import markdown
from sb3_momba.momba import MOMBA
from sb3_momba.nn.products import fast_float32_products
from sb3_momba.pareto.evaluation import evaluate_front
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
    rows = [["precision", "updates/s", "products, GFLOP/update", "products, GFLOP/s", "limit, updates/s", "share of the limit"]]
    for precision in DTYPES:
        model = filled_model(precision=precision)
        rate, operations, limit = updates_per_second(model), products_of_an_update(model), product_rate(precision)
        allowed = limit / operations
        numbers = [f"{rate:.1f}", f"{operations / 1e9:.2f}", f"{limit / 1e9:.0f}", f"{allowed:.1f}", f"{rate / allowed:.0%}"]
        rows.append([precision, *numbers])
    capql = filled_model("MlpPolicy", batch_size=128, **CAPQL)
    rows.append(["CAPQL, float32, batch 128", f"{updates_per_second(capql):.1f}", "", "", "", ""])
    return markdown(rows)


def scaling_table() -> str:
    rows = [["setting", "updates/s", "critic parameters"]]
    for settings in (one for several in SCALING.values() for one in several):
        model = filled_model(**settings)
        named = settings.get("policy_kwargs", settings)
        parameters = sum(p.numel() for p in model.critic.parameters())
        rows.append([describe(named), f"{updates_per_second(model, 5):.1f}", f"{parameters:,}"])
    return markdown(rows)


def loop_table(steps: int = 300) -> str:
    """Environment steps per second of `learn`, updates included, and the share of what is not an update."""
    rows = [["task", "setting", "env steps/s in learn", "not in updates"]]
    variants: list[dict[str, Any]] = [{}, {"precision": "bfloat16"}, {"gradient_steps": 2}, {"gradient_steps": 4}]
    for settings in variants:
        model = MOMBA("SimbaPolicy", TASK, seed=0, learning_starts=300, buffer_size=2_000, **settings)
        model.learn(310)
        in_updates = Stopwatch(model.train)
        model.train = in_updates  # type: ignore[method-assign,assignment]
        started = time.perf_counter()
        model.learn(steps, reset_num_timesteps=False)
        seconds = time.perf_counter() - started
        share = 1 - in_updates.seconds / seconds
        rows.append([TASK, describe(settings) or "default", f"{steps / seconds:.1f}", f"{share:.1%}"])
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
    """Seconds of an evaluation, beside those of a loop that predicts one action at a time."""
    model = MOMBA("SimbaPolicy", EVALUATION_TASK, seed=0, buffer_size=10)
    rows = [["way", "seconds"]]
    for n_workers in range(1, cores + 1):
        evaluate_front(model, EVALUATION_TASK, n_preferences=2, n_workers=n_workers)  # The workers' first start is apart.
        started = time.perf_counter()
        front = evaluate_front(model, EVALUATION_TASK, n_preferences, n_episodes, n_workers=n_workers)
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
    total = per_step * float(front.episode_lengths.sum()) * n_episodes / front.episode_lengths.shape[1]
    rows.append([f"predict in a loop, {n_episodes} episodes each (from {n_tried} episodes)", f"{total:.0f}"])
    return markdown(rows)


def memory_table(size: int = 1_000_000) -> str:
    """Bytes of a full replay buffer of each task's shapes."""
    rows = [["task", f"replay buffer of {size:,} transitions, GB"]]
    for task in (TASK, EVALUATION_TASK, "MO-Humanoid-v4"):
        buffer = MOMBA("SimbaPolicy", task, buffer_size=1_000).replay_buffer
        arrays = [value for value in vars(buffer).values() if isinstance(value, np.ndarray)]
        rows.append([task, f"{sum(array.nbytes for array in arrays) * size / 1_000 / 1e9:.2f}"])
    return markdown(rows)


PARTS: dict[str, Callable[[], str]] = {
    "updates": speed_table,
    "loop": loop_table,
    "scaling": scaling_table,
    "evaluation": evaluation_table,
    "memory": memory_table,
}


def tables(parts: list[str]) -> Iterator[str]:
    yield f"{describe(machine())}\n"
    for part in parts:
        yield f"### {part.capitalize()}\n\n{PARTS[part]()}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; by default all")
    parser.add_argument("--threads", type=int, help="of torch; by default its own choice")


def main(given: argparse.Namespace) -> None:
    unknown = [part for part in given.parts if part not in PARTS]
    if unknown:
        raise ValueError(f"{unknown[0]!r} is no part of the measurement: choose of {', '.join(PARTS)}.")
    if given.threads is not None:
        th.set_num_threads(given.threads)
    for table in tables(given.parts or list(PARTS)):
        print(table, flush=True)
