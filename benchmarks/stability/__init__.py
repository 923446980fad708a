"""Hostile inputs for operators, prior, renderer, network, training and refinement.

`hostile.py` lists the inputs, for this suite and for tests/stress. The file of each area yields its
cases, and `comparison.py` holds the one rule by which an error is green or red.
"""
