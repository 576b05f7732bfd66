"""Rasteriser for MuJoCo models, in Warp kernels with the same source for CPU and CUDA."""
