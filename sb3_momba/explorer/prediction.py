"""What a policy will return under any preference, before it is rolled out; and how far that can be trusted."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sb3_momba import MOMBA
from sb3_momba.explorer.decisions import Predict, leave_one_out_errors, local_error, predict_returns
from sb3_momba.explorer.rollouts import Rollouts, critic_values
from sb3_momba.pareto.evaluation import ParetoFront
from sb3_momba.pareto.plotting import COLOURS, save_figure, verbatim

Array = NDArray[np.float64]

CLOSE = 0.05  # of the rollout's return, in every objective: a prediction that counts as right
FRONT, CRITIC = "interpolated front", "vector critic"


@dataclass(frozen=True)
class Predictor:
    """A way to predict discounted returns.

    :param name: "interpolated front" or "vector critic"
    :param predict: preferences (n, n_objectives) -> discounted returns (n, n_objectives)
    :param preferences: those whose errors are known, (P, n_objectives)
    :param errors: predicted less measured, (P, n_objectives); NaN where not known
    """

    name: str
    predict: Predict
    preferences: Array
    errors: Array

    def error_at(self, wanted: Array) -> Array:
        """Root mean square of the errors nearby, (n, n_objectives); NaN if none is known."""
        return local_error(wanted, self.preferences, self.errors)


def sizes(predictors: Sequence[Predictor], ranges: Array) -> dict[str, float]:
    """Root mean square of each predictor's errors, by its name, at the preferences where all predictors' are known; as a share
    of how far each objective reaches, (n_objectives,), over the front. NaN if there is no such preference.

    :param predictors: with errors at the same preferences
    """
    known = np.all([np.isfinite(one.errors).all(axis=1) for one in predictors], axis=0)
    unit = np.where(ranges > 0, ranges, 1)
    return {one.name: float(np.sqrt(((one.errors[known] / unit) ** 2).mean())) if known.any() else np.nan for one in predictors}


def front_predictor(front: ParetoFront) -> Predictor:
    """Interpolation of an evaluated front; its errors are those of leaving one preference out."""
    measured = front.discounted_values

    def predict(wanted: Array) -> Array:
        return predict_returns(wanted, front.preferences, measured)

    return Predictor(FRONT, predict, front.preferences, leave_one_out_errors(front.preferences, measured))


def critic_predictor(model: MOMBA, rollouts: Rollouts, front: ParetoFront) -> Predictor:
    """A vector critic less what its values hold beyond the return of rollouts, which is interpolated; its errors are those on
    a front."""

    def predict(wanted: Array) -> Array:
        excess = predict_returns(wanted, rollouts.front.preferences, rollouts.excess)
        return critic_values(model, rollouts.starts, wanted) - excess

    errors = predict(front.preferences) - front.discounted_values
    return Predictor(CRITIC, predict, front.preferences, errors)


def predictors_of(model: MOMBA, rollouts: Rollouts, front: ParetoFront) -> list[Predictor]:
    """Those that a model has, the one with the smallest error on its front first; the front where no error is known."""
    found = [front_predictor(front)]
    if model.vector_values:
        found.append(critic_predictor(model, rollouts, front))
    errors = sizes(found, np.ptp(front.discounted_values, axis=0))
    return sorted(found, key=lambda predictor: errors[predictor.name])


def share_close(predicted: Array, measured: Array) -> float:
    """Share of the rows whose every objective is predicted within 5 % of what was measured; both (n, n_objectives)."""
    return float((np.abs(predicted - measured) <= CLOSE * np.abs(measured)).all(axis=1).mean())


@dataclass(frozen=True)
class Calibration:
    """What was predicted, by each predictor's name, and what rollouts returned: discounted, each (n, n_objectives)."""

    preferences: Array
    measured: Array
    predicted: dict[str, Array]

    @property
    def shares(self) -> dict[str, float]:
        """Of each predictor: how many of the preferences it predicted within 5 % in every objective."""
        return {name: share_close(predicted, self.measured) for name, predicted in self.predicted.items()}


def calibrate(
    predictors: Sequence[Predictor], roll_out: Callable[[Array], Rollouts], n_preferences: int = 100, seed: int = 0
) -> Calibration:
    """Compare predictions with rollouts under preferences drawn uniformly from the simplex, which were not evaluated before.

    :param roll_out: preferences (n, n_objectives) -> their episodes
    """
    n_objectives = predictors[0].preferences.shape[1]
    preferences = np.random.default_rng(seed).dirichlet(np.ones(n_objectives), size=n_preferences)
    preferences = preferences[preferences[:, 0].argsort()].astype(np.float32).astype(np.float64)
    measured = roll_out(preferences).front.discounted_values
    return Calibration(preferences, measured, {one.name: one.predict(preferences) for one in predictors})


def draw_calibration(calibration: Calibration, objectives: Sequence[str], title: str, path: Path) -> None:
    """A picture for each objective: predicted over measured returns, with the band of 5 % around the diagonal."""
    from matplotlib.figure import Figure  # It takes half a second to import.

    n = len(objectives)
    figure = Figure(figsize=(4.6 * min(n, 3), 4.6 * -(-n // 3) + 0.6), layout="constrained")
    figure.suptitle(verbatim(title), x=0.01, ha="left", fontsize=12, fontweight="bold")
    every_axes = figure.subplots(-(-n // 3), min(n, 3), squeeze=False).ravel()
    for axes in every_axes[n:]:
        axes.remove()
    for i, (axes, name) in enumerate(zip(every_axes, objectives, strict=False)):
        measured = calibration.measured[:, i]
        low, high = float(measured.min()), float(measured.max())
        margin = 0.05 * max(high - low, 1e-9)
        x = np.linspace(low - margin, high + margin, 50)
        axes.fill_between(x, x - CLOSE * np.abs(x), x + CLOSE * np.abs(x), color="#e4e7eb", label="within 5 %")
        axes.plot(x, x, color="#52606d", linewidth=1)
        for k, (kind, predicted) in enumerate(calibration.predicted.items()):
            share = calibration.shares[kind]
            axes.plot(measured, predicted[:, i], "os"[k % 2], color=COLOURS[k], markersize=4, label=f"{kind}: {share:.0%}")
        axes.set_title(verbatim(name), loc="left", fontsize=10)
        axes.set_xlabel("discounted return of the rollout", fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
    every_axes[0].set_ylabel("predicted", fontsize=9)
    every_axes[0].legend(fontsize=8, title="right in all objectives", title_fontsize=8, frameon=False)
    save_figure(figure, path, dpi=130)
