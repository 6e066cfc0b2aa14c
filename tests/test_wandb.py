"""Weights & Biases, through its own callback for SB3, without a connection."""

import subprocess
import sys

SCRIPT = """
import sys
import wandb
from wandb.integration.sb3 import WandbCallback
from sb3_momba import MOMBA
from tests.stubs import StubEnv, tiny_model

if __name__ == "__main__":
    run = wandb.init(mode="offline", dir=sys.argv[1], project="sb3-momba", settings=wandb.Settings(silent=True))
    model = tiny_model(StubEnv())
    model.learn(60, WandbCallback(model_save_path=sys.argv[1] + "/models", gradient_save_freq=10))
    print(run.config["gamma"], run.config["batch_size"])
    run.finish()
    print(MOMBA.load(sys.argv[1] + "/models/model.zip").num_timesteps)
"""


def test_wandbs_callback_notes_the_settings_and_saves_the_model(tmp_path) -> None:
    command = [sys.executable, "-c", SCRIPT, str(tmp_path)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.split() == ["0.99", "16", "60"], ended.stdout
    assert list((tmp_path / "wandb").glob("offline-run-*/*.wandb"))
