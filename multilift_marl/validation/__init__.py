"""Experiments against theory: `python -m multilift_marl.validation`."""
