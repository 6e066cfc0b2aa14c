"""Four environments, each in a process of its own and under a preference of its own. `[STEPS]`"""

import sys

from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_momba import MOMBA, evaluate_front, make_mo_vec_env

ENV = "mo-halfcheetah-v5"


def main(steps: int = 20_000) -> None:
    env = make_mo_vec_env(ENV, n_envs=4, seed=0, vec_env_cls=SubprocVecEnv)
    # A step of the four gives four transitions; -1 makes as many updates.
    model = MOMBA("SimbaPolicy", env, gradient_steps=-1, ent_coef="auto_0.01", seed=0)
    model.learn(steps, progress_bar=True)
    env.close()
    front = evaluate_front(model, ENV, n_preferences=20, n_episodes=1, n_workers=2)
    print(f"expected utility {front.expected_utility():,.1f} after {model.num_timesteps:,} steps")


if __name__ == "__main__":  # The processes import this file.
    main(*map(int, sys.argv[1:]))
