"""Evaluation of a policy, videos of its episodes, and policies of saved runs."""
