"""Renderers of MuJoCo scenes: OpenGL, and a rasteriser on the processor or a GPU."""
