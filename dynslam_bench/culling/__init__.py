"""Dynamic feature filters: which keypoints lie on things that move? One file a building block."""
