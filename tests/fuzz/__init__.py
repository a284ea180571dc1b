"""Attacks on every reader of files: `python -m tests.fuzz --minutes 60`, and a short round in the tests."""
