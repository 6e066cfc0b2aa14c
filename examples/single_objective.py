"""A scalar reward needs no preference: MOMBA is then plain SimbaV2-SAC. `[STEPS]`"""

import sys

from stable_baselines3.common.evaluation import evaluate_policy

from sb3_momba import MOMBA


def main(steps: int = 10_000) -> None:
    small = {"actor_hidden_dim": 64, "critic_hidden_dim": 64}
    model = MOMBA(
        "SimbaPolicy", "Pendulum-v1", learning_rate=1e-3, learning_starts=500, ent_coef="auto_0.01", policy_kwargs=small, seed=0
    )
    model.learn(steps, progress_bar=True)  # four minutes on one core
    mean, spread = evaluate_policy(model, model.get_env(), n_eval_episodes=10)
    print(
        f"mean return {mean:.0f}, standard deviation {spread:.0f} (-150 is what a good controller reaches, -1,200 a random one)"
    )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
