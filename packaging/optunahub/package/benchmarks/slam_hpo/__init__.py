"""SLAM-HPO: tune a visual SLAM system in dynamic scenes."""

from slam_hpo.problem import Problem

__all__ = ["Problem"]
