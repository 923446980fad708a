"""Check a scene's files, and whether its cameras fit its images: asysplat check PATH."""
