"""Hostile inputs for operators, prior, renderer, network, training and refinement.

`hostile.py` lists the inputs. `operators.py`, `models.py`,
`renderer.py` and `optimization.py` yield the cases of the areas. `comparison.py` holds the rule by
which a case is green or red.
"""
