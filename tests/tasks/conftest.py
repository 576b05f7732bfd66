import merl.tasks  # noqa: F401  (before dm_control, which then does not look for OpenGL)
