"""One step of an optimiser, and of a target network."""

import math

import torch as th


@th.no_grad()
def move_towards(target: th.nn.Module, network: th.nn.Module, tau: float) -> None:
    """target <- (1 - tau) target + tau network, all parameters in one call (Algorithm 1).

    Running averages of batch norm are left alone: the target is asked in training mode only, and never reads its own.
    """
    th._foreach_lerp_(list(target.parameters()), list(network.parameters()), tau)


class NonFiniteLossError(ArithmeticError):
    """A loss or its gradient is NaN or infinite; it changed nothing of its network."""


def descend(optimizer: th.optim.Optimizer, loss: th.Tensor, name: str) -> None:
    """One step of an optimiser on its own parameters; gradients of all others are not even computed.

    :param name: of what is optimised, for the error
    """
    check_loss(loss, name)
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    optimizer.zero_grad(set_to_none=True)
    loss.backward(inputs=parameters)  # type: ignore[no-untyped-call]
    try:
        check_gradients(parameters, name)
    except NonFiniteLossError:
        optimizer.zero_grad(set_to_none=True)
        raise
    optimizer.step()


def check_loss(loss: th.Tensor, name: str) -> None:
    if not math.isfinite(loss.item()):
        raise NonFiniteLossError(f"the {name}'s loss is {loss.item()}.")


def check_gradients(parameters: list[th.Tensor], name: str) -> None:
    norms = th.stack(th._foreach_norm([p.grad for p in parameters if p.grad is not None]))
    norm = math.hypot(*norms.tolist())
    if not math.isfinite(norm):
        raise NonFiniteLossError(f"the norm of the {name}'s gradient is {norm:g}.")
