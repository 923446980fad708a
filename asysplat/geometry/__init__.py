"""Rotations, rigid motions and spherical harmonics."""
