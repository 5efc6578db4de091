"""Evaluation: episodes on fixed seeds, metrics with intervals, reports and plots."""
