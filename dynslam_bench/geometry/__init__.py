"""Camera model, SE(3), and trajectories with their file formats."""
