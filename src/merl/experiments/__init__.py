"""Experiments: presets, and the runs of sweeps."""
