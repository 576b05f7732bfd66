"""Demonstrations: recorded episodes, and their conversion from and to other formats."""
