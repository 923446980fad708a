"""Run time against error, in one process."""
