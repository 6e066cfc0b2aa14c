"""Five minutes on two CPU cores: small networks on MO-Hopper, beside policies that have learned nothing. `[STEPS]`"""

import sys
import time

import torch as th

from sb3_momba.runs import RunSettings, run
from sb3_momba.train import report

ENV = "mo-hopper-2obj-v5"


def main(steps: int = 25_000) -> None:
    # Networks this small are faster on one thread than on two.
    th.set_num_threads(1)

    started = time.monotonic()
    result = run(
        RunSettings(
            env=ENV,
            output=f"runs/demo/{time.strftime('%Y%m%d-%H%M%S')}",
            steps=steps,
            eval_freq=steps // 10,
            objectives=["forward speed", "jumping height"],
            hyperparameters={
                "ent_coef": "auto_0.01",
                "learning_rate": 3e-4,
                "learning_starts": 1_000,
                "batch_size": 128,
                "her": True,
                "n_steps": 3,
                "policy_kwargs": {"actor_hidden_dim": 64, "actor_blocks": 1, "critic_hidden_dim": 64, "critic_blocks": 1},
            },
            n_preferences=20,
            n_episodes=2,
        )
    )
    print(f"\n{ENV}, {time.monotonic() - started:.0f} s")
    print(report(result))
    floor = max(metrics["hypervolume"] for metrics in result.floors.values())
    print(f"Hypervolume {result.front.hypervolume() / floor:.1f} times that of the better of the two that learned nothing.")
    print("\nTo see it in a browser, with films of the policy:")
    print("  .venv/bin/pip install -c constraints.txt -e '.[explorer]'")
    print(f"  .venv/bin/python -m sb3_momba.explorer report {result.folder}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
