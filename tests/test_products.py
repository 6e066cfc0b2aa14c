"""Float32 products while training: faster where they may be, never rounder."""

import pytest
import torch as th

from sb3_momba import MOMBA
from sb3_momba.nn import products
from sb3_momba.nn.products import fast_float32_products, onednn_keeps_float32
from tests.stubs import StubEnv, tiny_model

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


# ---------------------------------------------------------------------------------------------------------- precision


def gradients(model: MOMBA, precision: str) -> list[th.Tensor]:
    """Of the critic's and the actor's loss on one batch with the same noise, each as one vector."""
    model.precision = precision
    batch = model.replay_buffer.sample(64)
    found = []
    for loss, network in ((model._critic_loss, model.critic), (model._actor_loss, model.actor)):
        th.manual_seed(0)
        with model._rounded_products():
            value = loss(batch, model.alpha)[0]
        assert value.dtype == th.float32
        found.append(th.cat([g.flatten() for g in th.autograd.grad(value, list(network.parameters()))]))
    return found


@pytest.mark.parametrize(
    ("policy", "critic_loss", "vector"),
    [("SimbaPolicy", "ce", False), ("MlpPolicy", "mse", True), ("XqcPolicy", "ce", True), ("FlashSacPolicy", "ce", False)],
)
def test_gradients_of_rounded_products_point_the_same_way(policy, critic_loss, vector):
    model = MOMBA(policy, StubEnv(), seed=0, buffer_size=200, critic_loss=critic_loss, vector_values=vector, device="cpu")
    model.learn(150)
    state = model.replay_buffer.rng.bit_generator.state
    exact = gradients(model, "float32")
    model.replay_buffer.rng.bit_generator.state = state
    rounded = gradients(model, "bfloat16")
    for a, b in zip(exact, rounded, strict=True):
        assert b.dtype == th.float32
        assert not th.equal(a, b)
        assert th.cosine_similarity(a, b, dim=0) >= 0.99


@pytest.mark.parametrize("policy", MOMBA.policy_aliases)
def test_weights_and_statistics_stay_float32_in_training_with_rounded_products(policy):
    model = tiny_model(StubEnv(), policy, precision="bfloat16").learn(40)
    assert model._n_updates > 0
    assert {p.dtype for p in model.policy.parameters()} == {th.float32}


def test_auto_takes_bfloat16_where_the_processor_has_it_and_says_where_not(monkeypatch, caplog):
    cpu = th.device("cpu")
    for native, dtype in ((True, th.bfloat16), (False, th.float32)):
        products.product_dtype.cache_clear()
        monkeypatch.setattr(products, "has_native_bfloat16", lambda device, native=native: native)
        with caplog.at_level("WARNING"):
            assert products.product_dtype("auto", cpu) == dtype
        assert products.product_dtype("float32", cpu) == th.float32
        assert products.product_dtype("bfloat16", cpu) == th.bfloat16
    products.product_dtype.cache_clear()
    assert caplog.text.count("float32 is used") == 1


def test_a_precision_that_is_not_known_is_refused():
    with pytest.raises(ValueError, match="precision='half' is not known: use one of float32, bfloat16, auto"):
        MOMBA("SimbaPolicy", StubEnv(), precision="half")
