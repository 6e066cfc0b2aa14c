"""What MOMBA's settings may be. Every check raises a ValueError that names the setting, its value and the cure."""

import inspect
import logging
import math
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from numbers import Integral, Real
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.noise import ActionNoise
from torch import nn

from sb3_momba.buffers import PreferenceReplayBuffer
from sb3_momba.nn.products import PRECISIONS
from sb3_momba.nn.speed import has_compiler
from sb3_momba.policies import SHIPPED_POLICIES, MlpPolicy
from sb3_momba.policy import MombaPolicy

logger = logging.getLogger(__name__)

SWITCHES = ("vector_values", "reward_centering", "her", "compile", "deterministic_exploration", "optimize_memory_usage")
# The least that they may be.
WHOLE_NUMBERS = {"batch_size": 1, "buffer_size": 1, "learning_starts": 0, "n_steps": 1, "policy_delay": 1, "noise_repeat": 1}
RANGES = {"gamma": (0, 1), "tau": (0, 1)}
CHOICES = {
    "critic_loss": ("ce", "mse"),
    "critic_minimum": ("scalarised", "objective"),
    "critic_loss_reduction": ("sum", "mean"),
    "precision": PRECISIONS,
    "return_scaling": ("maximum", "deviation"),
}
HER_DEFAULTS = {"keep_probability": 0.2, "concentration": 5.0, "n_relabels": 1, "corner_probability": 0.0}
BUFFER_ARGUMENTS = ("n_steps", "gamma", *HER_DEFAULTS, "seed", "handle_timeout_termination")

MOST_OBJECTIVES_WITH_CORNERS = 6  # which take half a second to compute; with seven it is five seconds

POLICY_SWITCHES = ("normalize_observations", "normalize_features", "normalize_weights", "capql_log_prob", "ortho_init")
POLICY_SIZES = ("actor_hidden_dim", "actor_blocks", "critic_hidden_dim", "critic_blocks", "n_critics")
# Arguments that the policy is told, and what follows from others.
OF_THE_ALGORITHM = (
    *("n_objectives", "critic_loss", "vector_values", "best_return_scale", "return_scaling", "reward_centering", "gamma"),
)
INJECTED = (*OF_THE_ALGORITHM, "deterministic_policy")
NOT_FOR_USERS = {
    *("self", "kwargs", "observation_space", "action_space", "lr_schedule", "actor_architecture", "critic_architecture"),
    *INJECTED,
}

NO_SDE = "MOMBA explores by its policy's own noise, without gSDE; action_noise adds to it"
# Arguments of SB3's SAC that MOMBA does not have: the value that asks for nothing, and what to do instead.
OF_SAC = {
    "use_sde": (False, NO_SDE),
    "sde_sample_freq": (-1, NO_SDE),
    "use_sde_at_warmup": (False, NO_SDE),
    "target_update_interval": (1, "the target critics move with every update, by tau"),
}
OWN_FEATURES = (
    "the networks read the whole observation, normalised, with the preference behind it. Extract features in the environment, "
    "by an ObservationWrapper"
)
OF_SACS_POLICY = {
    **dict.fromkeys(("use_sde", "log_std_init", "use_expln", "clip_mean"), NO_SDE),
    **dict.fromkeys(("features_extractor_class", "features_extractor_kwargs", "share_features_extractor"), OWN_FEATURES),
    "normalize_images": "observations are vectors, and normalize_observations says whether they are normalised",
}


def check_other_arguments(others: Mapping[str, Any], known: Iterable[str]) -> None:
    """What MOMBA's constructor does not take: SAC's own arguments at the value that asks for nothing pass.

    :raises ValueError: for SAC's own arguments otherwise
    :raises TypeError: for any other name, with the nearest one that there is
    """
    for name, value in others.items():
        if name not in OF_SAC:
            raise TypeError(f"MOMBA has no argument {name!r}{nearest(name, known)}")
        nothing, cure = OF_SAC[name]
        if value != nothing:
            raise ValueError(f"{name}={value!r}: {cure}. Leave it out.")


def check_settings(model: Any) -> None:
    """:param model: a MOMBA, whose attributes are its constructor's arguments"""
    settings = vars(model)
    check_other_arguments({name: settings[name] for name in OF_SAC if name in settings}, OF_SAC)
    for name in SWITCHES:
        check_switch(name, settings[name])
    if settings["preference_alignment"] != "positive":
        check_switch("preference_alignment", settings["preference_alignment"], ', or "positive"')
    for name, least in WHOLE_NUMBERS.items():
        check_whole(name, settings[name], least)
    if settings["reset_interval"] is not None:
        check_whole("reset_interval", settings["reset_interval"], 1, ", or None for never")
    check_whole("train_freq", model.train_freq.frequency, 1)
    check_whole("stats_window_size", settings["_stats_window_size"], 1)
    check_seed(settings["seed"])
    if settings["gradient_steps"] != -1:
        check_whole("gradient_steps", settings["gradient_steps"], 0, "; -1 makes as many as steps were taken")
    for name, (low, high) in RANGES.items():
        if not is_number(settings[name]) or not low <= settings[name] <= high:
            raise ValueError(f"{name}={settings[name]!r}: it must lie in [{low}, {high}].")
    for name, known in CHOICES.items():
        if settings[name] not in known:
            raise ValueError(f"{name}={settings[name]!r} is not known: use one of {', '.join(known)}.")
    rate, scale, entropy = settings["learning_rate"], settings["best_return_scale"], settings["target_entropy"]
    if not callable(rate) and not (is_number(rate) and rate >= 0):
        raise ValueError(f"learning_rate={rate!r}: give a number of at least 0, or a function of the remaining progress.")
    if scale is not None and not (is_number(scale) and scale > 0):
        raise ValueError(f"best_return_scale={scale!r}: give a number above 0, or None to leave rewards as they are.")
    if scale is None and settings["return_scaling"] == "deviation":
        raise ValueError("return_scaling='deviation' with best_return_scale=None: the latter leaves rewards as they are.")
    noise = settings["action_noise"]
    if noise is not None and not isinstance(noise, ActionNoise):
        raise ValueError(f"action_noise={noise!r}: give an ActionNoise of stable_baselines3.common.noise, or None.")
    mean: Any = getattr(noise, "_mu", None)
    if mean is not None and np.shape(mean) not in ((), model.action_space.shape):
        raise ValueError(f"action_noise={noise!r} has shape {np.shape(mean)}, an action {model.action_space.shape}.")
    parse_target_entropy(entropy, 1)
    own_rate = settings["ent_coef_learning_rate"]
    if own_rate is not None and not (is_number(own_rate) and own_rate >= 0):
        raise ValueError(f"ent_coef_learning_rate={own_rate!r}: give a number of at least 0, or None for learning_rate.")
    td3 = settings["td3_noise"]
    if td3 is not None and not (is_number(td3) and td3 >= 0):
        raise ValueError(f"td3_noise={td3!r}: give a deviation of at least 0, or None for a stochastic policy.")
    _check_together(model, settings)
    check_policy_kwargs(model.policy_class, settings["policy_kwargs"])


def _check_together(model: Any, settings: Mapping[str, Any]) -> None:
    if model.preference_alignment and not model.vector_values:
        raise ValueError(
            f"preference_alignment={model.preference_alignment} needs the vector Q of eq. (3.21): set vector_values=True."
        )
    if model.reward_centering and model.preference_alignment:
        raise ValueError(
            f"reward_centering=True with preference_alignment={model.preference_alignment!r}: the cosine of eq. (3.21) needs "
            "values as they are: choose one of both."
        )
    if model.reward_centering and model.gamma == 1:
        raise ValueError(
            "reward_centering=True with gamma=1: what a reward is worth for ever has no bound: take gamma below 1."
        )
    if model.noise_repeat > 1 and model.deterministic_exploration:
        raise ValueError(
            f"noise_repeat={model.noise_repeat} with deterministic_exploration=True: the mean action has no noise."
        )
    if model.td3_noise is not None and parse_ent_coef(model.ent_coef) != (False, 0.0):
        raise ValueError(
            f"td3_noise={model.td3_noise} with ent_coef={model.ent_coef!r}: the mean action has no entropy: set it to 0.0."
        )
    if model.td3_noise is not None and model.deterministic_exploration:
        raise ValueError(f"td3_noise={model.td3_noise} with deterministic_exploration=True: leave one of them out.")
    if model.ent_coef_learning_rate is not None and not parse_ent_coef(model.ent_coef)[0]:
        raise ValueError(
            f"ent_coef_learning_rate={model.ent_coef_learning_rate} with ent_coef={model.ent_coef!r}, which is fixed: leave "
            'one of them out, or learn it by "auto_0.2".'
        )
    if model.critic_minimum == "objective" and not model.vector_values:
        raise ValueError("critic_minimum='objective' needs a Q for each objective: set vector_values=True.")
    for name in ("her", "preference_alignment"):
        value = getattr(model, name)
        if model.n_objectives == 1 and value:
            raise ValueError(f"{name}={value!r} with one objective: there is no preference: set {name}=False.")
    if model.her_kwargs is not None:
        if not model.her:
            raise ValueError(f"her_kwargs={model.her_kwargs} without her=True: set her=True, or leave them out.")
        check_names("her_kwargs", model.her_kwargs, HER_DEFAULTS)
        for name, value in model.her_kwargs.items():
            if not is_number(value):
                raise ValueError(f"her_kwargs={{{name!r}: {value!r}}}: give a number.")
    if model.compile and not has_compiler():
        raise ValueError(
            "compile=True needs a C++ compiler, and there is none (g++, clang++, or CXX): install one, or leave it out."
        )
    buffer_class = settings["replay_buffer_class"]
    if not isinstance(buffer_class, type) or not issubclass(buffer_class, PreferenceReplayBuffer):
        raise ValueError(
            f"replay_buffer_class={buffer_class!r}: it must be PreferenceReplayBuffer or a subclass, which stores vector "
            "rewards and preferences."
        )
    if buffer_class is PreferenceReplayBuffer:
        check_names("replay_buffer_kwargs", settings["replay_buffer_kwargs"], BUFFER_ARGUMENTS)
        relabelling = {**(HER_DEFAULTS if model.her else {}), **(model.her_kwargs or {}), **settings["replay_buffer_kwargs"]}
        _check_relabels(relabelling, model.batch_size, model.n_objectives)


def _check_relabels(relabelling: Mapping[str, Any], batch_size: int, n_objectives: int) -> None:
    """:param relabelling: what the buffer is given"""
    n = relabelling.get("n_relabels", 1)
    check_whole("n_relabels", n, 1)
    if batch_size % n != 0:
        raise ValueError(f"n_relabels={n} does not divide batch_size={batch_size}.")
    for name, nothing in (("n_relabels", 1), ("corner_probability", 0.0)):
        value = relabelling.get(name, nothing)
        if value != nothing and relabelling.get("keep_probability", 1) == 1:
            raise ValueError(f"{name}={value}, where no preference is relabelled: set her=True, and keep_probability below 1.")
    if relabelling.get("corner_probability", 0.0) > 0 and n_objectives > MOST_OBJECTIVES_WITH_CORNERS:
        raise ValueError(
            f"corner_probability={relabelling['corner_probability']} with {n_objectives} objectives: a front has too many "
            f"corner weights to compute beyond {MOST_OBJECTIVES_WITH_CORNERS}: set it to 0."
        )


def check_policy_kwargs(policy: type, policy_kwargs: Any) -> None:
    """Names and values for the shipped policies; a subclass may take what it likes."""
    if not isinstance(policy_kwargs, dict):
        raise ValueError(f"policy_kwargs={policy_kwargs!r}: write a mapping; nothing is evaluated.")
    doubled = sorted(set(policy_kwargs) & set(INJECTED))
    if doubled:
        raise ValueError(f"policy_kwargs={{{doubled[0]!r}: ...}}: that is an argument of MOMBA itself.")
    if policy not in SHIPPED_POLICIES:
        return
    for name in policy_kwargs:
        if name in OF_SACS_POLICY:
            raise ValueError(f"policy_kwargs {name}={policy_kwargs[name]!r}: {OF_SACS_POLICY[name]}.")
        if policy is not MlpPolicy and name in ("net_arch", "activation_fn"):
            raise ValueError(
                f"policy_kwargs: {policy.__name__} has no {name}: its sizes are actor_hidden_dim, actor_blocks, "
                "critic_hidden_dim and critic_blocks. MlpPolicy has it."
            )
    check_names("policy_kwargs", policy_kwargs, policy_parameters(policy), f"{policy.__name__} has no argument")
    for name, value in policy_kwargs.items():
        if name in POLICY_SWITCHES:
            check_switch(f"policy_kwargs {name}", value)
        if name in POLICY_SIZES:
            check_whole(f"policy_kwargs {name}", value, 1)
    if "n_atoms" in policy_kwargs:
        check_whole("policy_kwargs n_atoms", policy_kwargs["n_atoms"], 2)
    if "support" in policy_kwargs:
        check_support(policy_kwargs["support"])
    if policy_kwargs.get("net_arch") is not None:
        check_net_arch(policy_kwargs["net_arch"])
    check_optimizer(policy_kwargs.get("optimizer_class", th.optim.Adam), policy_kwargs.get("optimizer_kwargs"))
    activation = policy_kwargs.get("activation_fn", nn.ReLU)
    if not isinstance(activation, type) or not issubclass(activation, nn.Module):
        raise ValueError(f"policy_kwargs activation_fn={activation!r}: give a class of torch.nn, such as torch.nn.Tanh.")


def check_optimizer(optimizer: Any, arguments: Any) -> None:
    if not isinstance(optimizer, type) or not issubclass(optimizer, th.optim.Optimizer):
        raise ValueError(
            f"policy_kwargs optimizer_class={optimizer!r}: give a class of torch.optim, such as torch.optim.AdamW, in Python."
        )
    if arguments is not None:
        known = [name for name in parameters(optimizer) if name not in ("self", "params", "lr")]
        check_names("policy_kwargs optimizer_kwargs", arguments, known, f"here {optimizer.__name__} takes no")


def check_support(support: Any) -> None:
    ordered = np.ndim(support) == 1 and len(support) == 2 and all(map(is_number, support)) and support[0] < support[1]
    if not ordered:
        raise ValueError(f"policy_kwargs support={support!r}: give two numbers in rising order.")


def check_net_arch(net_arch: Any) -> None:
    parts = net_arch.values() if isinstance(net_arch, dict) and set(net_arch) == {"pi", "qf"} else [net_arch]
    for widths in parts:
        if not isinstance(widths, list | tuple) or not all(is_whole(width, 1) for width in widths):
            raise ValueError(f"net_arch={net_arch!r}: give a list of widths such as [256, 256], or dict(pi=[...], qf=[...]).")


def parse_ent_coef(ent_coef: str | float) -> tuple[bool, float]:
    """Whether alpha is learned, and where it starts: "auto" (from 1), "auto_0.2" (from 0.2), or a fixed number."""
    text = str(ent_coef)
    learned = text == "auto" or text.startswith("auto_")
    try:
        start = float(text.removeprefix("auto").removeprefix("_") or 1.0) if learned else float(text)
        if start < 0 or (learned and start == 0) or not np.isfinite(start):
            raise ValueError("out of range")
    except ValueError as error:
        raise ValueError(
            f'ent_coef={ent_coef!r}: give "auto", "auto_0.2" (a start above 0), or a number that is not negative.'
        ) from error
    return learned, start


def parse_target_entropy(target_entropy: str | float, action_dim: int) -> float:
    """Nats of the whole action: "auto", -action_dim (SAC); "std_0.15", action_dim / 2 * ln(2 pi e 0.15^2), the entropy of a
    Gaussian with that standard deviation in each dimension (FlashSAC); or a number as it is."""
    if target_entropy == "auto":
        return -float(action_dim)
    if is_number(target_entropy):
        return float(target_entropy)
    text = str(target_entropy)
    try:
        deviation = float(text.removeprefix("std_")) if text.startswith("std_") else 0.0
    except ValueError:
        deviation = 0.0
    if not 0 < deviation < float("inf"):
        raise ValueError(
            f'target_entropy={target_entropy!r}: give "auto", "std_0.15" (a deviation above 0), or a number of nats.'
        )
    return action_dim / 2 * math.log(2 * math.pi * math.e * deviation**2)


def check_switch(name: str, value: Any, otherwise: str = "") -> None:
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name}={value!r}: it is a switch, give True or False{otherwise}.")


def check_seed(seed: Any) -> None:
    if seed is not None and not (is_whole(seed, 0) and seed < 2**32):
        raise ValueError(f"seed={seed!r}: give a whole number from 0 to 2**32 - 1, or None for another run each time.")


def check_device(device: Any) -> None:
    """Where there is no GPU, SB3 takes the CPU instead, which is said.

    :raises ValueError: for what torch does not know
    """
    try:
        kind = "cpu" if device == "auto" else th.device(device).type
    except (RuntimeError, TypeError) as error:
        raise ValueError(f'device={device!r}: give "cpu", "cuda", "cuda:1" and the like, or "auto".') from error
    if kind == "cuda" and not th.cuda.is_available():
        logger.warning("device=%r: torch finds no GPU here, so the CPU is used.", str(device))


def check_whole(name: str, value: Any, least: int, otherwise: str = "") -> None:
    if not is_whole(value, least):
        raise ValueError(f"{name}={value!r}: it must be a whole number of at least {least}{otherwise}.")


def check_names(name: str, given: Any, known: Iterable[str], message: str = "It has no") -> None:
    known = list(known)
    if not isinstance(given, dict):
        raise ValueError(f"{name}={given!r}: give a dictionary with any of {', '.join(known)}.")
    for key in given:
        if key not in known:
            raise ValueError(f"{name}: {message} {key!r}{nearest(key, known)}")


def is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and bool(np.isfinite(float(value)))


def is_whole(value: Any, least: int) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= least


def policy_parameters(policy: type) -> list[str]:
    """What `policy_kwargs` may hold."""
    known = dict.fromkeys([*parameters(policy), *parameters(MombaPolicy)])
    without = {*NOT_FOR_USERS, "normalize_weights"} if policy is MlpPolicy else NOT_FOR_USERS
    return [name for name in known if name not in without]


def parameters(cls: type) -> list[str]:
    return list(inspect.signature(cls.__init__).parameters)  # type: ignore[misc]


def nearest(name: object, known: Iterable[str]) -> str:
    """ ": did you mean 'x'?", or a full stop."""
    near = get_close_matches(str(name), list(known), 1, cutoff=0.5)
    return f": did you mean {near[0]!r}?" if near else "."
