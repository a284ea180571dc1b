"""Moth-flame optimisation and EMFOA."""

from slam_hpo.moth_flame_sampler import MothFlameSampler

__all__ = ["MothFlameSampler"]
