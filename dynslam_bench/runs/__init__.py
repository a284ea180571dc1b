"""Runs: a child process that steps an environment; the run store; parallel execution."""
