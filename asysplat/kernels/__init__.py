"""Building blocks of kernels, and the choice of a backend, for the operators and the renderer."""
