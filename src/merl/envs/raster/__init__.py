"""A rasteriser for MuJoCo models as Warp kernels, the same source for CPU and CUDA."""
