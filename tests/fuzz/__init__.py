"""Attacks on every reader of files."""
