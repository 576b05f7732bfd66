"""What is run: presets, and later the paper's figures as data."""
