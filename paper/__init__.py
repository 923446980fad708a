"""Compare finished runs with the tables of the paper."""
