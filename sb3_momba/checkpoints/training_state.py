"""What a training is beside its model: random numbers, replay buffer, running episodes, statistics, callbacks."""

import random
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ProgressBarCallback

# What SB3's own callbacks count and remember; others have `state_dict` and `load_state_dict`.
REMEMBERED = (
    "n_calls",
    "last_time_trigger",
    "best_mean_reward",
    "last_mean_reward",
    "no_improvement_evals",
    "last_best_mean_reward",
    "n_episodes",
    "evaluations_results",
    "evaluations_timesteps",
    "evaluations_length",
    "evaluations_successes",
)


def random_states(model: Any) -> dict[str, Any]:
    """Of Python, NumPy, torch and the action space, which the first random actions come from."""
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if model.device.type == "cuda" else [],  # untested
        "action_space": model.action_space.np_random.bit_generator.state,
    }


def set_random_states(model: Any, states: dict[str, Any]) -> None:
    random.setstate(states["python"])
    np.random.set_state(states["numpy"])  # noqa: NPY002
    th.set_rng_state(states["torch"])
    if states["cuda"]:
        th.cuda.set_rng_state_all(states["cuda"])
    model.action_space.np_random.bit_generator.state = states["action_space"]


def statistics_of(model: Any) -> dict[str, Any]:
    """Sums that go on over steps and are no part of the model's parameters."""
    return {
        "running_returns": model.policy.return_scale.running_returns,
        "metrics": vars(model._metrics),
        "negative_returns": vars(model._negative_returns),
        "skipped_updates": model._skipped_updates,
        "held_noise": model._held_noise.state_dict(),
    }


def set_statistics(model: Any, statistics: dict[str, Any]) -> None:
    model.policy.return_scale.running_returns = statistics["running_returns"]
    metrics = statistics["metrics"]
    metrics["sums"] = {name: total.to(model.device) for name, total in metrics["sums"].items()}
    if isinstance(metrics["blind_updates"], th.Tensor):
        metrics["blind_updates"] = metrics["blind_updates"].to(model.device)
    if "count" in metrics:  # of earlier checkpoints: one for all
        metrics["counts"] = dict.fromkeys(metrics["sums"], metrics.pop("count"))
    vars(model._metrics).update(metrics)
    model._held_noise.load_state_dict(statistics.get("held_noise", {}))
    vars(model._negative_returns).update(statistics["negative_returns"])
    model._skipped_updates = statistics["skipped_updates"]


def given_callback(root: BaseCallback) -> BaseCallback:
    """What `learn` was given, without the list in which SB3 puts a progress bar beside it."""
    if isinstance(root, CallbackList) and len(root.callbacks) == 2 and isinstance(root.callbacks[1], ProgressBarCallback):
        return root.callbacks[0]
    return root


def callbacks_below(callback: BaseCallback | None, place: str = "") -> Iterator[tuple[str, BaseCallback]]:
    """A callback and those that it calls, each with its place among them."""
    if callback is None:
        return
    place = f"{place}/{type(callback).__name__}"
    yield place, callback
    for name in ("callbacks", "callback", "callback_on_new_best"):
        below = getattr(callback, name, None)
        for index, one in enumerate(below if isinstance(below, list) else [below]):
            if isinstance(one, BaseCallback):
                yield from callbacks_below(one, f"{place}.{name}.{index}")


def states_of_callbacks(root: BaseCallback | None) -> dict[str, Any]:
    return {place: _state_of(callback) for place, callback in callbacks_below(root)}


def _state_of(callback: BaseCallback) -> dict[str, Any]:
    remembered = {name: getattr(callback, name) for name in REMEMBERED if hasattr(callback, name)}
    return {"remembered": remembered, "own": callback.state_dict() if hasattr(callback, "state_dict") else None}


def set_states_of_callbacks(root: BaseCallback | None, states: dict[str, Any]) -> None:
    """Callbacks that were there before go on where they were. It is said where one is missing that had a state of its own."""
    places = dict(callbacks_below(root))
    for place, state in states.items():
        callback = places.get(place)
        if callback is None:
            if state["own"]:
                warnings.warn(f"The checkpoint has the state of a callback {place}, which is not given now.", stacklevel=4)
            continue
        for name in REMEMBERED:  # A file of others could name more, such as where a callback writes.
            if name in state["remembered"]:
                setattr(callback, name, state["remembered"][name])
        if state["own"] is not None and hasattr(callback, "load_state_dict"):
            callback.load_state_dict(state["own"])
