"""What all kernels for GPUs have in common: how they are compiled (Triton)."""
