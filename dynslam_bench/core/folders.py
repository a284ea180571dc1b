"""Every folder outside the working directory that this package reads or writes, and the variable that moves it.

Below the user's cache folder lie ``data/`` (sequences), ``stages/`` (the stage cache), ``digests/``
(digests of file contents, see `core.fingerprint`), ``kernels/`` (compiled kernels, see
`core.kernel_cache`), ``weights/`` (downloaded checkpoints) and ``vocabularies/`` (decompressed ORB
vocabularies).
"""

import os
import sys
from pathlib import Path

DATA_VARIABLE = "DYNSLAM_BENCH_DATA"
"""Names the folder of sequences."""
STAGES_VARIABLE = "DYNSLAM_BENCH_CACHE"
"""Names the folder that holds the stage cache, remembered digests and compiled kernels."""
WEIGHTS_VARIABLE = "DYNSLAM_BENCH_WEIGHTS"
"""Names the folder of downloaded weights."""
KERNEL_SUFFIX = ".kernel"
"""Ending of the names of compiled kernels."""


def user_cache() -> Path:
    """The user's cache folder of this package: ``XDG_CACHE_HOME``, ``~/Library/Caches`` on macOS, else ``~/.cache``.

    Raises:
        RuntimeError: The user has no home folder.
    """
    base = os.environ.get("XDG_CACHE_HOME")
    if base:
        return Path(base).expanduser() / "dynslam-bench"
    caches = "Library/Caches" if sys.platform == "darwin" else ".cache"
    return Path.home() / caches / "dynslam-bench"


def find_data_root(argument: str | Path | None = None) -> Path:
    """The folder that holds the sequences; it need not exist yet.

    Args:
        argument: What the user named (``--data-root``); it wins over ``DYNSLAM_BENCH_DATA``, which
            wins over the cache.
    """
    if argument is not None:
        return Path(argument).expanduser().absolute()
    return _folder_in(DATA_VARIABLE, user_cache() / "data").absolute()


def stage_cache_folder() -> Path:
    """The folder of the stage cache: ``stages/`` in ``DYNSLAM_BENCH_CACHE``, else in the user's cache folder."""
    return _folder_in(STAGES_VARIABLE, user_cache()) / "stages"


def digest_cache_folder() -> Path:
    """The folder of remembered digests: ``digests/`` in ``DYNSLAM_BENCH_CACHE``, else in the user's cache folder."""
    return _folder_in(STAGES_VARIABLE, user_cache()) / "digests"


def kernels_folder() -> Path:
    """The folder of compiled kernels: ``kernels/`` in ``DYNSLAM_BENCH_CACHE``, else in the user's cache folder."""
    return _folder_in(STAGES_VARIABLE, user_cache()) / "kernels"


def kernel_files() -> list[Path]:
    """The files of compiled kernels, see `core.kernel_cache`; none for a user without a home folder."""
    try:
        return sorted(kernels_folder().glob(f"*{KERNEL_SUFFIX}"))
    except RuntimeError:
        return []


def weights_folder() -> Path:
    """The folder of downloaded weights: ``DYNSLAM_BENCH_WEIGHTS``, else in the user's cache folder."""
    return _folder_in(WEIGHTS_VARIABLE, user_cache() / "weights")


def vocabularies_folder() -> Path:
    """The folder of decompressed ORB vocabularies, in the user's cache folder."""
    return user_cache() / "vocabularies"


def _folder_in(variable: str, otherwise: Path) -> Path:
    """The folder that an environment variable names; another one where it is not set."""
    value = os.environ.get(variable)
    return Path(value).expanduser() if value else otherwise


def is_writable(folder: Path) -> bool:
    """Whether files can be made in a folder, or in the nearest folder above it that exists."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK)
