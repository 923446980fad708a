"""Where a refinement adds, moves and removes Gaussians."""
