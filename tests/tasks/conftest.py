import merl.tasks  # noqa: F401  (before dm_control: it keeps the import from looking for OpenGL)
