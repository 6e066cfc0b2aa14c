"""Choose after training: the highest jumps among all trade-offs that keep four fifths of the speed. `[STEPS]`"""

import sys

import numpy as np

from sb3_momba import MOMBA, evaluate_front

ENV = "mo-hopper-2obj-v5"


def main(steps: int = 20_000) -> None:
    model = MOMBA("SimbaPolicy", ENV, ent_coef="auto_0.01", seed=0)
    model.learn(steps, progress_bar=True)  # ten minutes on two cores; a million steps for a finished policy
    front = evaluate_front(model, ENV, n_preferences=50, n_episodes=1)
    speed, height = front.values.T
    fast_enough = np.flatnonzero(speed >= 0.8 * speed.max())
    chosen = fast_enough[height[fast_enough].argmax()]
    preference = front.preferences[chosen]
    print(f"preference {preference.round(2)}: speed {speed[chosen]:.0f} of {speed.max():.0f}, height {height[chosen]:.0f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
