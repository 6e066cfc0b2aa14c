"""Batch norm and the norms that are projected, by hand."""

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_momba.nn.batch_norm import BatchNorm, follow_batch_statistics
from sb3_momba.nn.flash_sac import UnitBatchNorm, UnitRmsNorm


def batch_norms(network: nn.Module) -> list[BatchNorm]:
    return [module for module in network.modules() if isinstance(module, BatchNorm)]


def scramble(network: nn.Module) -> None:
    """Parameters and running averages as after a training: none where it started."""
    generator = th.Generator().manual_seed(5)
    for parameter in network.parameters():
        parameter.data.add_(0.3 * th.randn(parameter.shape, generator=generator))
    for layer in batch_norms(network):
        layer.running_mean.add_(0.3 * th.randn(layer.running_mean.shape, generator=generator))
        layer.running_variance.mul_(0.5 + th.rand(layer.running_variance.shape, generator=generator))


def test_batch_norm_by_hand() -> None:
    """Columns (1, 3) and (10, 30): means 2 and 20, variances 1 and 100. With eps = 0 both become (-1, 1)."""
    norm = BatchNorm(2, eps=0.0)
    norm.gain.data, norm.shift.data = th.tensor([2.0, 3.0]), th.tensor([0.5, -1.0])
    x = th.tensor([[1.0, 10.0], [3.0, 30.0]])
    np.testing.assert_allclose(norm(x).detach(), [[-1.5, -4.0], [2.5, 2.0]], rtol=1e-6)
    assert norm.running_mean.tolist() == [0, 0]  # a pass alone changes nothing that is saved
    assert norm.running_variance.tolist() == [1, 1]
    norm.follow()
    np.testing.assert_allclose(norm.running_mean, [0.02, 0.2], rtol=1e-6)
    np.testing.assert_allclose(norm.running_variance, [1.0, 1.99], rtol=1e-6)
    norm.eval()
    expected = (x.numpy() - [0.02, 0.2]) / np.sqrt([1.0, 1.99]) * [2, 3] + [0.5, -1]
    np.testing.assert_allclose(norm(x).detach(), expected, rtol=1e-6)
    norm.eps = 3.0
    np.testing.assert_allclose(norm(x)[0, 0].item(), (1 - 0.02) / 2 * 2 + 0.5, rtol=1e-6)


def test_running_averages_come_to_the_mean_and_variance_of_what_is_seen() -> None:
    norm = BatchNorm(1, eps=0.0)
    for _ in range(1_000):
        norm(th.tensor([[4.0], [10.0]]))
        norm.follow()
    np.testing.assert_allclose([norm.running_mean.item(), norm.running_variance.item()], [7, 9], rtol=1e-3)


@pytest.mark.parametrize("shared_input", [True, False], ids=["one input for all", "each its own"])
def test_members_of_an_ensemble_have_statistics_of_their_own(shared_input: bool) -> None:
    ensemble, single = BatchNorm(3, 1e-3, n_members=2), [BatchNorm(3, 1e-3), BatchNorm(3, 1e-3)]
    scramble(ensemble)
    for i, norm in enumerate(single):
        norm.load_state_dict({name: tensor[i, 0] for name, tensor in ensemble.state_dict().items()})
    x = th.randn(4, 3) if shared_input else th.randn(2, 4, 3)
    for training in (True, False):
        for norm in (ensemble, *single):
            norm.train(training)
        y = ensemble(x)
        assert y.shape == (2, 4, 3)
        for i, norm in enumerate(single):
            th.testing.assert_close(y[i], norm(x if shared_input else x[i]))
        if training:
            follow_batch_statistics(nn.ModuleList([ensemble, *single]))
            for i, norm in enumerate(single):
                th.testing.assert_close(ensemble.running_mean[i, 0], norm.running_mean)
                th.testing.assert_close(ensemble.running_variance[i, 0], norm.running_variance)


def test_statistics_are_float32_whatever_the_products_are_rounded_to() -> None:
    norm = BatchNorm(1, eps=0.0)
    # In bfloat16 their sum of squares would lose the small one.
    y = norm(th.tensor([[256.0], [258.0], [257.0]], dtype=th.bfloat16).to(th.bfloat16))
    assert y.dtype == norm.batch_variance.dtype == th.float32
    np.testing.assert_allclose(norm.batch_mean, th.tensor([[256.0], [258.0], [257.0]]).bfloat16().float().mean(), rtol=1e-6)


def test_projected_norms_by_hand() -> None:
    """(gain, shift) = (3, 0), (4, 0): 25 becomes d = 2. RMS norm of (3, 4): sqrt(12.5)."""
    norm = UnitBatchNorm(2)
    norm.gain.data, norm.shift.data = th.tensor([3.0, 0.0]), th.tensor([0.0, 4.0])
    norm.project()
    np.testing.assert_allclose(norm.gain.detach(), [3 * np.sqrt(2 / 25), 0], rtol=1e-6)
    np.testing.assert_allclose(norm.shift.detach(), [0, 4 * np.sqrt(2 / 25)], rtol=1e-6)
    rms = UnitRmsNorm(2)
    np.testing.assert_allclose(rms(th.tensor([[3.0, 4.0]])).detach(), [[3 / np.sqrt(12.5), 4 / np.sqrt(12.5)]], rtol=1e-6)
    rms.gain.data = th.tensor([6.0, 8.0])
    rms.project()
    np.testing.assert_allclose(rms.gain.detach(), [6 * np.sqrt(2 / 100), 8 * np.sqrt(2 / 100)], rtol=1e-6)
