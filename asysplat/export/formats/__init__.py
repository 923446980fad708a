"""File formats of Gaussians, one module each; `asysplat.export.gaussians` picks by suffix."""
