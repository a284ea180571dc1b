"""Whether a stored run is what would be computed here: by the code, libraries and files that are installed now."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from dynslam_bench.core import DynslamError
from dynslam_bench.core.fingerprint import named_digest
from dynslam_bench.core.libraries import library_identity
from dynslam_bench.core.reads import BaseFolders, Reads, Verifier
from dynslam_bench.runs.identity import libraries, source_digests
from dynslam_bench.runs.own_code import is_file, is_outside_package, module_of
from dynslam_bench.runs.record import PROGRAM, RunRecord, TrackerInfo
from dynslam_bench.segmentation.build_segmenter import weights_digest
from dynslam_bench.segmentation.networks.checkpoints import CHECKPOINTS
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.trackers.registry import TRACKERS

NOT_RECORDED = "its record does not say what it was made by"
_NETWORKS = ("embedded", *CHECKPOINTS)
"""Weights that no setting names, see `build_segmenter.weights_digest`."""


class Installation:
    """The installed programs; each thing is looked at once, however many runs are compared with it.

    No plug-in is imported. A run's data are no part of the comparison: runs on other data are other
    columns of a table.
    """

    def __init__(self) -> None:
        self._verifier = Verifier()
        self._libraries: dict[str, str] | None = None
        self._answers: dict[str, str] = {}

    def what_changed(self, record: RunRecord) -> str:
        """Name what differs between a run's program and the installed one, in a few words; empty where nothing does.

        Imported trajectories have no program that could change.
        """
        if record.kind == "imported":
            return ""
        if not record.verified:
            return NOT_RECORDED
        program = {name: record.identity[name] for name in PROGRAM if name in record.identity}
        named = {name: record.settings.get(name) for name in _table(program.get("weights"))}
        question = json.dumps([program, named, record.tracker.folder], sort_keys=True, default=str)
        if question not in self._answers:
            self._answers[question] = self._compare(
                program, named, self._plugin_folder(record.tracker)
            )
        return self._answers[question]

    @staticmethod
    def _plugin_folder(tracker: TrackerInfo) -> Path | None:
        """The folder of a tracker's file: where the record has it, or, in a record of others, as it is listed here."""
        if tracker.folder:
            return Path(tracker.folder)
        target = TRACKERS.target_of(tracker.id)
        if target is None or not is_file(target):
            return None
        return Path(module_of(target)).absolute().parent

    def _compare(
        self, program: Mapping[str, Any], named: Mapping[str, Any], plugin: Path | None
    ) -> str:
        """The first part of a program that differs here.

        Args:
            program: The entries `PROGRAM` of a run's identity.
            named: The values of the settings that name its weights; None for a network that no
                setting names.
            plugin: The folder of its plug-in's file.
        """
        # what the run recorded of its program
        parts = program.get("parts")
        if not isinstance(parts, list) or not isinstance(program.get("source"), dict):
            return NOT_RECORDED
        parts = [str(part) for part in parts]

        # this package's code
        code = _difference(program["source"], source_digests(parts))
        if code is not None:
            return f"the code of {module_of(code)}"

        # libraries that every run computes with
        if self._libraries is None:
            self._libraries = libraries()
        library = _difference(program.get("libraries"), self._libraries)
        if library is not None:
            return library

        # packages that the tracker needs
        required = _table(program.get("requires"))
        package = _difference(required, {module: _package_now(module) for module in required})
        if package is not None:
            return f"the package {package}"

        # weights of its networks
        weights = _table(program.get("weights"))
        file = _difference(weights, {name: _weights_now(name, named[name]) for name in weights})
        if file is not None:
            return f"the weights of {file}"

        # files of plug-ins and programs
        runs_foreign_code = "files" in program or any(map(is_outside_package, parts))
        return self._what_was_read(program, plugin) if runs_foreign_code else ""

    def _what_was_read(self, program: Mapping[str, Any], plugin: Path | None) -> str:
        """Name what has changed of all that plug-ins and programs read."""
        try:
            reads = Reads.model_validate(program.get("reads"))
        except ValidationError:
            return NOT_RECORDED
        return self._verifier.changed(reads, BaseFolders(plugin=plugin, work=Path.cwd()))


def _difference(before: object, now: Mapping[str, str]) -> str | None:
    """The first name under which two tables hold different values; None where they are equal."""
    table = _table(before)
    return next((name for name in {**table, **now} if table.get(name) != now.get(name)), None)


def _table(value: object) -> dict[str, Any]:
    """An entry of an identity that should be a table; an empty one where it is something else."""
    return value if isinstance(value, dict) else {}


def _package_now(module: str) -> str:
    """The identity of an installed library; empty for what is no top-level module.

    Any other module could not be looked up without an import.
    """
    return library_identity(module) if module.isidentifier() else ""


def _weights_now(name: str, value: object) -> str:
    """The digest of a network's file as it is here; empty where it is not here or cannot be read.

    Args:
        name: A network, or the setting that names the file.
        value: The setting's value; None for a network.
    """
    try:
        if name in _NETWORKS:
            return weights_digest(SegmentationSettings.model_validate({"source": name}))
        return named_digest(name, value) if isinstance(value, str) else ""
    except DynslamError:
        return ""
