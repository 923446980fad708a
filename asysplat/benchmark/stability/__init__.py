"""Hostile inputs: what they do to operators, prior, renderer, network, training and refinement.

Each file named like an area has `cases`, which yields what is measured there; `judge.py` holds the
one rule by which an error is green or red.
"""
