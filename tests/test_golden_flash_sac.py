"""FlashSAC's critics against numbers of its authors' own code.

`flash_sac_golden.npz` holds the parameters of their two critics, three minibatches with what the critics make of them, and the
parameters and running averages after three steps of Adam, each followed by the projection. (s, a) and (s', a') go through in
one pass. Their running variance is that of a sample, n / (n - 1) of ours, which moves no number of a training.
"""

from pathlib import Path

import numpy as np
import pytest
import torch as th

from sb3_momba.nn.batch_norm import MOMENTUM, follow_batch_statistics
from sb3_momba.nn.flash_sac import FlashSacArchitecture
from sb3_momba.nn.layers import project_weights
from sb3_momba.nn.networks import Critic

OBSERVATION_DIM, ACTION_DIM, HIDDEN_DIM, N_ATOMS, N_STEPS = 3, 2, 8, 11, 3
ROWS = 32  # of a joint pass


def names(ours: str) -> str:
    """Theirs for one of our parameters."""
    for mine, theirs in (
        ("trunk.embedder.dense.weight", "embedder.w.weight"),
        ("trunk.embedder.norm", "embedder.norm"),
        ("trunk.blocks.", "encoder."),
        (".dense1.", ".w1."),
        (".dense2.", ".w2."),
        ("trunk.norm.", "post_norm."),
        ("head.dense.weight", "predictor.w.weight"),
        ("head.bias", "predictor.bias"),
        (".gain", ".weight"),
        (".shift", ".bias"),
        ("running_variance", "running_var"),
    ):
        ours = ours.replace(mine, theirs)
    return ours


@pytest.fixture(scope="module")
def golden() -> dict[str, th.Tensor]:
    with np.load(Path(__file__).with_name("flash_sac_golden.npz")) as file:
        return {name: th.as_tensor(array) for name, array in file.items()}


def theirs_as_ours(golden: dict[str, th.Tensor], moment: str, critic: Critic) -> dict[str, th.Tensor]:
    """Their matrices are (out, in), ours (in, out); our vectors have a dimension for the batch."""
    tensors = {}
    for name, tensor in critic.state_dict().items():
        found = golden[f"{moment}.{names(name)}"]
        tensors[name] = found.transpose(-1, -2) if "dense" in name else found.reshape(tensor.shape)
    return tensors


def test_three_steps_of_training_are_the_authors(golden: dict[str, th.Tensor]) -> None:
    critic = Critic(FlashSacArchitecture(HIDDEN_DIM, 2, "input"), OBSERVATION_DIM, 0, ACTION_DIM, 2, 1, N_ATOMS)
    critic.load_state_dict(theirs_as_ours(golden, "start", critic))
    optimizer = th.optim.Adam(critic.parameters(), lr=1e-2)
    for step in range(N_STEPS):
        s, a, s2, a2, target = (golden[f"step{step}.{name}"] for name in ("s", "a", "s2", "a2", "target"))
        log_prob = critic(s, a, s2, a2)[:, :, 0].log_softmax(dim=-1)
        th.testing.assert_close(log_prob, golden[f"step{step}.log_prob"].transpose(0, 1), rtol=1e-4, atol=1e-5)
        loss = -(target[:, None] * log_prob).sum(dim=-1).mean()
        th.testing.assert_close(loss, golden[f"step{step}.loss"], rtol=1e-5, atol=1e-6)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        project_weights(critic)
        follow_batch_statistics(critic)
    expected = theirs_as_ours(golden, "end", critic)
    for name, tensor in critic.state_dict().items():
        if "running_variance" in name:  # What is left of the ones that both began with is no sample's.
            ones = (1 - MOMENTUM) ** N_STEPS
            expected[name] = ones + (expected[name] - ones) * (ROWS - 1) / ROWS
        th.testing.assert_close(tensor, expected[name], rtol=1e-3, atol=2e-5, msg=name)
