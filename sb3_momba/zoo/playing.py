"""What `python -m sb3_momba.zoo enjoy` adds to rl_zoo3's environments: a preference, and returns of every objective."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import CloudpickleWrapper, VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_momba.envs.making import n_objectives_of
from sb3_momba.envs.preferences import check_preference, make_sampler


class PrintReturns(VecEnvWrapper):
    """Prints the preference and the vector return of each episode that ends."""

    def __init__(self, venv: VecEnv):
        super().__init__(venv)
        self.returns = np.zeros((venv.num_envs, n_objectives_of(venv)))

    def reset(self) -> VecEnvObs:
        self.returns[:] = 0
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, dones, infos = self.venv.step_wait()
        for index, (done, info) in enumerate(zip(dones, infos, strict=True)):
            self.returns[index] += info["vector_reward"]
            if done:
                preference, returns = (np.array2string(x, precision=5) for x in (info["preference"], self.returns[index]))
                print(f"Preference: {preference}  Returns: {returns}")
                self.returns[index] = 0
        return observations, rewards, dones, infos


def with_preference(create_test_env: Callable[..., VecEnv], preference: Sequence[float] | None) -> Callable[..., VecEnv]:
    """rl_zoo3's `create_test_env`, whose environments have a preference.

    :param preference: for all episodes, (n_objectives,); None: drawn by the sampler that the model was trained with
    """

    def create(*args: Any, hyperparams: dict[str, Any], **kwargs: Any) -> VecEnv:
        venv = create_test_env(*args, hyperparams=hyperparams, **kwargs)
        n_objectives = n_objectives_of(venv)
        if preference is not None:
            venv.env_method("set_preference", check_preference(preference, n_objectives))
        elif hyperparams.get("preference_sampler") is not None:
            sampler = make_sampler(hyperparams["preference_sampler"], n_objectives)
            venv.env_method("set_preference_sampler", CloudpickleWrapper(sampler))
        return PrintReturns(venv)

    return create
