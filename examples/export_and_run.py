"""Train and export where torch is, act where it is not: `export_and_run.py export`, then `export_and_run.py run`.

`export` needs sb3-momba with its extra `export`, `run` only numpy, onnxruntime and an environment.
"""

import json
import sys

import numpy as np

ENV, FILE = "mo-hopper-2obj-v5", "policy.onnx"


def export() -> None:
    from sb3_momba import MOMBA

    model = MOMBA("SimbaPolicy", ENV, ent_coef="auto_0.01", seed=0)
    model.learn(10_000, progress_bar=True)  # a few minutes on two cores; a million steps for a finished policy
    model.export(FILE)


def run() -> None:
    import mo_gymnasium
    import onnxruntime

    session = onnxruntime.InferenceSession(FILE)
    metadata = session.get_modelmeta().custom_metadata_map
    print(f"{FILE}: sb3_momba {metadata['sb3_momba']}, actions from {json.loads(metadata['action_low'])}")
    env = mo_gymnasium.make(ENV)
    for preference in ([1.0, 0.0], [0.5, 0.5], [0.0, 1.0]):
        w = np.array([preference], dtype=np.float32)
        observation, _ = env.reset(seed=0)
        earned, ended = np.zeros(2), False
        while not ended:
            batch = observation[np.newaxis].astype(np.float32)
            (actions,) = session.run(["action"], {"observation": batch, "preference": w})
            observation, reward, terminated, truncated, _ = env.step(actions[0])
            earned, ended = earned + reward, terminated or truncated
        print(f"preference {preference}: return {earned.round(1)}")
    print("torch was imported:", "torch" in sys.modules)


if __name__ == "__main__":
    if sys.argv[1:] not in (["export"], ["run"]):
        sys.exit("error: say `export` or `run`")
    export() if sys.argv[1] == "export" else run()
