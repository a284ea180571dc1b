"""Libraries that a run computes with: versions of what lies under a module's name on the import path."""

import os
import sys
from pathlib import Path

from dynslam_bench.core.code_files import files_below
from dynslam_bench.core.fingerprint import contents_digest
from dynslam_bench.core.reads import BaseFolders, ImportPath, search_now

SEARCH_VARIABLES = ("LD_LIBRARY_PATH", "LD_PRELOAD", "DYLD_LIBRARY_PATH", "DYLD_INSERT_LIBRARIES")
"""Variables of the linker: with others the same module may run other code."""


def library_identity(module: str, imports: ImportPath | None = None) -> str:
    """Version and files of the distribution that a module is imported from, or the digest of the files alone.

    A module that lies before the installed one on the import path hides it, and is the one that counts.

    Args:
        module: A top-level module; it is not imported.
        imports: Where it is looked up; for several modules pass one, which reads each folder once.
            None for this process's import path as it is now.

    Returns:
        For example ``2.1.0 0a1b2c3d4e5f``; empty where there is no such module.
    """
    if imports is None:
        imports = ImportPath(sys.path)
    place = imports.find(module)
    if not place:
        return ""
    distributions = imports.distributions_of(module, place)
    if distributions:
        return ", ".join(imports.distribution(name) for name in distributions)
    # no distribution brings it: a file or folder on the import path
    path = Path(place)
    files = [path] if path.is_file() else list(files_below(path))
    return f"files {contents_digest(files, path.parent)[:12]}"


def search_path() -> dict[str, str]:
    """The folders or libraries that each variable of the linker names; variables that are not set are left out."""
    base_folders = BaseFolders(plugin=None, work=Path.cwd())
    folders_by_name = {
        name: search_now(name, os.environ, base_folders) for name in SEARCH_VARIABLES
    }
    return {name: folders for name, folders in folders_by_name.items() if folders}
