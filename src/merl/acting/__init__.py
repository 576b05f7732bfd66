"""Acting: environments in this process or in worker processes, and the frame stack."""
