"""Doors to the environment: the batched core, PettingZoo, TorchRL."""
