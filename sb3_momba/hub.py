"""Trained models on the Hugging Face Hub, with a model card: pushing, and loading from there.

A repository holds model.zip (`MOMBA.load` reads it and executes nothing), front.npz (`ParetoFront.load`), for two or three
objectives front.png, for a run its record.jsonl, and the card. huggingface_sb3's `load_from_hub` fetches them as ours does,
where TRUST_REMOTE_CODE is set for SB3's pickled files. Its `package_to_hub` cannot make them: it unzips those files, and knows
scalar rewards only.
"""

import os
import shlex
import shutil
import tempfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from sb3_momba import MOMBA, ParetoFront, __version__, plot_front
from sb3_momba.files import atomic_write
from sb3_momba.pareto.metrics import summarise
from sb3_momba.recording import plain
from sb3_momba.records import FILE_NAME as RECORD_NAME
from sb3_momba.records import Record, read_record, whole_lines
from sb3_momba.saving import read_model
from sb3_momba.system import library_versions
from sb3_momba.train import command_of

try:
    from huggingface_hub import EvalResult, HfApi, ModelCard, ModelCardData, hf_hub_download
except ImportError as error:
    raise ImportError(
        "sb3_momba.hub needs the package huggingface_hub: `pip install huggingface_hub`, or sb3-momba with its extra `hub`."
    ) from error

MODEL_NAME, FRONT_NAME, PICTURE_NAME, CARD_NAME = "model.zip", "front.npz", "front.png", "README.md"
TAGS = ("deep-reinforcement-learning", "reinforcement-learning", "stable-baselines3", "sb3-momba")
METRICS = {"hypervolume": "hypervolume", "expected_utility": "expected utility", "preference_regret": "preference regret"}
MEAN_RETURN = {"expected_utility": "mean return"}  # with one objective

FolderPath = str | os.PathLike[str]


def push_to_hub(
    source: MOMBA | FolderPath,
    repo_id: str,
    front: ParetoFront | None = None,
    *,
    reference_point: ArrayLike | None = None,
    objectives: list[str] | None = None,
    env_kwargs: dict[str, Any] | None = None,
    commit_message: str = "A model of sb3-momba",
    token: str | None = None,
    private: bool = False,
) -> str:
    """Upload a model with its front and its card, which take the place of those that the repository has.

    Everything is written locally before anything is sent; the repository is made if there is none.

    :param source: the folder of a finished run of `python -m sb3_momba.train`, or a model
    :param repo_id: "user/name"
    :param front: of a model, as `evaluate_front` measured it; a run has its own
    :param reference_point: of the hypervolume, (n_objectives,); the run's own, or 0
    :param objectives: the names of the picture's axes; the run's own, or numbers
    :param env_kwargs: what a model's environment was made with; a run knows
    :param token: of an account; by default that of `hf auth login`
    :param private: whether a new repository is
    :return: the repository's address
    :raises ValueError: for a source that is not whole, before anything is sent
    """
    with tempfile.TemporaryDirectory() as folder:
        package(source, folder, repo_id, front, reference_point=reference_point, objectives=objectives, env_kwargs=env_kwargs)
        api = HfApi(token=token, library_name="sb3_momba", library_version=__version__)
        address = api.create_repo(repo_id, private=private, exist_ok=True)
        ours = [MODEL_NAME, FRONT_NAME, PICTURE_NAME, RECORD_NAME]  # of an earlier push
        api.upload_folder(repo_id=repo_id, folder_path=folder, commit_message=commit_message, delete_patterns=ours)
    return str(address)


def load_from_hub(repo_id: str, filename: str = MODEL_NAME, *, revision: str | None = None, token: str | None = None) -> str:
    """Download a file of a repository, as huggingface_sb3's function of this name: `MOMBA.load(load_from_hub("user/name"))`.

    :param filename: in the repository, such as "front.npz"
    :param revision: a commit, branch or tag; by default the newest
    :return: where the file lies on this machine
    :raises huggingface_hub.errors.RepositoryNotFoundError: if there is none of this name, or it is private
    :raises huggingface_hub.errors.RevisionNotFoundError: if it has no such revision
    :raises huggingface_hub.errors.EntryNotFoundError: if it has no such file, or the hub cannot be reached
    """
    return hf_hub_download(
        repo_id, filename, revision=revision, token=token, library_name="sb3_momba", library_version=__version__
    )


def package(
    source: MOMBA | FolderPath,
    folder: FolderPath,
    repo_id: str,
    front: ParetoFront | None = None,
    *,
    reference_point: ArrayLike | None = None,
    objectives: list[str] | None = None,
    env_kwargs: dict[str, Any] | None = None,
) -> None:
    """Write what `push_to_hub` uploads; its arguments.

    :param folder: for the files; it must be empty or not exist
    :raises ValueError: for a folder that holds something, a run that is not finished, or a front that is not the model's
    :raises FileFormatError: for a file of the run that is damaged
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder} exists and is not an empty folder: choose another.")
    record = None
    if isinstance(source, MOMBA):
        front = front_of_model(source, front)
        env, steps = str(front.settings["env"]), source.num_timesteps
    else:
        if front is not None or env_kwargs is not None:
            raise ValueError(f"{source} is the folder of a run, which has its own front and env_kwargs: leave them out.")
        source = Path(source)
        record, front = finished_run(source), ParetoFront.load(source / FRONT_NAME)
        env, env_kwargs, steps = record.env, record.env_kwargs, read_model(source / MODEL_NAME)["data"]["num_timesteps"]
        reference_point = record.reference_point if reference_point is None else reference_point
        objectives = objectives or record.config["objectives"]
    reference = np.zeros(front.n_objectives) if reference_point is None else np.asarray(reference_point, dtype=np.float64)
    card = model_card(repo_id, front, reference, env, env_kwargs or {}, steps, record)

    folder.mkdir(parents=True, exist_ok=True)
    if front.n_objectives in (2, 3):
        plot_front(front, folder / PICTURE_NAME, objectives, env)
    if isinstance(source, MOMBA):
        source.save(folder / MODEL_NAME)
    else:
        shutil.copyfile(source / MODEL_NAME, folder / MODEL_NAME)
        with atomic_write(folder / RECORD_NAME) as file:
            file.write(without_failures(source / RECORD_NAME))
    front.save(folder / FRONT_NAME)
    with atomic_write(folder / CARD_NAME) as file:
        file.write(str(card).encode())


def front_of_model(model: MOMBA, front: ParetoFront | None) -> ParetoFront:
    """:raises ValueError: for a front that cannot be the model's"""
    if front is None or not {"env", "deterministic_policy"} <= set(front.settings):
        raise ValueError("A model's card has its front: give front=evaluate_front(model, env).")
    if front.n_objectives != model.n_objectives:
        raise ValueError(f"The model has {model.n_objectives} objectives, the front {front.n_objectives}.")
    return front


def finished_run(folder: Path) -> Record:
    """:raises ValueError: if a folder holds none"""
    path = folder / RECORD_NAME
    if not path.is_file():
        raise ValueError(f"{folder} holds no run: give the folder of one, or a model with its front.")
    record = read_record(path)
    if record.error is not None:
        raise ValueError(f"{folder} holds a run that has not finished ({record.error}): go on with it, or push its model.")
    return record


def without_failures(path: Path) -> bytes:
    """A finished record without the failures that it went on after: their tracebacks name folders of this computer."""
    lines = whole_lines(path)
    return b"".join(line for line, event in lines if event["event"] != "end" or event["status"] == "finished")


# ------------------------------------------------------------------------------------------------------------ the card


def model_card(
    repo_id: str,
    front: ParetoFront,
    reference_point: np.ndarray,
    env: str,
    env_kwargs: dict[str, Any],
    steps: int,
    record: Record | None,
) -> ModelCard:
    """The card: what the model is, its results, how to load it, and for a run how it was trained.

    :param reference_point: of the hypervolume, (n_objectives,)
    :param steps: environment steps of the training
    :param record: of a run; a model on its own has none
    """
    data = card_data(repo_id.split("/")[-1], front, reference_point, env, env_kwargs)
    versions = library_versions() if record is None else record.start["versions"]
    task = f"**{env}**" + (f" ({keywords(env_kwargs)})" if env_kwargs else "")
    what = f"for every trade-off between the {front.n_objectives} objectives of" if front.n_objectives > 1 else "for"
    parts = [
        f"# MOMBA on {env}",
        f"A policy {what} {task}, trained for {steps:,} steps with sb3-momba, multi-objective reinforcement learning for "
        "[Stable-Baselines3](https://stable-baselines3.readthedocs.io).",
    ]
    if front.n_objectives in (2, 3):
        parts.append(f"![The front]({PICTURE_NAME})")
        parts.append("*Each point is the mean return under one preference; dominated ones are faint.*")
    parts += ["## Results", results(front, reference_point, record)]
    parts += ["## Usage", "With sb3-momba and huggingface_hub installed; loading executes nothing of the file."]
    parts.append(f"```python\n{usage(repo_id, front, env, env_kwargs)}\n```")
    if record is not None:
        parts += ["## Training", f"```bash\n{shlex.join(command_of(record.config))}\n```"]
        parts.append(f"Every setting and the curve are in [{RECORD_NAME}]({RECORD_NAME}).")
    parts += ["## Versions", ", ".join(f"{name} {version}" for name, version in versions.items())]
    return ModelCard(f"---\n{data.to_yaml()}\n---\n\n" + "\n\n".join(parts) + "\n")


def card_data(
    name: str, front: ParetoFront, reference_point: np.ndarray, env: str, env_kwargs: dict[str, Any]
) -> ModelCardData:
    """The metadata that the hub reads; with one objective its usual `mean_reward`, as huggingface_sb3 writes it."""
    if front.n_objectives == 1:
        returns = front.returns[0, :, 0]
        measured: dict[str, Any] = {"mean_reward": f"{returns.mean():.2f} +/- {returns.std():.2f}"}
    else:
        measured = {metric: front.metrics(reference_point)[metric] for metric in METRICS}
    eval_results = [
        EvalResult(
            task_type="reinforcement-learning",
            task_name="reinforcement-learning",
            dataset_type=env,
            dataset_name=env,
            dataset_args=plain(env_kwargs) or None,
            metric_type=metric,
            metric_name=METRICS.get(metric, metric),
            metric_value=value,
            metric_args={"reference_point": reference_point.tolist()} if metric == "hypervolume" else None,
        )
        for metric, value in measured.items()
    ]
    return ModelCardData(
        library_name="stable-baselines3",
        pipeline_tag="reinforcement-learning",
        tags=[env, *TAGS, *(["multi-objective"] if front.n_objectives > 1 else [])],
        model_name=name,
        eval_results=eval_results,
    )


def results(front: ParetoFront, reference_point: np.ndarray, record: Record | None) -> str:
    """The metrics as a table, beside policies that learned nothing where a record has them, and how they were measured."""
    columns = METRICS if front.n_objectives > 1 else MEAN_RETURN
    lines = ["| policy | " + " | ".join(columns.values()) + " |", "|---|" + "---|" * len(columns)]
    floors = [] if record is None else record.floors
    for name, values in [("this model", front.values), *((floor.policy, floor.values) for floor in floors)]:
        measured = summarise(values, front.preferences, reference_point)
        lines.append(f"| {name} | " + " | ".join(f"{measured[metric]:,.6g}" for metric in columns) + " |")
    n_preferences, n_episodes = front.returns.shape[:2]
    policy = "deterministic" if front.settings["deterministic_policy"] else "stochastic"
    grid = f"{n_preferences} preferences, {n_episodes} episodes each" if front.n_objectives > 1 else f"{n_episodes} episodes"
    above = f" Hypervolume above {reference_point.tolist()}." if front.n_objectives > 1 else ""
    return "\n".join(lines) + f"\n\n{grid}; undiscounted returns of the {policy} policy.{above}"


def usage(repo_id: str, front: ParetoFront, env: str, env_kwargs: dict[str, Any]) -> str:
    """Python that loads the model and asks it for an action."""
    has_id = env in gym.registry or ":" in env
    made = f"mo_gymnasium.make({', '.join(filter(None, [repr(env), keywords(env_kwargs)]))})"
    preference = f", preference={np.eye(front.n_objectives)[0].tolist()}" if front.n_objectives > 1 else ""
    lines = [
        *(["import mo_gymnasium"] if has_id else []),
        "from sb3_momba import MOMBA",
        "from sb3_momba.hub import load_from_hub",
        "",
        f"model = MOMBA.load(load_from_hub({repo_id!r}))",
        f"env = {made if has_id else f'{env}({keywords(env_kwargs)})'}",
        "observation, _ = env.reset()",
        f"action, _ = model.predict(observation{preference}, deterministic=True)",
    ]
    return "\n".join(lines)


def keywords(arguments: dict[str, Any]) -> str:
    """As Python writes them in a call: "a=1, b='x'"."""
    return ", ".join(f"{name}={value!r}" for name, value in arguments.items())
