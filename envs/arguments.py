"""What an environment's arguments may be, as far as nothing has to be looked up for it."""

from __future__ import annotations

from dynslam_bench.core.errors import SettingsError

RENDER_MODES = ("rgb_array",)


def check_arguments(render_mode: str | None, observation: str, lost_after: int | None, threads: int) -> None:
    """Refuse what no environment can be made with.

    Raises:
        SettingsError: Names the first such argument and its value.
    """
    if render_mode not in (None, *RENDER_MODES):
        raise SettingsError(f"unknown render mode '{render_mode}'", "known: " + ", ".join(RENDER_MODES))
    if observation not in ("stats", "rgbd"):
        raise SettingsError(f"unknown observation '{observation}'", "known: stats, rgbd")
    if lost_after is not None and lost_after < 1:
        raise SettingsError(f"lost_after is {lost_after}", "give a number of frames >= 1, or None")
    if threads < 1:
        raise SettingsError(f"threads is {threads}", "give a number >= 1")
