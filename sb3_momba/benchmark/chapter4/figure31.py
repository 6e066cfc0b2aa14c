"""`python -m sb3_momba.benchmark figure31 ENV MODEL [MODEL]`: the return distributions that critics predict, beside those of
rollouts (figure 3.1)."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch as th
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from sb3_momba.benchmark.chapter4.figures import write
from sb3_momba.benchmark.tables import markdown
from sb3_momba.envs.making import make_env, wrap_env
from sb3_momba.envs.preferences import preference_grid
from sb3_momba.momba import MOMBA
from sb3_momba.nn.values import DistributionalValue
from sb3_momba.pareto.evaluation import ParetoFront, evaluate_front
from sb3_momba.pareto.plotting import COLOURS, default_style

Array = NDArray[np.float64]

N_PREFERENCES = 3
N_EPISODES = 100


@dataclass(frozen=True)
class Distribution:
    """One return at one preference, as the critic predicts it and as rollouts have it, in the environment's units.

    :param name: of the return: "scalarised", or the objective's number
    :param atoms: (n_atoms,)
    :param probabilities: of the atoms, (n_atoms,)
    :param samples: discounted returns of the rollouts, (n_episodes,)
    """

    name: str
    atoms: Array
    probabilities: Array
    samples: Array

    @property
    def mean(self) -> float:
        """Eq. (3.6)."""
        return float(self.probabilities @ self.atoms)


def check_model(model: MOMBA) -> None:
    """
    :raises ValueError: for a model whose critics have no distribution, or that has a single objective
    """
    if not isinstance(model.policy.value, DistributionalValue):
        raise ValueError('The critics have critic_loss="mse" and predict no distribution: give a model trained with "ce".')
    if model.n_objectives < 2:
        raise ValueError("The model has one objective, and no preferences to compare: give one of two or more.")


def reset_observations(env: str, preference: ArrayLike, n_episodes: int, seed: int) -> Array:
    """[s, w] at the start of each episode that `evaluate_front` plays, (n_episodes, observation_dim + n_objectives)."""
    one = wrap_env(make_env(env))
    try:
        resets = [one.reset(seed=seed + episode, options={"preference": preference})[0] for episode in range(n_episodes)]
    finally:
        one.close()
    return np.array(resets)


def predicted(model: MOMBA, observations: Array, seed: int = 0) -> tuple[Array, Array]:
    """Atoms in the environment's units, (n_values, n_atoms), and their probabilities, (n_values, n_atoms): the mean over the
    critics, and over the observations with an action of the policy at each.

    :param observations: raw [s, w], all of one w, (batch, observation_dim + n_objectives)
    """
    policy, value = model.policy, model.policy.value
    assert isinstance(value, DistributionalValue)
    with th.no_grad(), th.random.fork_rng():
        th.manual_seed(seed)
        inputs = policy.normalize(th.as_tensor(observations, device=model.device))
        logits = policy.critic(inputs, policy.actor(inputs))
    probabilities = logits.double().softmax(dim=-1).mean(dim=(0, 1))
    w = np.broadcast_to(observations[0, policy.observation_dim :], (value.n_outputs, policy.n_objectives))
    atoms = value.support.double().cpu().numpy()[:, None].repeat(len(probabilities), axis=1)
    return policy.in_reward_units(atoms, w).T, probabilities.cpu().numpy()


def distributions(model: MOMBA, env: str, front: ParetoFront, seed: int = 0) -> list[list[Distribution]]:
    """Of each preference of a front: the scalarised return, or with a vector critic each objective's."""
    found = []
    for w, returns in zip(front.preferences, front.discounted_returns, strict=True):
        atoms, probabilities = predicted(model, reset_observations(env, w, len(returns), seed), seed)
        samples = returns.T if model.vector_values else (returns @ w)[None]
        names = [f"objective {i + 1}" for i in range(len(w))] if model.vector_values else ["scalarised"]
        found.append([Distribution(*one) for one in zip(names, atoms, probabilities, samples, strict=True)])
    return found


def make_figure(models: Sequence[MOMBA], env: str, path: Path, n_episodes: int = N_EPISODES, seed: int = 0) -> str:
    """A row for each preference: the rollouts' returns of the first two objectives, then for each model the distributions.

    :return: a table of the means
    """
    for model in models:
        check_model(model)
    grid = preference_grid(models[0].n_objectives, N_PREFERENCES)
    fronts = [
        evaluate_front(one, env, preferences=grid, n_episodes=n_episodes, seed=seed, deterministic=False) for one in models
    ]
    found = [distributions(model, env, front, seed) for model, front in zip(models, fronts, strict=True)]
    rows = [["model", "preference", "return", "mean that the critic predicts", "mean of the rollouts"]]
    columns = sum(1 + len(one[0]) for one in found)
    with default_style():
        figure = Figure(figsize=(3.2 * columns, 2.6 * len(grid) + 0.5), layout="constrained")
        axes = np.array(figure.subplots(len(grid), columns, squeeze=False))
        column = 0
        for model, front, of_preferences in zip(models, fronts, found, strict=True):
            kind = "vector critic" if model.vector_values else "scalarised critic"
            for row, (w, some) in enumerate(zip(grid, of_preferences, strict=True)):
                preference = "[" + ", ".join(f"{x:.2g}" for x in w) + "]"
                draw_cloud(axes[row, column], front.discounted_returns[row], f"w = {preference}")
                for place, one in enumerate(some, start=column + 1):
                    draw_distribution(axes[row, place], one, kind)
                    rows.append([kind, preference, one.name, f"{one.mean:.4g}", f"{one.samples.mean():.4g}"])
            column += 1 + len(of_preferences[0])
        write(figure, path)
    return markdown(rows)


def draw_cloud(axes: Axes, returns: Array, title: str) -> None:
    axes.scatter(returns[:, 0], returns[:, 1], s=10, color=COLOURS[2], alpha=0.5)
    axes.set(xlabel="objective 1", ylabel="objective 2", title=title)
    axes.grid(alpha=0.3)


def draw_distribution(axes: Axes, one: Distribution, kind: str) -> None:
    """Densities; the samples in bins as wide as the atoms' distance."""
    width = one.atoms[1] - one.atoms[0]
    edges = np.append(one.atoms - width / 2, one.atoms[-1] + width / 2)
    inside = one.samples.clip(edges[0], edges[-1])
    axes.hist(inside, bins=list(edges), density=True, color=COLOURS[2], alpha=0.5, label="discounted returns of rollouts")
    axes.stairs(one.probabilities / width, edges, color=COLOURS[0], label="predicted by the critic")
    shown = one.atoms[one.probabilities > 1e-3]
    low, high = min(shown.min(), inside.min()), max(shown.max(), inside.max())
    axes.set(xlabel=f"return, {one.name}", ylabel="density", title=kind, xlim=(low - 2 * width, high + 2 * width))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("env", help="environment id that the models were trained on")
    parser.add_argument(
        "models", nargs="+", type=Path, help="saved models, such as one of a scalarised and one of a vector critic"
    )
    parser.add_argument("--output", type=Path, default=Path("figure-3.1.png"), help="the picture")
    parser.add_argument("--episodes", type=int, default=N_EPISODES, help="rollouts of each preference")


def main(given: argparse.Namespace) -> None:
    models = [MOMBA.load(path, device="cpu") for path in given.models]
    print(make_figure(models, given.env, given.output, given.episodes))
    print("The critics' returns hold the entropy bonus, the rollouts' do not; atoms at the ends take what lies beyond them.")
    print(f"Written to {given.output}.")
