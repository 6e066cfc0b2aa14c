"""How matrix products are computed: in bfloat16 where that is asked for, and in float32 by the faster library."""

import contextlib
import logging
from collections.abc import Iterator
from functools import cache
from typing import Any

import torch as th

PRECISIONS = ("float32", "bfloat16", "auto")
UNDECIDED = "none"

logger = logging.getLogger(__name__)


@cache  # and so said once
def product_dtype(precision: str, device: th.device) -> th.dtype:
    """What the factors of matrix products are rounded to; weights, norms, losses and sums stay float32 in any case.

    :param precision: "float32", "bfloat16", or "auto": bfloat16 where the device has instructions for it (AMX, AVX512-BF16,
        CUDA from Ampere on)
    """
    if precision == "auto":
        native = has_native_bfloat16(device)
        if not native:
            logger.warning("precision='auto': %s has no bfloat16 of its own, float32 is used.", device)
        return th.bfloat16 if native else th.float32
    return th.bfloat16 if precision == "bfloat16" else th.float32


def has_native_bfloat16(device: th.device) -> bool:
    if device.type == "cuda":  # untested
        return th.cuda.is_bf16_supported(including_emulation=False)
    checks = (getattr(th.cpu, name, None) for name in ("_is_amx_tile_supported", "_is_avx512_bf16_supported"))
    return device.type == "cpu" and any(check() for check in checks if check is not None)


@contextlib.contextmanager
def fast_float32_products() -> Iterator[None]:
    """Inside, oneDNN computes float32 products on the CPU, where it computes them in full float32.

    torch gives them to MKL, which uses half the width of an AMD processor. The permission to round factors to bfloat16 hands
    them to oneDNN, which makes use of it only where there are instructions for that (AMX); elsewhere its products are float32
    and up to twice as fast. Where a probe shows rounded factors, or the user has decided, nothing is changed. The setting
    is the process's: products of other threads are meant too, meanwhile.
    """
    if not onednn_keeps_float32() or _settings().fp32_precision != UNDECIDED:
        yield
        return
    with _rounding_permitted():
        yield


@cache
def onednn_keeps_float32() -> bool:
    """Whether a permitted rounding is not made use of: the probe's error is 1e-6 in float32, 6e-2 with rounded factors."""
    if not hasattr(getattr(th.backends.mkldnn, "matmul", None), "fp32_precision"):
        return False  # torch before 2.9
    x = th.sin(th.arange(256.0 * 256.0, dtype=th.float32, device="cpu")).reshape(256, 256)
    exact = x.double() @ x.double()
    with _rounding_permitted():
        error = (x @ x - exact).abs().max() / exact.abs().max()
    return bool(error < 1e-4)


@contextlib.contextmanager
def _rounding_permitted() -> Iterator[None]:
    before = _settings().fp32_precision
    _settings().fp32_precision = "bf16"
    try:
        yield
    finally:
        _settings().fp32_precision = before


def _settings() -> Any:
    return th.backends.mkldnn.matmul  # type: ignore[attr-defined]
