"""Noise on actions: held for several steps while exploring, and TD3's in the targets."""

import torch as th

EXPONENT = 2.0


class HeldNoise:
    """Standard normal noise, each draw kept for n steps of its environment, P(n) proportional to n^-2 (the zeta distribution
    of Dabney et al., 2021, cut off as in FlashSAC): it moves actions the same way for a while, where new draws at every step
    average away.

    :param longest: largest n
    """

    def __init__(self, longest: int):
        self.probabilities = th.arange(1, longest + 1, dtype=th.float64) ** -EXPONENT
        self.noise: th.Tensor | None = None
        self.steps_left = th.zeros(0, dtype=th.int64)

    def __call__(self, like: th.Tensor) -> th.Tensor:
        """The noise of the next step, of the shape of `like`, (n_envs, action_dim)."""
        if self.noise is None or self.noise.shape != like.shape:
            self.noise, self.steps_left = th.zeros_like(like), th.zeros(len(like), dtype=th.int64)
        ended = self.steps_left == 0
        drawn = th.multinomial(self.probabilities, len(like), replacement=True) + 1
        self.noise = th.where(ended[:, None].to(like.device), th.randn_like(like), self.noise.to(like.device))
        self.steps_left = th.where(ended, drawn, self.steps_left) - 1
        return self.noise

    def state_dict(self) -> dict[str, th.Tensor | None]:
        """What the next steps depend on."""
        return {"noise": self.noise, "steps_left": self.steps_left}

    def load_state_dict(self, state: dict[str, th.Tensor | None]) -> None:
        """:param state: of `state_dict`"""
        vars(self).update(state)


def td3_smoothed(actions: th.Tensor, noise: float) -> th.Tensor:
    """TD3's target policy smoothing on [-1, 1]: with 0.1, a deviation of 0.2, clipped at 0.5."""
    return (actions + (2 * noise * th.randn_like(actions)).clamp(-5 * noise, 5 * noise)).clamp(-1, 1)
