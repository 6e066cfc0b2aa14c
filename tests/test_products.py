"""Float32 products while training: faster where they may be, never rounder."""

import pytest
import torch as th

from sb3_momba.nn.products import fast_float32_products, onednn_keeps_float32

pytestmark = pytest.mark.skipif(not hasattr(th.backends.mkldnn, "matmul"), reason="torch before 2.9 has no such setting")


@pytest.fixture(autouse=True)
def fresh_probe():
    onednn_keeps_float32.cache_clear()
    yield
    onednn_keeps_float32.cache_clear()


def setting() -> str:
    return th.backends.mkldnn.matmul.fp32_precision


@pytest.mark.parametrize("shape", [(1, 17, 3), (256, 256, 1024), (256, 1024, 101)])
def test_products_inside_are_float32(shape):
    m, k, n = shape
    th.manual_seed(0)
    x, y = th.randn(2, m, k), th.randn(2, k, n)
    with fast_float32_products():
        product = th.bmm(x, y)
    assert (product - x.double() @ y.double()).abs().max() < 2e-6 * k


def test_the_setting_is_restored_also_after_an_error():
    before = setting()
    with pytest.raises(KeyError), fast_float32_products():
        raise KeyError
    assert setting() == before


def test_nothing_changes_where_factors_would_be_rounded(monkeypatch):
    # As a processor with AMX would: the probe's float32 product is that of rounded factors.
    monkeypatch.setattr(th.Tensor, "__matmul__", rounding_product)
    assert not onednn_keeps_float32()
    before = setting()
    with fast_float32_products():
        assert setting() == before


def rounding_product(x: th.Tensor, y: th.Tensor) -> th.Tensor:
    if x.dtype == th.float32:
        x, y = x.bfloat16().float(), y.bfloat16().float()
    return th.matmul(x, y)


def test_a_choice_of_the_user_stands():
    settings = th.backends.mkldnn.matmul
    before, settings.fp32_precision = settings.fp32_precision, "ieee"
    try:
        with fast_float32_products():
            assert setting() == "ieee"
    finally:
        settings.fp32_precision = before


def test_torch_without_the_setting_trains_as_ever(monkeypatch):
    monkeypatch.setattr(th.backends, "mkldnn", object())
    assert not onednn_keeps_float32()
    with fast_float32_products():
        pass
