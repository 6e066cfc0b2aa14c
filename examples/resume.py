"""Go on where a training stopped: start it, press Ctrl-C or kill it, and start it again. `[STEPS [FOLDER]]`"""

import sys
from pathlib import Path

from sb3_momba import MOMBA, MombaCheckpointCallback

ENV = "mo-hopper-2obj-v5"


def main(steps: int = 20_000, folder: Path = Path("checkpoints")) -> None:
    checkpoints = MombaCheckpointCallback(save_freq=max(1, steps // 10), path=folder, verbose=1)
    if folder.exists():
        model = MOMBA.resume(folder, ENV)
        print(f"Going on at {model.num_timesteps:,} steps, exactly as if it had never stopped.")
    else:
        model = MOMBA("SimbaPolicy", ENV, ent_coef="auto_0.01", seed=0)
    model.learn(steps - model.num_timesteps, callback=checkpoints, reset_num_timesteps=False)
    print(f"{model.num_timesteps:,} of {steps:,} steps are done.")


if __name__ == "__main__":
    given = sys.argv[1:]
    main(*map(int, given[:1]), *map(Path, given[1:]))
