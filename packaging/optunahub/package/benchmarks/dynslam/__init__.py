"""Settings of visual SLAM in dynamic scenes as a problem of real runs, and EMFOA as a sampler."""

from .moth_flame_sampler import MothFlameSampler
from .problem import Problem

__all__ = ["MothFlameSampler", "Problem"]
