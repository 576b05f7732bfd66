"""A run's folder: config, checkpoints, metrics, and where it came from."""
