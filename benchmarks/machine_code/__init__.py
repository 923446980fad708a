"""What Triton compiles the kernels to, for GPUs that are not at hand."""
