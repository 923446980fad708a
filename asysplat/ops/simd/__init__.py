"""What all kernels for CPUs have in common: how they are compiled (Numba), threads and vectors."""
