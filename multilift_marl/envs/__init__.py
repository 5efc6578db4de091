"""Doors to the environment: the batched core, Gymnasium, PettingZoo, TorchRL."""
