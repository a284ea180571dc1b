"""Children that make runs: the server that forks them, the child, and who watches it."""
