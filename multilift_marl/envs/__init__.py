"""The APIs of an environment: the batched core, Gymnasium, PettingZoo, TorchRL, Stable-Baselines3."""
