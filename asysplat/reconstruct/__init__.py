"""Reconstruction of a scene from photographs: its progress and its result folder."""
