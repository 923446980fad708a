"""The regression watch: every kernel beside something that does the same without it."""
