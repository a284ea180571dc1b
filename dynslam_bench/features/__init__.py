"""Keypoints and descriptors (ORB by default), and their matching."""
