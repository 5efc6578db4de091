"""The command line: train and evaluate."""
