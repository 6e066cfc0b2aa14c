"""What products in bfloat16 change of an update, at five moments of a training: `python -m tests.rounding [--env ID]`.

Losses and their gradients on one minibatch with the same random numbers, once in float32 and once in bfloat16.
"""

import argparse

import torch as th

from sb3_momba import MOMBA
from sb3_momba.benchmark.tables import markdown

CHECKPOINTS = (6_000, 8_000, 10_000, 12_500, 15_000)  # environment steps; the first 5,000 are random
LEAST_COSINE = 0.99
LARGEST_DIFFERENCE = 0.5  # of Q, in atoms


def gradients(model: MOMBA, precision: str, batch) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """Of the critic loss and of the actor loss, flat; and Q, (batch, n_critics, n_values)."""
    model.precision = precision
    th.manual_seed(0)
    with model._rounded_products():
        critic_loss, _ = model._critic_loss(batch, model.alpha)
        actor_loss, _, _ = model._actor_loss(batch, model.alpha)
        with th.no_grad():
            q = model.policy.value.mean(model.critic(batch.observations, batch.actions))
    flat = []
    for loss, network in ((critic_loss, model.critic), (actor_loss, model.actor)):
        flat.append(th.cat([g.flatten() for g in th.autograd.grad(loss, list(network.parameters()))]))
    return flat[0], flat[1], q


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="MO-HalfCheetah-v4")
    given = parser.parse_args()
    model = MOMBA("SimbaPolicy", given.env, seed=0, ent_coef="auto_0.01", buffer_size=20_000, device="cpu")
    atom = (model.policy.value.support[1] - model.policy.value.support[0]).item()
    rows = [["steps", "cosine, critic's gradient", "cosine, actor's gradient", "mean difference of Q, atoms"]]
    held = True
    for steps in CHECKPOINTS:
        model.precision = "bfloat16"
        model.learn(steps - model.num_timesteps, reset_num_timesteps=False)
        batch = model._sample(model.batch_size)
        exact, rounded = gradients(model, "float32", batch), gradients(model, "bfloat16", batch)
        cosines = [th.cosine_similarity(a, b, dim=0).item() for a, b in zip(exact[:2], rounded[:2], strict=True)]
        difference = (exact[2] - rounded[2]).abs().mean().item() / atom
        held &= min(cosines) >= LEAST_COSINE and difference <= LARGEST_DIFFERENCE
        rows.append([f"{steps:,}", *(f"{cosine:.5f}" for cosine in cosines), f"{difference:.4f}"])
        print(markdown([rows[0], rows[-1]]).splitlines()[-1], flush=True)
    print(markdown(rows))
    print("held" if held else f"not held: cosines of at least {LEAST_COSINE}, at most {LARGEST_DIFFERENCE} atoms")


if __name__ == "__main__":
    main()
