"""Scenes for other programs and for the eye: files, videos and a viewer in the browser."""
