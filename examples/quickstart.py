"""Train one policy for every trade-off, then choose one. `[STEPS]`"""

import sys

import mo_gymnasium

from sb3_momba import MOMBA, evaluate_front, plot_front

ENV = "mo-hopper-2obj-v5"


def main(steps: int = 10_000) -> None:
    model = MOMBA("SimbaPolicy", ENV, ent_coef="auto_0.01", seed=0, verbose=1)
    model.learn(steps, progress_bar=True)  # a few minutes on two cores; a million steps for a finished policy

    front = evaluate_front(model, ENV, n_preferences=20, n_episodes=1)
    print(f"hypervolume {front.hypervolume():,.0f}, preference regret {front.preference_regret():.1f}")
    plot_front(front, "front.png", objectives=["forward speed", "jumping height"])

    env = mo_gymnasium.make(ENV)
    observation, _ = env.reset(seed=0)
    action, _ = model.predict(observation, preference=[0.3, 0.7], deterministic=True)
    print("action for 30 % speed, 70 % height:", action)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
