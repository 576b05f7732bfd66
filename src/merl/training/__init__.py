"""Acting and learning in turn, for any agent on any environment; measured, saved, evaluated."""
