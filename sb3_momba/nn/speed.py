"""What makes an update faster and changes nothing of its result: compiled networks, no gradients that nobody reads, memory
that stays."""

import contextlib
import os
import shutil
from collections.abc import Callable, Iterator
from functools import cache, wraps
from typing import Any, TypeVar

import torch as th
from torch import nn

from sb3_momba.nn.layers import HyperDense, Linear

LARGEST_HEAP_BLOCK = 2**25 - 2**16  # bytes: what glibc's threshold grows to, less its own bookkeeping

Method = TypeVar("Method", bound=Callable[..., Any])


def compilable(method: Method) -> Method:
    """A network's method that torch.compile makes faster while training, where `network.compiled` says so.

    Acting and evaluating come in batches of other sizes, each of which would be compiled anew.
    """

    @wraps(method)
    def chosen(network: Any, *tensors: th.Tensor) -> Any:
        return (compiled(method) if network.compiled and network.training else method)(network, *tensors)

    return chosen  # type: ignore[return-value]


@cache
def compiled(method: Callable[..., Any]) -> Callable[..., Any]:
    return th.compile(method, dynamic=False)  # type: ignore[no-any-return]


def has_compiler() -> bool:
    """Whether there is a C++ compiler where torch looks for one."""
    return shutil.which(os.environ.get("CXX", "g++")) is not None or shutil.which("clang++") is not None


@contextlib.contextmanager
def without_weight_gradients(network: nn.Module) -> Iterator[None]:
    """Inside, weight matrices are constants: their gradients are half of the products of a backward pass.

    Scalers and biases are not, though nobody reads their gradients either: without them compiled code would store ReLU's
    masks, which takes longer than the gradients.
    """
    weights = [module.weight for module in network.modules() if isinstance(module, HyperDense | Linear)]
    for weight in weights:
        weight.requires_grad_(False)
    try:
        yield
    finally:
        for weight in weights:
            weight.requires_grad_(True)


def keep_freed_memory() -> None:
    """Let the C library keep freed memory for the next update instead of giving it back to the system, page by page.

    glibc's malloc gives back what is free beyond twice the largest block freed so far, blocks above 32 MB apart. An update
    frees and needs some 40 MB; to have them anew each time costs thousands of page faults, up to a quarter of its time.
    """
    th.empty(LARGEST_HEAP_BLOCK, dtype=th.uint8)
