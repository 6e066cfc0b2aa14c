"""The function approximators. Nothing in here imports from the rest of the package."""
