"""Origin of a piece of code: this package, Python, a library, or foreign."""

import os
import sys
import sysconfig
from collections.abc import Collection, Iterator
from pathlib import Path
from types import FrameType
from typing import Literal

import dynslam_bench

Origin = Literal["own", "python", "library", "foreign"]
"""This package's, Python's, a library's, or a plug-in's and all other code."""
_SITE_FOLDERS = (f"{os.sep}site-packages{os.sep}", f"{os.sep}dist-packages{os.sep}")


class Origins:
    """Tells by their files whose modules and functions are.

    Libraries are what is installed, and what has been imported when this is made: this package uses
    it.

    Args:
        plugin: The folder of a plug-in's file: foreign.
        modules: Top-level names of installed plug-ins: foreign.
    """

    def __init__(self, plugin: Path | None, modules: Collection[str]) -> None:
        self._plugin = () if plugin is None else _folders([str(plugin)])
        self._modules = frozenset(modules)
        self._own = _folders(_own_folders())
        self._python = _folders(
            [*map(sysconfig.get_path, ("stdlib", "platstdlib")), os.path.dirname(os.__file__)]
        )
        self._imported: tuple[str, ...] = ()
        self._of_file: dict[str, Origin] = {}
        self._of_code: dict[str, Origin] = {}
        # what is imported already and nobody else's is a library's
        imported = [place for place in _imported_places() if self.of_file(place) == "foreign"]
        self._imported = (*_folders(imported), *imported)
        self._of_file.clear()

    def of_frame(self, frame: FrameType) -> Origin:
        """Origin of the function that runs in a frame; code without a file is Python's: its caller tells."""
        file = frame.f_code.co_filename
        origin = self._of_code.get(file)
        if origin is None:
            module = str(frame.f_globals.get("__name__", ""))
            origin = "foreign" if self.is_plugin(module) else self.of_file(file)
            self._of_code[file] = origin
        return origin

    def is_plugin(self, module: str) -> bool:
        """Whether a module belongs to an installed plug-in."""
        return module.partition(".")[0] in self._modules

    def of_file(self, file: str) -> Origin:
        """Origin of a file."""
        origin = self._of_file.get(file)
        if origin is None:
            origin = self._of_file[file] = self._look(file)
        return origin

    def _look(self, file: str) -> Origin:
        """Origin of a file, by the folders that it lies in."""
        if file.startswith("<"):  # frozen, or made from a text
            return "python"
        if file.startswith(self._own):
            return "own"
        for folder in self._plugin:
            if not file.startswith(folder):
                continue
            # an environment with libraries may lie in the plug-in's folder
            inside = file[len(folder) - 1 :]
            if not any(site in inside for site in _SITE_FOLDERS):
                return "foreign"
        if any(site in file for site in _SITE_FOLDERS) or file.startswith(self._imported):
            return "library"
        return "python" if file.startswith(self._python) else "foreign"


def _own_folders() -> Iterator[str]:
    """The folders with this package's modules; in a checkout some lie beside the package."""
    for place in map(Path, dynslam_bench.__path__):
        if place.name == "dynslam_bench":
            yield str(place)
        else:
            yield from (str(folder.parent) for folder in place.glob("*/__init__.py"))


def _imported_places() -> Iterator[str]:
    """The folder of each loaded top-level package, and the file of each loaded top-level module."""
    for name, module in list(sys.modules.items()):
        file = vars(module).get("__file__") if hasattr(module, "__dict__") else None
        if isinstance(file, str) and "." not in name and name != "__main__":
            yield os.path.dirname(file) if "__path__" in vars(module) else file


def _folders(places: list[str] | Iterator[str]) -> tuple[str, ...]:
    """Beginnings of the paths of what lies in folders, as they are written and with their links followed."""
    spellings = [
        spelling
        for place in places
        for spelling in (os.path.abspath(place), os.path.realpath(place))
    ]
    return tuple(f"{spelling}{os.sep}" for spelling in dict.fromkeys(spellings))
