"""The conformance checks as tests of pytest: ``pytest --dynslam-tracker my_slam.py:SPEC``.

Every check of a subject becomes a test item of its name. The checks run while pytest collects,
because their names are known only then; those of a tracker run in a child process. The entry point
``pytest11`` makes pytest load this module, so it imports nothing heavy before one of its options is
used.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import pytest

from dynslam_bench.core import DynslamError, PluginError, find_data_root

if TYPE_CHECKING:
    from dynslam_bench.testing.report import Check, ConformanceReport

OPTIONS = {
    "tracker": "a tracker: id, module:Attr or file.py:Attr of a TrackerSpec; runs in a process of its own",
    "segmenter": "a segmenter: id, module:Attr or file.py:Attr of a SegmenterSpec",
    "flow": "an optical flow: id, module:Attr or file.py:Attr of a FlowSpec",
    "features": "a feature extractor: id, module:Attr or file.py:Attr of a FeatureSpec",
    "filter": "a dynamic filter: module:Attr or file.py:Attr of a class or function that constructs it",
    "sequence": "a sequence: id, folder, or module:Attr or file.py:Attr of a DatasetSpec (the first that it lists)",
}
"""Plug-ins that can be checked: the end of the option's name, and its help."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add an option for each kind of plug-in."""
    group = parser.getgroup("dynslam-bench", "conformance checks of dynslam-bench")
    for kind, meaning in OPTIONS.items():
        group.addoption(
            f"--dynslam-{kind}",
            action="append",
            default=[],
            metavar="NAME",
            help=f"check {meaning}",
        )


def pytest_collection_modifyitems(
    session: pytest.Session, config: pytest.Config, items: list[pytest.Item]
) -> None:
    """Run the checks of every subject that was asked for, and add an item for each."""
    for kind in OPTIONS:
        for subject in config.getoption(f"--dynslam-{kind}"):
            try:
                checks = report_on(kind, subject).checks
            except DynslamError as error:
                raise pytest.UsageError(f"--dynslam-{kind}: {error}") from error
            for check in checks:
                items.append(
                    ConformanceItem.from_parent(
                        session, name=f"{kind} {subject}::{check.name}", check=check
                    )
                )


class ConformanceItem(pytest.Item):
    """One check."""

    def __init__(self, *, check: Check, **rest: Any) -> None:
        super().__init__(**rest)
        self.check = check

    def runtest(self) -> None:
        """Pass, fail or skip as the check did."""
        if self.check.status == "skipped":
            pytest.skip(self.check.message)
        if self.check.status == "failed":
            pytest.fail(self.check.message, pytrace=False)

    def reportinfo(self) -> tuple[str, None, str]:
        """Location of the item, for pytest's output."""
        return "dynslam-bench", None, f"check of {self.name}"


def report_on(kind: str, subject: str) -> ConformanceReport:
    """Run the checks of a subject.

    Args:
        kind: One of `OPTIONS`.
        subject: Its name.

    Raises:
        DynslamError: There is no such subject.
    """
    from dynslam_bench import testing
    from dynslam_bench.core.plugins import load_object

    if kind == "tracker":
        return testing.isolated_tracker_report(subject)
    if kind == "sequence":
        return testing.sequence_report(_open(subject))
    if kind == "filter":
        return testing.filter_report(load_object(subject))
    if kind == "segmenter":
        from dynslam_bench.segmentation.build_segmenter import SEGMENTERS, build_segmenter
        from dynslam_bench.segmentation.settings import SegmentationSettings

        SEGMENTERS.get(subject)  # an unknown name is an error, not a failed check
        scene = testing.CornerSequence(2)
        masks = SegmentationSettings(source=f"plugin:{subject}")
        build: Any = partial(build_segmenter, masks, sequence_id=scene.id, masks=scene.masks)
        return testing.segmenter_report(build, sequence=scene)
    if kind == "flow":
        from dynslam_bench.flow.registry import FLOWS, build_flow
        from dynslam_bench.flow.settings import FlowSettings

        FLOWS.get(subject)
        return testing.flow_report(partial(build_flow, FlowSettings(plugin=subject)))
    from dynslam_bench.features.registry import FEATURES, build_extractor
    from dynslam_bench.features.settings import FeatureSettings

    spec = FEATURES.get(subject)
    return testing.features_report(
        partial(build_extractor, FeatureSettings(extractor=subject)),
        descriptor_bytes=spec.descriptor_bytes,
    )


def _open(subject: str) -> Any:
    """A sequence by its name, or the first one of a `DatasetSpec`."""
    from dynslam_bench.core.plugins import load_object
    from dynslam_bench.sequences import DATASETS

    head, _, attribute = subject.rpartition(":")
    if not attribute.isidentifier() or not (
        head.endswith(".py") or head.replace(".", "").isidentifier()
    ):
        return subject
    spec = DATASETS.get(subject)
    if not spec.sequences:
        raise PluginError(
            f"the data set '{spec.id}' lists no sequence", "name one in DatasetSpec.sequences"
        )
    return load_object(spec.entry_point)(spec.sequences[0], data_root=find_data_root())
