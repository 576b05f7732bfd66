"""Evaluation of a policy, its videos, and policies of saved runs."""
