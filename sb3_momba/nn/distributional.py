"""Categorical return distributions (section 3.2 of the thesis): pure functions of tensors.

Shapes: probabilities, logits and targets are (batch, n_critics, n_values, n_atoms), where n_values is 1 for the
scalarised critic and n_objectives for the vector critic; any leading dimensions work.
"""

import torch as th


def make_support(v_min: float, v_max: float, n_atoms: int) -> th.Tensor:
    """Evenly spaced atoms z_i = v_min + i dz, eq. (3.5). Shape (n_atoms,)."""
    return th.linspace(v_min, v_max, n_atoms)


def expectation(probabilities: th.Tensor, support: th.Tensor) -> th.Tensor:
    """Q = sum_i Z[i] z_i, eq. (3.6).

    :param probabilities: (..., n_atoms)
    :param support: (n_atoms,)
    :return: (...)
    """
    # No matrix product: those may be rounded to bfloat16.
    return (probabilities * support).sum(dim=-1)


def project(probabilities: th.Tensor, atoms: th.Tensor, support: th.Tensor) -> th.Tensor:
    """Phi, eq. (3.7): move the mass of arbitrary atoms to the two nearest atoms of the support, in proportion to their
    nearness; what lies past an end goes to that end.

    :param probabilities: mass of each atom, (..., n_atoms)
    :param atoms: where that mass lies, broadcastable to `probabilities`
    :param support: (n_atoms,), evenly spaced
    :return: mass on the support, (..., n_atoms)
    """
    last = support.numel() - 1
    v_min, v_max = support[0], support[-1]
    position = (atoms.clamp(v_min, v_max) - v_min) * (last / (v_max - v_min))
    position = position.clamp(0, last).expand_as(probabilities)
    lower = position.floor().clamp(max=last - 1)
    share_of_upper = position - lower
    # What is not a number must stay one, instead of an index out of bounds.
    index = lower.nan_to_num().long()
    to_upper = probabilities * share_of_upper
    projected = th.zeros_like(probabilities)
    projected.scatter_add_(-1, index, probabilities - to_upper)
    projected.scatter_add_(-1, index + 1, to_upper)
    return projected


def cross_entropy(target: th.Tensor, logits: th.Tensor) -> th.Tensor:
    """H(target, Z) = -sum_i target[i] log Z[i] with Z = softmax(logits), eq. (3.8).

    :param target: probabilities, broadcastable to `logits`
    :param logits: (..., n_atoms)
    :return: (...)
    """
    return -(target * th.log_softmax(logits, dim=-1)).sum(dim=-1)


def lowest(targets: th.Tensor, worth: th.Tensor) -> th.Tensor:
    """Per transition, the target of the critic that expects least (section 3.4.2).

    :param targets: (batch, n_critics, n_values, n_atoms)
    :param worth: what each critic's target is worth: scalarised, (batch, n_critics, 1), so that all values come from one
        critic; or value by value, (batch, n_critics, n_values)
    :return: (batch, 1, n_values, n_atoms)
    """
    index = worth.argmin(dim=1, keepdim=True)[..., None]
    return targets.gather(1, index.expand(-1, 1, *targets.shape[2:]))
