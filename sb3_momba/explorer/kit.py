"""The decision kit: what its page asks, answered about one model. No word of HTTP here."""

import json
import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sb3_momba import MOMBA, __version__
from sb3_momba.envs.preferences import check_preference, preference_grid
from sb3_momba.explorer.charts import number
from sb3_momba.explorer.decisions import Bound, exchange_rates, find_alternatives, predict_returns, rank_for_bound
from sb3_momba.explorer.prediction import CRITIC, FRONT, Predictor, predictors_of, sizes
from sb3_momba.explorer.reading import Run, objectives_of
from sb3_momba.explorer.rendering import Film, RenderingProcess, film
from sb3_momba.explorer.rollouts import Rollouts, roll_out
from sb3_momba.explorer.stage import RenderingError
from sb3_momba.files import atomic_write
from sb3_momba.pareto.evaluation import ParetoFront
from sb3_momba.pareto.protocol import N_EPISODES

Array = NDArray[np.float64]
Result = TypeVar("Result")

N_ON_LINE, N_ON_SIMPLEX = 1_001, 300  # preferences among which a bound is searched, of two and of more objectives
MAX_TRIES = 4
LIKE = 0.05  # of the front's range in each objective: returns that count as like
MOST_KEPT = 256  # rollouts that are remembered

logger = logging.getLogger(__name__)


class QuestionError(ValueError):
    """A question that cannot be answered as it is; the message says how it can."""


@dataclass
class DecisionKit:
    """One model, what is known of its front, and a process in which it is rolled out.

    :param run: with its front
    :param process: in which rollouts run, one at a time
    :param no_film: why there are no films; "" where there are
    :param survey: rollouts spread over the preferences
    :param seeds: fronts of runs of the same method with other seeds
    :param folder: where kept policies go
    """

    run: Run
    model: MOMBA
    process: RenderingProcess
    no_film: str
    survey: Rollouts
    seeds: list[ParetoFront]
    folder: Path
    predictors: list[Predictor] = field(init=False)
    _rollouts: dict[bytes, Rollouts] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        assert self.run.front is not None
        self.front = self.run.front
        self.measured: Array = self.front.discounted_values
        self.ranges: Array = np.ptp(self.measured, axis=0)
        self.objectives = objectives_of(self.run.record)
        self.predictors = predictors_of(self.model, self.survey, self.front)
        n = len(self.objectives)
        grid = preference_grid(n, N_ON_LINE if n == 2 else N_ON_SIMPLEX)
        self.candidates: Array = np.concatenate([grid, self.front.preferences])
        self.candidate_returns = self.predictor.predict(self.candidates)
        self._saving = threading.Lock()
        self._written = self.run.policy.path.stat().st_mtime_ns

    @property
    def predictor(self) -> Predictor:
        """The one whose errors are smallest."""
        return self.predictors[0]

    def as_run(self) -> Run:
        """The run with discounted returns in place of those of whole episodes."""
        d = self.front.discounted_returns
        discounted = ParetoFront(self.front.preferences, d, d, self.front.episode_lengths, self.front.settings)
        record = replace(self.run.record, preferences=self.front.preferences)
        return replace(self.run, record=record, values=self.measured, front=discounted)

    def about_prediction(self) -> str:
        """Which predictor is used, and how well it does."""
        n, known = len(self.front.preferences), sizes(self.predictors, self.ranges)
        errors = {name: f"{100 * size:.1f} %" for name, size in known.items() if np.isfinite(size)}
        critic = "vector critic, less entropy and what lies behind time limits,"
        if self.predictor.name == CRITIC:
            return (
                f"Predicted by the {critic} which is off by {errors[CRITIC]} of the front's range at those of the {n} "
                f"evaluated preferences that lie between others; interpolating between these is off by {errors[FRONT]}."
            )
        text = f"Interpolated between the {n} evaluated preferences. "
        if not errors:
            return text + "How far that is off is not known: none of them lies between others."
        text += f"Those that lie between others, predicted from these, are off by {errors[FRONT]} of the front's range"
        if CRITIC in errors:
            text += f"; the {critic} is off by {errors[CRITIC]} there, and is not used"
        return text + "."

    def check(self, preference: Any) -> Array:
        """:raises QuestionError: for what is no preference of this model"""
        try:
            if isinstance(preference, list) and np.ndim(preference) == 1:
                return check_preference(preference, len(self.objectives)).astype(np.float64)
        except (ValueError, TypeError) as error:
            raise QuestionError(str(error)) from error
        raise QuestionError(f"preference is {preference!r}: give a list of {len(self.objectives)} weights.")

    def predict(self, preference: Array) -> dict[str, Any]:
        """The discounted return expected of each objective, and its error."""
        wanted = preference[None]
        return {
            "preference": preference.tolist(),
            "returns": self.predictor.predict(wanted)[0].tolist(),
            "error": finite(self.predictor.error_at(wanted)[0]),
        }

    def around(self, preference: Array) -> dict[str, Any]:
        """What trades cost, and what the same preference returns after trainings with other seeds."""
        rates = exchange_rates(self.predictor.predict, preference, self.ranges)
        seeds = [predict_returns(preference[None], s.preferences, s.discounted_values)[0] for s in self.seeds]
        return {"preference": preference.tolist(), "rates": finite(rates), "seeds": [one.tolist() for one in seeds]}

    def roll_out(self, preferences: Array, n_episodes: int = N_EPISODES) -> Rollouts:
        """Episodes from the seed of the run's evaluation on."""
        return self._in_process(roll_out, preferences, n_episodes, self.seed)

    def _in_process(self, function: Callable[..., Result], *arguments: Any) -> Result:
        """:raises RuntimeError: where the model's file is not the one any more that predicts and is kept"""
        path = self.run.policy.path
        if path.stat().st_mtime_ns != self._written:
            raise RuntimeError(f"{path} was written anew since this page was opened: end the server and start it again.")
        return self.process.call(function, self.run.policy, *arguments)

    @property
    def seed(self) -> int:
        """Of the first episode under each preference."""
        return int(self.front.settings.get("seed", 0))

    def rolled_out(self, preference: Array) -> Rollouts:
        """The episodes under one preference, from memory if it has been asked before."""
        key = preference.tobytes()
        if key not in self._rollouts:
            if len(self._rollouts) >= MOST_KEPT:
                self._rollouts.clear()
            self._rollouts[key] = self.roll_out(preference[None])
        return self._rollouts[key]

    def show_rollout(self, preference: Array) -> dict[str, Any]:
        """What the policy did return, with its spread over episodes, and policies that return alike but move differently."""
        rollouts = self.rolled_out(preference)
        return {**self._measured(preference), "alternatives": self._alternatives(rollouts)}

    def _measured(self, preference: Array) -> dict[str, Any]:
        front = self.rolled_out(preference).front
        n_episodes = front.returns.shape[1]
        several = n_episodes > 1
        return {
            "preference": preference.tolist(),
            "discounted": front.discounted_values[0].tolist(),
            "discounted_spread": front.discounted_returns[0].std(axis=0, ddof=1).tolist() if several else None,
            "returns": front.values[0].tolist(),
            "spread": front.returns[0].std(axis=0, ddof=1).tolist() if several else None,
            "n_episodes": n_episodes,
            "steps": float(front.episode_lengths[0].mean()),
        }

    def _alternatives(self, here: Rollouts) -> list[dict[str, Any]]:
        returns = self.survey.front.discounted_values
        behaviour, others = here.behaviour[0], self.survey.behaviour
        found = find_alternatives(here.front.discounted_values[0], behaviour, returns, others, LIKE * self.ranges)
        return [
            {
                "preference": self.survey.front.preferences[one.index].tolist(),
                "returns": returns[one.index].tolist(),
                "distance": one.distance,
                "differs": f"{self.feature(one.feature)}: {number(others[one.index, one.feature])} instead of "
                f"{number(behaviour[one.feature])}",
            }
            for one in found
        ]

    def feature(self, number: int) -> str:
        """The name of one of a behaviour's statistics."""
        n_observations = self.model.policy.observation_dim
        n = self.survey.behaviour.shape[1] // 2
        statistic, place = ("mean" if number < n else "standard deviation"), number % n
        what = f"observation[{place}]" if place < n_observations else f"action[{place - n_observations}]"
        return f"{statistic} of {what}"

    def show_film(self, preference: Array) -> Film:
        """Of the first of the episodes.

        :raises RenderingError: where there can be none
        """
        if self.no_film:
            raise RenderingError(self.no_film)
        return self._in_process(film, preference, 0, self.seed, self.process.backend)

    def meet(
        self,
        preference: Array,
        objective: int,
        at_least: float | None = None,
        less: float | None = None,
        still_wanted: Callable[[], None] = lambda: None,
    ) -> dict[str, Any]:
        """The preference that keeps a bound on the discounted return of an objective and has the most of the others: searched
        on the predictor, and of all that were rolled out, the present one among them, the best; or, where none keeps it, the
        one that comes closest.

        :param objective: its number
        :param at_least: the bound; or
        :param less: at most so much less than the present preference returns
        :param still_wanted: called before each rollout; may raise
        """
        preferences: list[Array] = []
        returns: list[Array] = []

        def value_of(w: Array) -> float:
            still_wanted()
            w = self.check(w.tolist())  # as it comes back from the page
            preferences.append(w)
            returns.append(self.rolled_out(w).front.discounted_values[0])
            return float(returns[-1][objective])

        here = value_of(preference)
        if less is not None:
            at_least = here - less
        assert at_least is not None
        bound = asked = Bound(objective, at_least)
        missing = np.inf
        for _ in range(MAX_TRIES):
            order = rank_for_bound(asked, preference, self.candidates, self.candidate_returns)
            if len(order) == 0:
                break
            missing = at_least - value_of(self.candidates[order[0]])
            if missing <= 0:
                break
            asked = Bound(objective, asked.at_least + missing)
        if missing > 0:
            evaluated = rank_for_bound(bound, preference, self.front.preferences, self.measured)[:MAX_TRIES]
            for k in [*evaluated, self.measured[:, objective].argmax()]:
                if value_of(self.front.preferences[k]) >= at_least:
                    break
        kept = rank_for_bound(bound, preference, np.array(preferences), np.array(returns))
        chosen = int(kept[0]) if len(kept) > 0 else int(np.array(returns)[:, objective].argmax())
        answer = self._measured(preferences[chosen])
        return {"met": len(kept) > 0, "objective": objective, "at_least": at_least, **answer}

    def keep(self, preference: Array) -> dict[str, Any]:
        """Write the policy with this preference built in: policy.onnx, which needs no preference, model.zip, whose preference
        sampler gives this one alone, and choice.json, which says what they are."""
        weights = [round(float(w), 6) for w in preference]
        name = "_".join(f"{w:.4g}" for w in weights)
        files, notes = ["model.zip", "choice.json"], []
        with self._saving:
            folders = (self.folder / (name if number == 1 else f"{name}-{number}") for number in count(1))
            folder = next(filter(self._may_write_into, folders))
            folder.mkdir(parents=True, exist_ok=True)
            before = self.model.preference_sampler
            try:
                self.model.preference_sampler = preference.tolist()
                self.model.save(folder / "model.zip")
            finally:
                self.model.preference_sampler = before
            try:
                self.model.export(folder / "policy.onnx", preference)
                files.insert(0, "policy.onnx")
            except ImportError as error:
                (folder / "policy.onnx").unlink(missing_ok=True)  # An old one would be taken for that of model.zip.
                notes.append(str(error))
            known = self._rollouts.get(preference.tobytes())
            choice = {
                "preference": preference.tolist(),
                "objectives": self.objectives,
                "env": self.run.record.env,
                "env_kwargs": self.run.record.env_kwargs,
                "model": str(self.run.policy.path),
                "sb3_momba": __version__,
                "predicted": self.predict(preference),
                "predictor": self.predictor.name,
                "rollouts": None if known is None else self._measured(preference),
            }
            with atomic_write(folder / "choice.json") as file:
                file.write(json.dumps(choice, indent=1, allow_nan=False).encode())
        return {"folder": str(folder.resolve()), "files": files, "notes": notes}

    def _may_write_into(self, folder: Path) -> bool:
        """Not where a policy of another model is kept, and not through links, which could lead to any file."""
        choice = folder / "choice.json"
        if any(path.is_symlink() for path in (folder, choice, folder / "model.zip", folder / "policy.onnx")):
            return False
        try:
            return bool(json.loads(choice.read_bytes())["model"] == str(self.run.policy.path))
        except FileNotFoundError:
            return True
        except (ValueError, KeyError, TypeError):
            return False


def finite(x: Array) -> list[Any]:
    """Nested lists, with None for what is not known."""
    known = x.astype(object)
    known[~np.isfinite(x)] = None
    return list(known.tolist())
