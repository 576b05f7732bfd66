"""Encoders, fusion, heads and their parts; none depends on a robot or a learner."""
