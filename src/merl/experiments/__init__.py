"""Experiments: presets, and small tasks with a known optimum."""
