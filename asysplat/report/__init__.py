"""The paper's numbers, what finished runs measured, and both side by side."""
