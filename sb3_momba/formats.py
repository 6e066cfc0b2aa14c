"""The formats of our files: the header that each begins with, and the objects that they may hold beside numbers."""

from dataclasses import fields
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from sb3_momba.envs.preferences import ConeSampler, FixedSampler, GainSampler, PerStepSampler, UniformSampler
from sb3_momba.files import FileFormatError, FilePath, read_tree, register
from sb3_momba.system import library_versions

FORMAT_VERSION = 1


def header(name: str) -> dict[str, Any]:
    """What a file of the format `name` begins with."""
    return {"format": name, "version": FORMAT_VERSION, "versions": library_versions()}


def read_format(path: FilePath, expected: str) -> dict[str, Any]:
    """The tree of a file of one of our formats, with `left_out` beside its own entries."""
    tree, left_out = read_tree(path)
    found = tree.get("format") if isinstance(tree, dict) else None
    if found != expected:
        raise FileFormatError(f"{path} holds {found!r}, not {expected!r}.")
    if tree.get("version") != FORMAT_VERSION:
        raise FileFormatError(
            f"{path} has format version {tree.get('version')!r}, this sb3_momba reads {FORMAT_VERSION}: it was written by "
            f"{tree.get('versions')}."
        )
    return {**tree, "left_out": left_out}


def _register_box() -> None:
    def to_tree(box: spaces.Box) -> dict[str, Any]:
        return {"low": box.low, "high": box.high, "random": box.np_random.bit_generator.state}

    def from_tree(tree: dict[str, Any]) -> spaces.Box:
        box = spaces.Box(tree["low"], tree["high"], dtype=tree["low"].dtype)
        box.np_random.bit_generator.state = tree["random"]
        return box

    register(spaces.Box, to_tree, from_tree)


def _register_simple(cls: type, names: tuple[str, ...]) -> None:
    """A class that is made anew from some of its attributes."""
    register(
        cls,
        lambda x: {name: getattr(x, name) for name in names},
        lambda tree: cls(**{name: tree[name] for name in names}),
    )


def _register_noises() -> None:
    """Action noises with where they are, so that a training goes on with the same numbers."""

    def normal_to_tree(noise: NormalActionNoise) -> dict[str, Any]:
        return {"mean": noise._mu, "sigma": noise._sigma, "dtype": np.dtype(noise._dtype).name}

    def correlated_to_tree(noise: OrnsteinUhlenbeckActionNoise) -> dict[str, Any]:
        arguments = {"mean": noise._mu, "sigma": noise._sigma, "theta": noise._theta, "dt": noise._dt}
        return {
            "arguments": {**arguments, "initial_noise": noise.initial_noise, "dtype": np.dtype(noise._dtype).name},
            "now": noise.noise_prev,
        }

    def correlated_from_tree(tree: dict[str, Any]) -> OrnsteinUhlenbeckActionNoise:
        noise = OrnsteinUhlenbeckActionNoise(**tree["arguments"])
        noise.noise_prev = tree["now"]
        return noise

    def vectorized_from_tree(tree: dict[str, Any]) -> VectorizedActionNoise:
        noise = VectorizedActionNoise(tree["base_noise"], len(tree["noises"]))
        noise._noises = tree["noises"]  # the property would reset them
        return noise

    register(NormalActionNoise, normal_to_tree, lambda tree: NormalActionNoise(**tree))
    register(OrnsteinUhlenbeckActionNoise, correlated_to_tree, correlated_from_tree)
    register(
        VectorizedActionNoise, lambda noise: {"base_noise": noise.base_noise, "noises": noise.noises}, vectorized_from_tree
    )


_register_box()
for _sampler in (UniformSampler, ConeSampler, GainSampler, FixedSampler, PerStepSampler):
    _register_simple(_sampler, tuple(field.name for field in fields(_sampler)))
register(TrainFreq, lambda x: [x.frequency, x.unit.value], lambda tree: TrainFreq(tree[0], TrainFrequencyUnit(tree[1])))
_register_simple(ConstantSchedule, ("val",))
_register_simple(LinearSchedule, ("start", "end", "end_fraction"))
register(FloatSchedule, lambda x: x.value_schedule, FloatSchedule)
_register_noises()
