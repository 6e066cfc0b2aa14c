"""Hyperparameters in rl_zoo3's yaml format."""
