"""Report on what is installed here and what is missing: packages, extras, weights, sequences, folders, plug-ins."""

import platform
import re
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from dynslam_bench.core import find_data_root, is_writable, stage_cache_folder, weights_folder
from dynslam_bench.core.version import install_hint, version
from dynslam_bench.segmentation.networks.checkpoints import (
    CHECKPOINTS,
    cached_checkpoint,
    embedded_weights,
)
from dynslam_bench.sequences.catalogue import summaries

DISTRIBUTION = "dynslam-bench"
FOR_DEVELOPERS = ("test", "lint")
"""Extras that a user does not miss."""


@dataclass(frozen=True)
class Finding:
    """One thing that was examined.

    Attributes:
        part: ``program``, ``package``, ``extra``, ``weights``, ``sequences``, ``folder``,
            ``plug-in`` or ``device``.
        name: Name of the thing.
        state: Its version, place or fault.
        missing: Whether it is not there; what works without it is no fault.
        hint: How to get what is missing.
    """

    part: str
    name: str
    state: str
    missing: bool = False
    hint: str = ""


def examine() -> list[Finding]:
    """Everything that decides what can be run on this machine; nothing is downloaded for it."""
    system = f"{platform.system()} {platform.machine()}"
    program = f"{version()}, Python {platform.python_version()}, {system}"
    return [
        Finding("program", DISTRIBUTION, program),
        *_packages(),
        *_weights(),
        _recordings(),
        _folder("stage cache", stage_cache_folder()),
        _folder("weights", weights_folder()),
        *unavailable_plugins(),
        _torch_device(),
    ]


def _recordings() -> Finding:
    """Number of recorded sequences."""
    here = [summary["id"] for summary in summaries() if summary["here"]]
    count = sum(not name.startswith("synthetic/") for name in here)
    state = f"{count} in {find_data_root()}"
    if count:
        return Finding("sequences", "recorded", state)
    hint = "rendered ones need no download; dynslam-bench sequences list, sequences fetch ID"
    return Finding("sequences", "recorded", state, True, hint)


def _folder(name: str, folder: Path) -> Finding:
    """Whether a folder of the user's cache can be written."""
    if is_writable(folder):
        return Finding("folder", name, f"{folder}, writable")
    hint = "another one: see core/folders.py"
    return Finding("folder", name, f"{folder}, not writable", True, hint)


def _packages() -> list[Finding]:
    """The packages that this distribution asks for, those of an extra as one."""
    try:
        required = metadata.requires(DISTRIBUTION) or []
    except metadata.PackageNotFoundError:
        return [
            Finding("package", DISTRIBUTION, "not installed", True, "pip install . in the checkout")
        ]
    # names of packages by extra, '' for those that are always needed
    extras: dict[str, list[str]] = {}
    for requirement in required:
        match = re.match(r"([\w.-]+)[^;]*(?:$|;.*extra\s*==\s*['\"]([\w-]+)['\"])", requirement)
        if match:
            extras.setdefault(match[2] or "", []).append(match[1])
    packages = [
        _package("package", name, [name], "pip install --force-reinstall .")
        for name in extras.pop("")
    ]
    return packages + [
        _package("extra", extra, names, install_hint(extra))
        for extra, names in sorted(extras.items())
        if extra not in FOR_DEVELOPERS
    ]


def _package(part: str, title: str, names: list[str], hint: str) -> Finding:
    """The versions of packages that go together, or the first of them that is missing."""
    versions = []
    for name in names:
        try:
            version_of = metadata.version(name)
        except metadata.PackageNotFoundError:
            return Finding(part, title, f"{name} is not installed", True, hint)
        versions.append(version_of if name == title else f"{name} {version_of}")
    return Finding(part, title, ", ".join(versions))


def _weights() -> list[Finding]:
    """The weights of the networks for masks: those of the package, and those that are fetched."""
    findings = []
    if embedded_weights().is_file():
        findings.append(Finding("weights", "embedded", "in the package, for rendered people"))
    else:
        findings.append(Finding("weights", "embedded", "missing", True, "reinstall"))
    for checkpoint in CHECKPOINTS.values():
        path = cached_checkpoint(checkpoint)
        if path:
            findings.append(Finding("weights", checkpoint.id, str(path)))
        else:
            size = f"{checkpoint.megabytes:g} MB, {checkpoint.license}, fetched when first used"
            hint = f"{size}, or put {checkpoint.url} at {weights_folder() / checkpoint.file}"
            findings.append(Finding("weights", checkpoint.id, "not here", True, hint))
    return findings


def _torch_device() -> Finding:
    """Find the device that ``--device auto`` takes; loads torch, which takes a second or two."""
    import torch

    device = f"cpu, {torch.get_num_threads()} processor threads"
    if torch.cuda.is_available():
        device = f"cuda:0, {torch.cuda.get_device_name(0)}"
    return Finding("device", "auto", f"{device}, torch {torch.__version__}")


def unavailable_plugins() -> list[Finding]:
    """All plug-ins of all kinds that failed to load, and trackers that lack a package."""
    from dynslam_bench.features.registry import FEATURES
    from dynslam_bench.flow.registry import FLOWS
    from dynslam_bench.segmentation.build_segmenter import SEGMENTERS
    from dynslam_bench.sequences import DATASETS
    from dynslam_bench.trackers import TRACKERS

    failed = [
        (f"{registry.kind}: {failure.source}", failure.reason)
        for registry in (TRACKERS, SEGMENTERS, FEATURES, FLOWS, DATASETS)
        for failure in registry.failures()
    ]
    for tracker in TRACKERS.all():
        spec = tracker.spec
        failed += [(f"trackers: {spec.id}", f"needs {hint}") for hint in spec.missing()]
    return [Finding("plug-in", name, "missing", True, reason) for name, reason in failed]
