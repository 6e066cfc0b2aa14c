"""Checkpoints: everything that a training is, in folders that are whole or not there, and exact resumption from them."""
