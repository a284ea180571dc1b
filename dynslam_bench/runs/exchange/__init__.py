"""Runs in the formats of others, and trajectories from them: EuRoC, VSLAM-LAB, KITTI, COLMAP, ROS / MCAP, rerun.

`export.export_run` writes, `formats.read_trajectory` reads; what is written carries a ``provenance.json`` beside it.
"""
