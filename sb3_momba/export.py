"""A trained policy as one graph that runs without this package: ONNX (".onnx"), or TorchScript (".pt", ".ts").

ONNX is written by torch's older exporter (`dynamo=False`). It needs nothing but the package onnx, and takes tenths of a second;
the newer one needs a release of onnxscript that fits torch's, and takes seconds. The second format is a trace, which C++ runs
as Python does; what torch.export writes needs Python or a compiler. No branch of an actor depends on its input, so a trace
misses nothing.

Torch calls both deprecated without naming an end. Before a file is written, its graph is compared with the policy.
"""

import io
import json
import os
import warnings
from collections.abc import Callable, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_momba.envs.preferences import check_preference
from sb3_momba.files import atomic_write
from sb3_momba.policy import MombaPolicy
from sb3_momba.system import library_versions

OPSET = 17  # of ONNX; its runtimes have it since 2022
METADATA = "metadata.json"  # the name of a TorchScript file's extra part
TOLERANCE = 1e-3  # of the action's width: another function differs by more, rounding by a hundredth of it

Arrays = tuple[np.ndarray, ...]


class DeterministicPolicy(nn.Module):
    """The mean action as tensors compute it: raw observations (batch, observation_dim) and, unless it is built in,
    preferences (batch, preference_dim) -> actions within the bounds (batch, action_dim), all float32.

    :param preference: (preference_dim,), built in; None leaves it an input
    """

    mean: th.Tensor
    inverse_deviation: th.Tensor
    low: th.Tensor
    high: th.Tensor
    preference: th.Tensor | None

    def __init__(self, policy: MombaPolicy, preference: np.ndarray | None):
        super().__init__()
        self.trunk, self.head = deepcopy(policy.actor.trunk), deepcopy(policy.actor.mean_head)
        self.observation_dim = policy.observation_dim
        normalized, dim = policy.normalize_observations, policy.observation_dim
        self.register_buffer("mean", policy.statistics.mean.float() if normalized else th.zeros(dim))
        self.register_buffer("inverse_deviation", policy.statistics.inverse_deviation if normalized else th.ones(dim))
        self.register_buffer("low", th.as_tensor(policy.action_space.low, dtype=th.float32))
        self.register_buffer("high", th.as_tensor(policy.action_space.high, dtype=th.float32))
        self.register_buffer("preference", None if preference is None else th.as_tensor(preference))
        self.to("cpu").requires_grad_(False).eval()

    def forward(self, observation: th.Tensor, preference: th.Tensor | None = None) -> th.Tensor:
        if self.preference is not None:
            preference = self.preference.expand(observation.shape[0], -1)
        s = (observation - self.mean) * self.inverse_deviation
        x = s if preference is None else th.cat([s, preference], dim=-1)
        action = th.tanh(self.head(self.trunk(x, x[:, self.observation_dim :])))
        action = self.low + 0.5 * (action + 1) * (self.high - self.low)
        return th.minimum(th.maximum(action, self.low), self.high)


def export_policy(policy: MombaPolicy, path: str | os.PathLike[str], preference: Sequence[float] | np.ndarray | None) -> None:
    """Write a policy's graph; see `MOMBA.export`."""
    suffix = Path(path).suffix.lower()
    if suffix not in FORMATS:
        raise ValueError(f"{path}: the suffix chooses the format; give one of {', '.join(FORMATS)}.")
    if preference is not None:
        if np.ndim(preference) != 1:
            raise ValueError(f"The preference {preference!r} has shape {np.shape(preference)}: one can be built in.")
        preference = check_preference(preference, policy.n_objectives)
    built_in = preference if policy.preference_dim > 0 else None
    build, run = FORMATS[suffix]
    inputs = example_inputs(policy, built_in)
    two_rows = tuple(x[:2] for x in inputs)  # so that the comparison has another batch size than the trace
    content = build(DeterministicPolicy(policy, built_in), two_rows, metadata_of(policy, built_in))
    check_same(policy, built_in, inputs, run(content, inputs))
    with atomic_write(path) as file:
        file.write(content)


def example_inputs(policy: MombaPolicy, preference: np.ndarray | None) -> Arrays:
    """Observations such as the policy has seen, (7, observation_dim), and preferences (7, n_objectives) where they are an
    input."""
    rng = np.random.default_rng(0)
    mean, deviation = policy.statistics.mean.cpu().numpy(), policy.statistics.variance.sqrt().cpu().numpy()
    observations = (mean + deviation * rng.standard_normal((7, len(mean)))).astype(np.float32)
    if preference is not None or policy.preference_dim == 0:
        return (observations,)
    return observations, rng.dirichlet(np.ones(policy.n_objectives), size=7).astype(np.float32)


def metadata_of(policy: MombaPolicy, preference: np.ndarray | None) -> dict[str, str]:
    """What a file says of itself; everything but names and versions is JSON."""
    versions = library_versions()
    metadata = {
        "sb3_momba": versions["sb3_momba"],
        "torch": versions["torch"],
        "policy": type(policy).__name__,
        "n_objectives": str(policy.n_objectives),
        "action_low": json.dumps(policy.action_space.low.tolist()),
        "action_high": json.dumps(policy.action_space.high.tolist()),
    }
    return metadata if preference is None else {**metadata, "preference": json.dumps(preference.tolist())}


def check_same(policy: MombaPolicy, preference: np.ndarray | None, inputs: Arrays, actions: np.ndarray) -> None:
    """:raises RuntimeError: if a graph does not give the policy's actions"""
    built_in = [] if preference is None else [np.tile(preference, (len(inputs[0]), 1))]
    expected, _ = policy.predict(np.concatenate([*inputs, *built_in], axis=-1), deterministic=True)
    errors = np.abs(actions - expected)
    if not (errors <= TOLERANCE * (policy.action_space.high - policy.action_space.low)).all():
        raise RuntimeError(
            f"The exported graph differs from {type(policy).__name__}.predict by {errors.max():.2g}, and was not written: a "
            "policy that overrides `_predict`, `normalize` or its actor's `forward` cannot be exported."
        )


def onnx_of(module: DeterministicPolicy, inputs: Arrays, metadata: dict[str, str]) -> bytes:
    """
    :raises ImportError: if onnx is missing, with the cure
    """
    try:
        import onnx
    except ImportError as error:
        raise ImportError(
            "Exporting to .onnx needs the package onnx: `pip install onnx`, or sb3-momba with its extra `export`; .pt does not."
        ) from error
    file = io.BytesIO()
    names = ["observation", "preference"][: len(inputs)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a deprecation, and of constants that could be folded and are not
        th.onnx.export(
            module,
            tuple(map(th.from_numpy, inputs)),
            file,  # type: ignore[arg-type]
            input_names=names,
            output_names=["action"],
            dynamic_axes={name: {0: "batch"} for name in [*names, "action"]},
            opset_version=OPSET,
            dynamo=False,
        )
    model = onnx.load_model_from_string(file.getvalue())
    onnx.helper.set_model_props(model, metadata)
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def run_onnx(content: bytes, inputs: Arrays) -> np.ndarray:
    import onnx.reference

    names = ["observation", "preference"][: len(inputs)]
    evaluator: Any = onnx.reference.ReferenceEvaluator(onnx.load_model_from_string(content))
    return np.asarray(evaluator.run(["action"], dict(zip(names, inputs, strict=True)))[0])


def torchscript_of(module: DeterministicPolicy, inputs: Arrays, metadata: dict[str, str]) -> bytes:
    file = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        graph = th.jit.trace(module, tuple(map(th.from_numpy, inputs)))  # type: ignore[no-untyped-call]
        th.jit.save(graph, file, _extra_files={METADATA: json.dumps(metadata)})
    return file.getvalue()


def run_torchscript(content: bytes, inputs: Arrays) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        graph = th.jit.load(io.BytesIO(content))  # type: ignore[no-untyped-call]
    return np.asarray(graph(*map(th.from_numpy, inputs)))


Build = Callable[[DeterministicPolicy, Arrays, dict[str, str]], bytes]
Run = Callable[[bytes, Arrays], np.ndarray]
TORCHSCRIPT: tuple[Build, Run] = (torchscript_of, run_torchscript)
FORMATS: dict[str, tuple[Build, Run]] = {".onnx": (onnx_of, run_onnx), ".pt": TORCHSCRIPT, ".ts": TORCHSCRIPT}
