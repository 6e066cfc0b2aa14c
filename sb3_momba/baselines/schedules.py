"""How long PGMORL trains on each task, and when it chooses anew what to train: the numbers of its authors' scripts."""

from dataclasses import dataclass

from sb3_momba.baselines.settings import STEPS
from sb3_momba.envs.registry import raw_id

STEPS_PER_ITERATION = 2048  # of each environment
WARMUP = 4  # in generations, of trainings that are shorter than the authors'
LENGTH = 24  # of a training, in generations, before these grow as long as the authors': about that of their shortest one


@dataclass(frozen=True)
class Script:
    """What the authors' script for a task sets.

    :param steps_per_policy: of a policy's environments, all together; what fills no iteration is left out
    :param warmup: iterations before the first choice of what to train
    :param generation: iterations between two choices
    :param n_policies: that are trained at a time
    :param num_envs: of each policy
    :param gamma: the discount factor
    """

    steps_per_policy: int
    warmup: int
    generation: int
    n_policies: int = 6
    num_envs: int = 4
    gamma: float = 0.995

    @property
    def steps(self) -> int:
        """Of a training, all policies together: whole iterations."""
        batch = STEPS_PER_ITERATION * self.num_envs
        return self.steps_per_policy // batch * batch * self.n_policies


SCRIPTS = {
    "MO-Ant-v4": Script(8_000_000, 200, 40),
    "MO-HalfCheetah-v4": Script(5_000_000, 80, 20),
    "MO-Hopper-v4": Script(8_000_000, 200, 40),
    "MO-Hopper-3obj-v4": Script(8_000_000, 200, 40, n_policies=15),
    "MO-Humanoid-v4": Script(20_000_000, 200, 40, num_envs=8, gamma=0.99),
    "MO-Swimmer-v4": Script(2_000_000, 40, 10),
    "MO-Walker2d-v4": Script(5_000_000, 80, 20),
}
OF_OTHERS = Script(5_000_000, 80, 20)  # the defaults of the scripts' program


def script_of(env: str) -> Script:
    """:param env: id of a task; of one that the authors do not have, the defaults"""
    return SCRIPTS.get(raw_id(env), OF_OTHERS)


def default_steps(algorithm: str, env: str) -> int:
    """Of a training for which none are given: those of Table 4.2."""
    return script_of(env).steps if algorithm == "pgmorl" else STEPS[algorithm]


def schedule(n_iterations: int, script: Script, warmup: int | None = None, generation: int | None = None) -> tuple[int, int]:
    """How many iterations the warm-up and each generation have. The last generation may be shorter.

    The task's own, for a training that is about as long as the authors'. In a shorter one a generation is a 24th of it, and the
    warm-up four generations.

    :param warmup: if it is given
    :param generation: likewise
    :raises ValueError: for a training without a generation, or a warm-up without
    """
    if generation is None:
        generation = max(1, min(script.generation, round(n_iterations / LENGTH)))
    if warmup is None:
        warmup = script.warmup if generation == script.generation else WARMUP * generation
    if warmup < generation:
        raise ValueError(
            f"warmup_iterations={warmup}: PGMORL predicts from what a generation of evolutionary_iterations={generation} came "
            "to, so the warm-up must have as many."
        )
    if n_iterations <= warmup:
        raise ValueError(
            f"The training has {n_iterations} iterations, and the warm-up {warmup}: there must be one more at least. Give more "
            "steps, or set warmup_iterations and evolutionary_iterations."
        )
    return warmup, generation


def iterations(steps: int, per_iteration: int) -> int:
    """:raises ValueError: for steps that are no whole number of iterations"""
    n = steps // per_iteration
    if steps % per_iteration:
        near = " or ".join(f"{k * per_iteration:,} ({k})" for k in sorted({max(n, WARMUP + 1), max(n + 1, WARMUP + 1)}))
        raise ValueError(
            f"steps={steps:,} is no whole number of iterations of {per_iteration:,} steps (steps_per_iteration x num_envs x "
            f"pop_size): give {near}; {WARMUP + 1} are the least."
        )
    return n
