"""Local bundle adjustment: the own solver, and gtsam as its reference."""
