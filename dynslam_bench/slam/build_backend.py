"""The back end that settings ask for: with depth or without."""

from __future__ import annotations

from .backend import RgbdBackend
from .monocular import MonocularBackend
from .monocular_settings import MonocularBackendSettings
from .settings import BackendSettings


def build_backend(settings: BackendSettings, scale_factor: float, levels: int, extractor: str) -> RgbdBackend:
    """A back end.

    Args:
        settings: `MonocularBackendSettings` for one without depth.
        scale_factor: Ratio of consecutive pyramid levels of the features that will come.
        levels: Number of pyramid levels of the features that will come.
        extractor: Who finds them.
    """
    if isinstance(settings, MonocularBackendSettings):
        return MonocularBackend(settings, scale_factor=scale_factor, levels=levels, extractor=extractor)
    return RgbdBackend(settings, scale_factor=scale_factor, levels=levels, extractor=extractor)
