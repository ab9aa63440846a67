"""Runs: from a configuration file with measured data to a directory that holds the solution."""
