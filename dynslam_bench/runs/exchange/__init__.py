"""Runs in the formats of others, and trajectories from them: EuRoC, VSLAM-LAB, KITTI, COLMAP, ROS / MCAP, rerun.

`transfer` writes and imports, `formats.read_trajectory` reads; what is written carries a
``provenance.json`` beside it.
"""
