"""What kernels are made of and how one is chosen, for operators and renderer alike."""
