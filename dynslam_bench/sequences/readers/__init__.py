"""Readers of recorded sequences, one layout a file."""
