"""Training of any agent on any environment: the loop, timing, evaluations, checkpoints."""
