"""What is installed here and what is missing: packages, extras, weights, sequences, folders, plug-ins."""

import platform
import re
from dataclasses import dataclass
from importlib import metadata

from dynslam_bench.core import find_data_root, is_writable, stage_cache_folder, weights_folder
from dynslam_bench.core.version import install_hint, version
from dynslam_bench.segmentation.networks.checkpoints import (
    COCO,
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
        name: Which.
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
    findings = [
        Finding(
            "program", DISTRIBUTION, f"{version()}, Python {platform.python_version()}, {system}"
        )
    ]
    findings += [*_packages(), *_weights()]
    recorded = sum(
        summary["here"] and not summary["id"].startswith("synthetic/") for summary in summaries()
    )
    hint = (
        ""
        if recorded
        else "rendered ones need no download; dynslam-bench sequences list, sequences fetch ID"
    )
    findings.append(
        Finding("sequences", "recorded", f"{recorded} in {find_data_root()}", not recorded, hint)
    )
    for name, folder in (("stage cache", stage_cache_folder()), ("weights", weights_folder())):
        good = is_writable(folder)
        findings.append(
            Finding(
                "folder",
                name,
                f"{folder}, {'' if good else 'not '}writable",
                not good,
                "" if good else "another one: see core/folders.py",
            )
        )
    return [*findings, *unavailable_plugins(), _torch_device()]


def _packages() -> list[Finding]:
    """The packages that this distribution asks for, those of an extra as one."""
    try:
        required = metadata.requires(DISTRIBUTION) or []
    except metadata.PackageNotFoundError:
        return [
            Finding("package", DISTRIBUTION, "not installed", True, "pip install . in the checkout")
        ]
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
    parts = []
    for name in names:
        try:
            parts.append(
                metadata.version(name) if name == title else f"{name} {metadata.version(name)}"
            )
        except metadata.PackageNotFoundError:
            return Finding(part, title, f"{name} is not installed", True, hint)
    return Finding(part, title, ", ".join(parts))


def _weights() -> list[Finding]:
    coco = cached_checkpoint(COCO)
    where = (
        f"{COCO.megabytes} MB, fetched when first used, or put {COCO.url} into {weights_folder()}"
    )
    fetched = (
        Finding("weights", "coco", str(coco))
        if coco
        else Finding("weights", "coco", "not here", True, where)
    )
    if embedded_weights().is_file():
        return [Finding("weights", "embedded", "in the package, for rendered people"), fetched]
    return [Finding("weights", "embedded", "missing", True, "reinstall"), fetched]


def _torch_device() -> Finding:
    """Which device ``--device auto`` takes; loads torch, which takes a second or two."""
    import torch

    cuda = torch.cuda.is_available()
    name = torch.cuda.get_device_name(0) if cuda else f"{torch.get_num_threads()} processor threads"
    return Finding(
        "device", "auto", f"{'cuda:0' if cuda else 'cpu'}, {name}, torch {torch.__version__}"
    )


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
    specs = [tracker.spec for tracker in TRACKERS.all()]
    failed += [
        (f"trackers: {spec.id}", f"needs {hint}") for spec in specs for hint in spec.missing()
    ]
    return [Finding("plug-in", name, "missing", True, reason) for name, reason in failed]
