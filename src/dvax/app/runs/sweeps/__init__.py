"""Sweeps: many runs of one configuration with other parameters, and one table of their results."""
