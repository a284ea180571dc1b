"""The map that a run begins in, looked up before anything runs."""

from __future__ import annotations

from pathlib import Path

from dynslam_bench.core.errors import RunError, SettingsError
from dynslam_bench.core.fingerprint import named_digests
from dynslam_bench.core.settings import Settings
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam.mapping.saved_map import MapFeatures, Sensors, read_map
from dynslam_bench.slam.settings import BackendSettings

from .spec import MAP_SETTING
from .storage.record import StartMap


def check_unchanged(start_map: StartMap | None, settings: Settings) -> None:
    """A run began in the map that was looked up for it, and in no other at its path.

    Raises:
        RunError: The file has changed since.
        PluginError: It is gone.
    """
    if start_map is not None and named_digests(settings)[MAP_SETTING] != start_map.digest:
        raise RunError(f"the map {start_map.file} has changed since the run was asked for", "the run is not stored")


def start_map_of(settings: Settings, camera: Camera, sensors: Sensors, digests: dict[str, str]) -> StartMap | None:
    """The map that settings name; None where they name none.

    Args:
        settings: A tracker's complete settings.
        camera: Of the sequence, as the tracker sees it.
        sensors: Of the tracker.
        digests: Of the files that the settings name, by the setting's name.

    Raises:
        SettingsError: The tracker has features of its own; the file is no map, or one of another camera, other features
            or another sensor.
    """
    backend, features = getattr(settings, "backend", None), getattr(settings, "features", None)
    if not isinstance(backend, BackendSettings) or not backend.map.file:
        return None
    if not isinstance(features, FeatureSettings):
        raise SettingsError(f"'{MAP_SETTING}' is set, and the tracker's features are none that maps are made of")
    path = Path(backend.map.file).expanduser()
    saved = read_map(path)
    made_of = MapFeatures(extractor=features.extractor, levels=features.levels, scale_factor=features.scale_factor)
    saved.check(camera, made_of, sensors, str(path))
    return StartMap(
        digest=digests[MAP_SETTING],
        file=str(path),
        made_by=saved.header.made_by,
        keyframes=len(saved.arrays["kf_id"]),
        points=len(saved.arrays["id"]),
        localisation_only=backend.map.localisation_only,
    )
