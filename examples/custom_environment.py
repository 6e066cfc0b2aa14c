"""An environment of one's own with two objectives: check it, train on it, choose a trade-off.

A point is pushed towards the origin: it should be there soon, and should spend little effort.
"""

import sys

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box

from sb3_momba import MOMBA, check_mo_env, evaluate_front


class Reach(gym.Env):
    def __init__(self):
        self.observation_space = Box(-2, 2, (4,), np.float32)  # one-dimensional: place and velocity
        self.action_space = Box(-1, 1, (2,), np.float32)  # bounded
        self.reward_space = Box(-np.inf, np.inf, (2,), np.float32)  # an entry for each objective; all are maximised

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)  # seeds self.np_random, the only source of random numbers
        self.place = self.np_random.uniform(-1, 1, 2)
        self.velocity = np.zeros(2)
        return self.observe(), {}

    def step(self, action):
        self.velocity = np.clip(0.8 * self.velocity + 0.2 * action, -1, 1)
        self.place = np.clip(self.place + 0.2 * self.velocity, -2, 2)
        closeness, effort = 1 - np.linalg.norm(self.place), np.square(action).sum()
        reward = np.array([closeness, -effort], dtype=np.float32)
        return self.observe(), reward, False, False, {}  # terminated: the world ends; truncated: only the episode does

    def observe(self):
        return np.concatenate([self.place, self.velocity]).astype(np.float32)


gym.register("Reach-v0", entry_point=Reach, max_episode_steps=50)  # truncates after 50 steps

if __name__ == "__main__":
    steps = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    check_mo_env("Reach-v0")  # names what is wrong with an environment
    sizes = {"actor_hidden_dim": 64, "critic_hidden_dim": 64, "actor_blocks": 1, "critic_blocks": 1}
    model = MOMBA(
        "SimbaPolicy", "Reach-v0", learning_rate=1e-3, learning_starts=500, ent_coef="auto_0.01", policy_kwargs=sizes, seed=0
    )
    model.learn(steps, progress_bar=True)
    front = evaluate_front(model, "Reach-v0", n_preferences=5)
    for preference, (closeness, effort) in zip(front.preferences, front.values, strict=True):
        print(f"preference {preference.round(2)}: closeness {closeness:6.1f}, effort {-effort:6.1f}")
