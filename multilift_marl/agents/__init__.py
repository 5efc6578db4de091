"""Learning: networks, PPO, runs and their checkpoints, policies and their export."""
