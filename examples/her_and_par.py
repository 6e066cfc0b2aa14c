"""Hindsight relabelling and preference alignment (section 3.5) beside the vector critic alone. `[STEPS]`"""

import sys

from sb3_momba import MOMBA, evaluate_front

ENV = "MO-HalfCheetah-v4"
VARIANTS = {"vector critic": {}, "with HER and PAR": {"her": True, "preference_alignment": True}}


def main(steps: int = 30_000) -> None:
    for name, arguments in VARIANTS.items():
        model = MOMBA("SimbaPolicy", ENV, vector_values=True, ent_coef="auto_0.01", seed=0, **arguments)
        model.learn(steps, progress_bar=True)  # half an hour on two cores
        front = evaluate_front(model, ENV)
        print(f"{name}: hypervolume {front.hypervolume():,.0f}, preference regret {front.preference_regret():.1f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
