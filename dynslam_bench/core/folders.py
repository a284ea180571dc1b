"""Where sequences lie: an argument, else the environment, else the user's cache folder."""

from __future__ import annotations

import os
import sys
from pathlib import Path

ENVIRONMENT_VARIABLE = "DYNSLAM_BENCH_DATA"


def user_cache() -> Path:
    """The user's cache folder of this package: ``XDG_CACHE_HOME``, ``~/Library/Caches`` on macOS, else ``~/.cache``."""
    base = os.environ.get("XDG_CACHE_HOME")
    if base:
        return Path(base).expanduser() / "dynslam-bench"
    home = Path.home()
    return (home / "Library" / "Caches" if sys.platform == "darwin" else home / ".cache") / "dynslam-bench"


def find_data_root(argument: str | Path | None = None) -> Path:
    """The folder that holds the sequences; it need not exist yet.

    Args:
        argument: What the user named (``--data-root``); it wins over ``DYNSLAM_BENCH_DATA``, which wins over the cache.
    """
    if argument is not None:
        return Path(argument).expanduser().absolute()
    configured = os.environ.get(ENVIRONMENT_VARIABLE)
    if configured:
        return Path(configured).expanduser().absolute()
    return user_cache() / "data"


def is_writable(folder: Path) -> bool:
    """Whether files can be made in a folder, or in the nearest folder above it that exists."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK)
