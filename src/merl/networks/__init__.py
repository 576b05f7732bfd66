"""The pieces that a representation and its heads are built from; no piece knows a robot or a learner."""
