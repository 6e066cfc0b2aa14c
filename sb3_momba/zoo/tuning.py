"""What `python -m sb3_momba.zoo optimize` tries: hyperparameters of MOMBA for Optuna.

Networks and the method (`vector_values`, `her`, ...) stay as the yaml file has them.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import optuna


def sample_params(trial: "optuna.Trial", n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """MOMBA's arguments for a trial; rl_zoo3's signature."""
    params = {
        "learning_rate": trial.suggest_float("learning_rate", 3e-5, 3e-3, log=True),
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 3e-3, 5e-2, log=True),
        "tau": trial.suggest_float("tau", 1e-3, 5e-2, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 6, 9),
        "gradient_steps_pow": trial.suggest_int("gradient_steps_pow", 0, 2),
        "n_steps": trial.suggest_int("n_steps", 1, 5),
        "ent_coef_start": trial.suggest_float("ent_coef_start", 1e-3, 0.5, log=True),
    }
    converted = convert_params(params)
    for name in ("gamma", "batch_size", "gradient_steps", "ent_coef"):
        trial.set_user_attr(name, converted[name])
    return converted


def convert_params(params: dict[str, Any]) -> dict[str, Any]:
    """MOMBA's arguments from what a study stores of a trial."""
    params = dict(params)
    return {
        "gamma": 1 - params.pop("one_minus_gamma"),
        "batch_size": 2 ** params.pop("batch_size_pow"),
        "gradient_steps": 2 ** params.pop("gradient_steps_pow"),
        "ent_coef": f"auto_{params.pop('ent_coef_start')}",
        **params,
    }
