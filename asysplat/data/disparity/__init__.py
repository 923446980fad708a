"""Monocular disparities of images: estimated once, kept on disk, read when present."""
