"""Baselines and tuned linear policies; beside them, the files of the shipped learned policies."""
