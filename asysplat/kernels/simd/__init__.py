"""The toolkit of the CPU kernels (Numba): compilation, threads, vectors, gathers, products."""
