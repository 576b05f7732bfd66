"""Acting: environments, here or in worker processes, and what an agent sees of them."""
