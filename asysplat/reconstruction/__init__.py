"""One scene's Gaussians, fitted to its photographs."""
