"""Hostile inputs for operators, prior, renderer, network, training and refinement.

`hostile.py` lists the inputs, for this suite and for tests/stress. `operators.py`, `models.py`,
`renderer.py` and `optimization.py` yield the cases of the areas. `comparison.py` holds the rule by
which a case is green or red.
"""
