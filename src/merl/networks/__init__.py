"""The pieces of a representation and its heads; no piece knows a robot or a learner."""
