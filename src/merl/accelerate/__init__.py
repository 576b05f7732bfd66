"""What only a GPU or torch.compile needs: a replay on the GPU, CUDA graphs, faster networks."""
