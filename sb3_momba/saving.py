"""Saving and loading of models and replay buffers in sb3_momba's own files: no pickle, written aside and renamed."""

import inspect
import io
import os
import warnings
import zipfile
from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.type_aliases import GymEnv, TensorDict
from stable_baselines3.common.utils import get_system_info

from sb3_momba.buffers import STORED_ARRAYS, PreferenceReplayBuffer
from sb3_momba.envs.making import n_objectives_of
from sb3_momba.files import (
    WRONG_CONTENT,
    FileFormatError,
    FilePath,
    content_of,
    with_existing_suffix,
    with_suffix,
    write_tree,
)
from sb3_momba.formats import header, read_format
from sb3_momba.policy import MombaPolicy
from sb3_momba.settings import nearest

MODEL_FORMAT = "sb3_momba.model"
BUFFER_FORMAT = "sb3_momba.replay_buffer"

Self = TypeVar("Self", bound="PickleFreeSaving")


class PickleFreeSaving(OffPolicyAlgorithm):
    """`save`, `load` and the replay buffer's two, with SB3's signatures; loading executes nothing."""

    policy: MombaPolicy
    n_objectives: int
    ent_coef: str | float
    ent_coef_optimizer: th.optim.Optimizer | None
    replay_buffer: PreferenceReplayBuffer  # type: ignore[assignment]

    def save(
        self,
        path: FilePath,  # type: ignore[override]
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Write the model, its optimisers and statistics into one file, ".zip" appended if it has no suffix.

        The old file stands until the new one is whole.

        :raises TypeError: names an attribute that cannot be stored without pickle
        """
        write_tree(with_suffix(path, ".zip"), self.tree(exclude, include))

    def tree(self, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None) -> dict[str, Any]:
        """What `save` writes."""
        module_names, tensor_names = self._get_torch_save_params()
        excluded = {*(exclude or ()), *self._excluded_save_params()} - set(include or ())
        excluded |= {name.split(".")[0] for name in [*module_names, *tensor_names]}
        return {
            **header(MODEL_FORMAT),
            "data": {name: value for name, value in self.__dict__.items() if name not in excluded},
            "params": self.get_parameters(),
            "tensors": {name: recursive_getattr(self, name) for name in tensor_names},
        }

    @classmethod
    def load(  # type: ignore[override]
        cls: type[Self],
        path: FilePath,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        trust: bool = False,
        **kwargs: Any,
    ) -> Self:
        """A new model from a file; SB3's signature.

        :param env: to train on or check against; not needed to predict
        :param custom_objects: attributes to use instead of those in the file, such as a learning-rate function that
            could not be stored; names that the model does not have are passed over, as in SB3
        :param print_system_info: print the library versions here and of the file
        :param trust: read a zip that SB3 pickled, which can execute anything: only for files that you made yourself
        :param kwargs: attributes to change
        :raises FileFormatError: if the file is damaged or no model
        :raises ValueError: if `env` has other objectives, observations or actions than the model
        """
        if trust and pickled_by_sb3(with_existing_suffix(path, ".zip")):
            return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)  # type: ignore[arg-type]
        tree = read_model(path)
        if print_system_info:
            print("== CURRENT SYSTEM INFO ==")
            get_system_info()
            print("== SAVED MODEL SYSTEM INFO ==")
            print("\n".join(f"- {name}: {version}" for name, version in tree["versions"].items()))
        data = {**tree["data"], **(custom_objects or {})}
        if "policy_kwargs" in kwargs and kwargs["policy_kwargs"] != data.get("policy_kwargs"):
            raise ValueError(
                f"The file's policy_kwargs are {data.get('policy_kwargs')}, not {kwargs['policy_kwargs']}: they cannot be "
                "changed at load."
            )
        for place in tree["left_out"]:
            name = place.partition(".")[2].partition(".")[0]
            if name not in (custom_objects or {}) and name not in kwargs:
                warnings.warn(
                    f"{place.removeprefix('data.')} was not stored: pass custom_objects={{{name!r}: ...}} to have it back; the "
                    "default stands in its place.",
                    stacklevel=2,
                )
        for name in NEEDED:
            if name not in data:
                raise ValueError(f"{name} was not stored: pass custom_objects={{{name!r}: ...}}.")
        for name in ("policy_class", *inspect.signature(cls.__init__).parameters):
            value = data.get(name)
            if isinstance(value, type) and not issubclass(value, CLASSES_AT.get(name, ())):
                raise FileFormatError(f"{path}: {name} is the class {value.__name__}, which does not belong there.")
        if env is not None:
            env = cls._wrap_env(env, data.get("verbose", 0))
            _check_env_fits(env, data)
            data["n_envs"] = env.num_envs
            if force_reset:
                data["_last_obs"] = None
        with content_of(path):
            model = cls(policy=data["policy_class"], env=env, device=device, _init_setup_model=False)  # type: ignore[call-arg, arg-type]
        known = {*tree["data"], *NEEDED, *model.__dict__}
        model.__dict__.update({name: value for name, value in data.items() if name in known})
        unknown = [name for name in kwargs if name not in model.__dict__]
        if unknown:
            raise ValueError(f"{cls.__name__} has no setting {unknown[0]!r}{nearest(unknown[0], model.__dict__)}")
        model.__dict__.update(kwargs)
        with content_of(path):
            model._setup_model()
        if ("ent_coef_optimizer" in tree["params"]) != (model.ent_coef_optimizer is not None):
            raise ValueError(
                f"ent_coef={model.ent_coef!r}: a learned entropy coefficient cannot become a fixed one at load, or back."
            )
        try:
            model.set_parameters(tree["params"], exact_match=True, device=device)
            for name, tensor in tree["tensors"].items():
                recursive_getattr(model, name).data.copy_(tensor)
        except (*WRONG_CONTENT, ValueError) as error:
            changed = f" as changed by {kwargs}" if kwargs else ""
            raise FileFormatError(f"{path} holds parameters that do not fit its own settings{changed}: {error}") from error
        return model

    def set_parameters(
        self,
        load_path_or_dict: str | TensorDict,
        exact_match: bool = True,
        device: th.device | str = "auto",
    ) -> None:
        """Load parameters from a file of ours, or from a dictionary as `get_parameters` gives it."""
        if isinstance(load_path_or_dict, str | os.PathLike | io.IOBase):
            with content_of(load_path_or_dict):  # type: ignore[arg-type]
                super().set_parameters(read_model(load_path_or_dict)["params"], exact_match, device)
            return
        super().set_parameters(load_path_or_dict, exact_match, device)

    def save_replay_buffer(self, path: FilePath) -> None:  # type: ignore[override]
        """Write what the replay buffer holds into one file, ".npz" appended if it has no suffix."""
        buffer = self.replay_buffer
        tree = {
            **header(BUFFER_FORMAT),
            **{name: getattr(buffer, name) for name in ("n_envs", "n_objectives", "buffer_size", "pos", "full")},
            "rng": buffer.rng.bit_generator.state,
            "arrays": {name: getattr(buffer, name)[: buffer.size()] for name in STORED_ARRAYS},
        }
        write_tree(with_suffix(path, ".npz"), tree)

    def load_replay_buffer(self, path: FilePath, truncate_last_traj: bool = True) -> None:  # type: ignore[override]
        """Put the transitions of a file into a new replay buffer of the file's size.

        A model that has seen no step yet takes its statistics from them: without, what it learns from would not be normalised.

        :param truncate_last_traj: the next `learn` ends the last trajectory where the file ends, as with its usual reset
        :raises ValueError: if they are of another environment
        """
        tree = read_format(with_existing_suffix(path, ".npz"), BUFFER_FORMAT)
        size_before = self.buffer_size
        try:
            with content_of(path):
                self._check_buffer_fits(tree)
                self.buffer_size = tree["buffer_size"] * tree["n_envs"]
                buffer = self._make_replay_buffer()
                for name in STORED_ARRAYS:
                    array = tree["arrays"][name]
                    getattr(buffer, name)[: len(array)] = array
                buffer.pos, buffer.full = tree["pos"], tree["full"]
                buffer.n_added = buffer.pos + (buffer.buffer_size if buffer.full else 0)
                buffer.rng.bit_generator.state = tree["rng"]
        except BaseException:
            self.buffer_size = size_before
            raise
        buffer.goes_on = not truncate_last_traj
        buffer.device = self.device
        self.replay_buffer = buffer
        if self.policy.statistics.count == 0:
            self._take_statistics_from(buffer)

    def _excluded_save_params(self) -> list[str]:
        derived = ["actor", "critic", "critic_target", "lr_schedule", "ent_coef_tensor"]
        of_the_training = ["_metrics", "_negative_returns", "_held_noise"]
        of_the_process = ["_root_callback", "_states_of_callbacks", "_resumed_from"]
        return [*super()._excluded_save_params(), *derived, *of_the_training, *of_the_process]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        if self.ent_coef_optimizer is None:
            return ["policy", "actor.optimizer", "critic.optimizer"], []
        return ["policy", "actor.optimizer", "critic.optimizer", "ent_coef_optimizer"], ["log_ent_coef"]

    def _make_replay_buffer(self) -> PreferenceReplayBuffer:
        raise NotImplementedError

    def _observe_rewards(self, rewards: np.ndarray, dones: np.ndarray) -> None:
        raise NotImplementedError

    def _take_statistics_from(self, buffer: PreferenceReplayBuffer) -> None:
        """As if its transitions had been stored one after another."""
        rows = np.arange(buffer.n_added - buffer.size(), buffer.n_added) % buffer.buffer_size
        for first in range(0, len(rows), 10_000):
            observations = buffer.observations[rows[first : first + 10_000]]
            self.policy.statistics.update(observations.reshape(-1, buffer.observation_dim))
        for row in rows:
            self._observe_rewards(buffer.rewards[row], buffer.dones[row])

    def _check_buffer_fits(self, tree: dict[str, Any]) -> None:
        ours = self._make_replay_buffer() if self.replay_buffer is None else self.replay_buffer
        for name in ("n_objectives", "n_envs"):
            if tree[name] != getattr(ours, name):
                raise ValueError(f"The file's buffer has {name}={tree[name]}, this model has {name}={getattr(ours, name)}.")
        for name in STORED_ARRAYS:
            theirs, mine = tree["arrays"][name].shape[1:], getattr(ours, name).shape[1:]
            if theirs != mine:
                raise ValueError(f"The file's {name} have shape {theirs}, this model's {mine}: another environment?")
        size = tree["buffer_size"] if tree["full"] else tree["pos"]
        if any(len(tree["arrays"][name]) != size for name in STORED_ARRAYS) or not 0 <= tree["pos"] < tree["buffer_size"]:
            raise FileFormatError("The file's arrays do not have the length that it states.")


NEEDED = ("policy_class", "observation_space", "action_space", "n_objectives", "policy_kwargs")
# What an argument of a model that is a class may be.
CLASSES_AT = {"policy_class": MombaPolicy, "replay_buffer_class": PreferenceReplayBuffer}


def read_model(path: FilePath) -> dict[str, Any]:
    """The tree of a model's file, complete."""
    path = with_existing_suffix(path, ".zip")
    if pickled_by_sb3(path):
        raise FileFormatError(
            f"{path} was pickled by Stable-Baselines3: loading it can execute anything. If it is a MOMBA of your own, "
            "MOMBA.load(..., trust=True) reads it."
        )
    tree = read_format(path, MODEL_FORMAT)
    for part in ("data", "params", "tensors"):
        if not isinstance(tree.get(part), dict):
            raise FileFormatError(f"{path} has no {part!r}: it is not a whole model.")
    return tree


def pickled_by_sb3(path: FilePath) -> bool:
    """Whether a file is a zip as Stable-Baselines3 writes it."""
    if not zipfile.is_zipfile(path):  # type: ignore[arg-type]
        return False
    try:
        with zipfile.ZipFile(path) as archive:  # type: ignore[arg-type]
            names = archive.namelist()
    except Exception:  # Damaged, in any of the ways that zipfile has an error of its own for: its reader will say so.
        return False
    return "_stable_baselines3_version" in names and "tree.json" not in names


def _check_env_fits(env: Any, data: dict[str, Any]) -> None:
    theirs = {
        "n_objectives": n_objectives_of(env),
        "observation_space": env.observation_space,
        "action_space": env.action_space,
    }
    for name, value in theirs.items():
        if value != data[name]:
            raise ValueError(f"The model was trained with {name}={data[name]}, this environment has {name}={value}.")
