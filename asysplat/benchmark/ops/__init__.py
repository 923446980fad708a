"""The operators by themselves."""
