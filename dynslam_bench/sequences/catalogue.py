"""Every sequence by its id: the public data sets, the rendered ones, plug-ins, and folders of the user's own."""

import fnmatch
import re
from collections.abc import Iterable, Iterator
from functools import cache
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal, cast

from pydantic import Field

from dynslam_bench.contracts import DatasetSpec, Sequence
from dynslam_bench.core import (
    SequenceError,
    did_you_mean,
    find_data_root,
    is_writable,
    read_toml,
    user_cache,
)
from dynslam_bench.core.plugins import Registry, described, load_object
from dynslam_bench.core.settings import Settings, build
from dynslam_bench.geometry import Camera
from dynslam_bench.sequences.cameras import (
    CAMERA_FILE,
    CAMERAS,
    camera_by_name,
    camera_of,
    chosen_camera,
)
from dynslam_bench.sequences.readers.files import NoRateError
from dynslam_bench.sequences.readers.layouts import (
    find_layout,
    is_bag,
    is_plain,
    layout_notes,
    layouts_of,
)
from dynslam_bench.sequences.settings import PreprocessingSettings
from dynslam_bench.sequences.synthetic import SYNTHETIC_IDS, open_synthetic, parse_synthetic_id
from dynslam_bench.sequences.tags import Tag
from dynslam_bench.sequences.view import SequenceView

Split = Literal["tune", "held-out", ""]
# Files of `published/`: a new TOML file there is named here.
_FILES = (
    "tum",
    "bonn",
    "wild_slam",
    "eth3d",
    "icl",
    "seven_scenes",
    "shibuya",
    "openloris",
)


class CatalogueEntry(Settings):
    """One public sequence.

    A number or checksum that is not known is None, never a guess.
    """

    id: str = Field(description="for example tum/fr3/walking_xyz")
    folder: str = Field(description="published folder name, an alias of the id")
    camera: str = Field(
        default="", description="name of the camera; empty where the folder or the layout states it"
    )
    layout: str = Field(
        default="tum", description="name of the layout, see dynslam_bench.sequences.readers.layouts"
    )
    url: str = Field(description="archive")
    verified: bool = Field(
        default=False, description="whether the publisher's own files were read with it"
    )
    more_urls: tuple[str, ...] = Field(
        default=(), description="further archives that belong to the same folder"
    )
    by_hand: str = Field(
        default="", description="why this program cannot fetch it; empty where it can"
    )
    distinctive: bool = Field(
        default=True, description="whether the folder's name alone identifies the sequence"
    )
    title: str = Field(description="name of the data set")
    page: str = Field(default="", description="web page of the data set")
    size_bytes: int | None = Field(default=None, description="exact size of the archive")
    size_stated: str = Field(default="", description="size as the data set's page states it")
    sha256: str | None = Field(
        default=None, pattern=r"^[0-9a-f]{64}$", description="checksum of the archive"
    )
    license: str = Field(description="licence of the data")
    citation: str = Field(description="what to cite")
    ground_truth: bool = Field(default=True, description="whether the ground truth is public")
    tags: tuple[Tag, ...] = Field(default=(), description="how much of the scene moves")
    split: Split = Field(default="", description="whether studies may tune on it")
    fps: float = Field(default=30.0, gt=0, description="nominal frame rate in Hz")
    remark: str = Field(default="", description="anything else worth knowing")

    @property
    def dataset(self) -> str:
        """First part of the id, ``tum`` for example."""
        return self.id.partition("/")[0]

    def folders(self, data_root: Path) -> tuple[Path, ...]:
        """Folders below a data root where the sequence may lie, the place `fetch` puts it first."""
        inside = data_root / self.dataset
        if not self.distinctive:
            return inside / self.folder, data_root / self.id
        places = (inside / self.folder, data_root / self.folder, data_root / self.id)
        if data_root.name == self.dataset:
            return (*places, data_root / self.folder.removeprefix("rgbd_"))
        return places

    def find(self, data_root: Path) -> Path | None:
        """The folder in which the sequence lies, None if it does not."""
        for folder in self.folders(data_root):
            if layouts_of(folder, self.layout) or is_plain(folder):
                return folder
        return None

    def how_to_get(self) -> str:
        """Tell how to get the sequence, for the end of a message."""
        if self.by_hand:
            return f"get it by hand from {self.page} ({self.by_hand}) and put it there"
        return f"fetch it with: dynslam-bench sequences fetch {self.id}"

    def size_text(self) -> str:
        """The archive's size for people."""
        if self.size_bytes is not None:
            return f"{self.size_bytes / 1e9:.2f} GB"
        return self.size_stated or "size unknown"


@cache
def catalogue() -> dict[str, CatalogueEntry]:
    """All public sequences by id, in the order of the data files."""
    entries = {}
    for name in _FILES:
        document = read_toml(Path(__file__).parent / "published" / f"{name}.toml")
        for row in document["sequence"]:
            entries[row["id"]] = build(CatalogueEntry, {**document["common"], **row})
    return entries


def entry_of(name: str) -> CatalogueEntry | None:
    """The catalogue's entry of an id or published folder name, None if there is none."""
    return catalogue().get(name) or by_folder().get(name)


@cache
def by_folder() -> dict[str, CatalogueEntry]:
    """The public sequences whose published folder name is like no other, by that name."""
    return {entry.folder: entry for entry in catalogue().values() if entry.distinctive}


def sequence_ids() -> list[str]:
    """Ids of all listed sequences: the public ones, the rendered ones, and those of plug-ins; imports none."""
    ids = [name for dataset in DATASETS.builtin().values() for name in dataset.sequences]
    for listed in DATASETS.listed():
        ids += described(listed.target).get("sequences", [])
    return list(dict.fromkeys(ids))


def open_sequence(
    name: str | Path,
    *,
    data_root: str | Path | None = None,
    camera: str | Path | Camera | None = None,
    frames: tuple[int, int | None] | str | None = None,
    stride: int = 1,
    preprocessing: PreprocessingSettings | None = None,
) -> Sequence:
    """Open a sequence.

    Args:
        name: An id (``tum/fr3/walking_xyz``, ``bonn/crowd``,
            ``synthetic/walking_xyz?scene=0&frames=150``), a published folder name
            (``rgbd_dataset_freiburg3_walking_xyz``) or the path of a folder of a layout that is
            read.
        data_root: Folder of the sequences; default ``DYNSLAM_BENCH_DATA``, else the user's cache
            folder.
        camera: In place of what the catalogue or the folder says: ``tum-fr1``, ``tum-fr2``,
            ``tum-fr3``, ``bonn`` or a ``camera.toml``.
        frames: Part of the sequence, ``(first, one past the last or None)`` or ``"A:B"``.
        stride: Take every `stride`-th frame of that part.
        preprocessing: What to do with the frames; nothing by default.

    Returns:
        The sequence; nothing but its first frame was decoded.

    Raises:
        SequenceError: Unknown id (with a did-you-mean), not on this machine (with URL, size, path
            and the command that fetches it), damaged, or no frame in the part asked for.
    """
    # open all frames of the sequence
    settings = preprocessing or PreprocessingSettings()
    root = find_data_root(data_root)
    sequence = _open_whole(str(name), root, camera, settings)

    # what is asked for of its images, and the part of it
    if settings.changes_images:
        from dynslam_bench.sequences.preprocessing import Preprocessed

        sequence = cast("Sequence", Preprocessed(sequence, settings))
    start, stop = parse_frames(frames)
    if (start, stop, stride) == (0, None, 1):
        return sequence
    return cast("Sequence", SequenceView(sequence, start, stop, stride))


def open_public(sequence_id: str, *, data_root: Path, **how: Any) -> Sequence:
    """Open a sequence of the catalogue.

    Args:
        sequence_id: Its id.
        data_root: Folder of the sequences.
        **how: See `open_folder`.

    Raises:
        SequenceError: Unknown id, or it is not below the data root.
    """
    entry = entry_of(sequence_id)
    if entry is None:
        raise SequenceError(
            f"unknown sequence '{sequence_id}'", did_you_mean(sequence_id, sequence_ids())
        )
    folder = entry.find(data_root)
    if folder is None:
        raise SequenceError(
            f"sequence '{entry.id}' ({entry.size_text()}, {entry.url}) is not at {entry.folders(data_root)[0]}",
            entry.how_to_get(),
        )
    return open_folder(folder, entry=entry, **how)


def open_rendered(sequence_id: str, *, data_root: Path) -> Sequence:
    """Open a rendered sequence; its frames are kept below the data root, or in the user's cache if that is read-only.

    Args:
        sequence_id: For example ``synthetic/walking_xyz?scene=0&frames=150``.
        data_root: Folder of the sequences.

    Raises:
        SequenceError: Unknown id.
    """
    return open_synthetic(
        sequence_id, data_root if is_writable(data_root) else user_cache() / "data"
    )


def open_folder(
    folder: Path,
    *,
    entry: CatalogueEntry | None = None,
    camera: str | Path | Camera | None = None,
    settings: PreprocessingSettings | None = None,
) -> Sequence:
    """Open a folder of one of the layouts that are read (`LAYOUTS`).

    Args:
        folder: The folder.
        entry: What the catalogue says of it; looked up by the folder's name if not given.
        camera: In place of what the catalogue or the folder says.
        settings: Tolerance of the pairing, and whether images will be resized.

    Raises:
        SequenceError: It cannot be opened, or its camera is not known.
    """
    from dynslam_bench.sequences.readers.recorded import RecordedSequence

    settings = settings or PreprocessingSettings()
    entry = entry or entry_of(folder.resolve().name)

    # what the folder holds, by its layout, and the camera that was chosen or that it states
    catalogued = entry.layout if entry else ""
    layout = find_layout(folder, catalogued)
    chosen = chosen_camera(folder, camera)
    fps = (chosen.fps if chosen else None) or (entry.fps if entry else None)
    try:
        contents = layout.read(folder, fps)
    except NoRateError:
        # without a camera, too, one file states both: any rate reads the images that it is made from
        if chosen is None:
            camera_of(folder, layout.read(folder, 30.0), None, lacks_rate=True)
        raise
    notes = layout_notes(folder, layout, catalogued)
    if camera is not None and (folder / CAMERA_FILE).exists():
        notes = (*notes, f"{CAMERA_FILE} of the folder is not used: another camera was chosen")

    # what the catalogue says of it
    about: dict[str, Any] = {"id": f"folder/{folder.resolve().name}"}
    if entry is not None:
        about = {
            "id": entry.id,
            "license": entry.license,
            "citation": entry.citation,
            "tags": frozenset(entry.tags),
            "split": entry.split,
        }
    # what says the camera, in the order in which it is looked for
    named = entry.camera if entry else camera_by_name(folder)
    source = f"the folder's name ({named})" if contents.camera is None else "the folder's files"
    return RecordedSequence(
        folder,
        contents,
        camera_of(folder, contents, chosen, entry.camera if entry else ""),
        **about,
        fps=contents.fps or fps,
        notes=notes,
        layout=layout.name,
        camera_source=source if chosen is None else chosen.source,
        max_time_difference_s=settings.max_time_difference_s,
        any_depth_size=settings.width is not None,
    )


def _open_whole(
    name: str, data_root: Path, camera: str | Path | Camera | None, settings: PreprocessingSettings
) -> Sequence:
    """Open a sequence with all of its frames, by its id, its published folder name or its path."""
    # a name of the catalogue that is a folder here as well means the catalogue's, if that is there
    path = Path(name).expanduser()
    is_path = name.startswith((".", "/", "~", "\\"))
    entry = None if is_path else entry_of(name)
    if entry is not None and path.is_dir() and entry.find(data_root) is None:
        raise SequenceError(
            f"'{name}' names the sequence '{entry.id}', which is not at {entry.folders(data_root)[0]}",
            f"for the folder of that name here write ./{name}",
        )

    # one of the catalogue
    if entry is not None:
        return open_public(entry.id, data_root=data_root, camera=camera, settings=settings)

    # one of another data set, by the prefix of its id
    prefix, separator, _ = name.partition("/")
    public = {entry.dataset for entry in catalogue().values()}
    if separator and not is_path and prefix not in public:
        dataset = DATASETS.find(prefix)
        if dataset is not None and camera is not None:
            raise SequenceError(f"sequence '{name}' brings its own camera", "leave out --camera")
        if dataset is not None:
            return cast("Sequence", load_object(dataset.entry_point)(name, data_root=data_root))

    # the name is that of a folder, of a bag, or unknown
    if is_bag(path):
        raise SequenceError(
            f"{path} is a bag", f"unpack it first: dynslam-bench sequences unpack {path} FOLDER"
        )
    if path.is_dir():
        return open_folder(path, camera=camera, settings=settings)
    if is_path:
        raise SequenceError(
            f"there is no sequence folder {path.absolute()}",
            "a path names a folder, see docs/reference/sequences.md",
        )
    near = did_you_mean(name, [*sequence_ids(), *by_folder()])
    raise SequenceError(f"unknown sequence '{name}', and there is no such folder", near)


def parse_frames(frames: Iterable[int | None] | str | None) -> tuple[int, int | None]:
    """First frame and one past the last (None: to the end) of ``"A:B"``, ``"A:"``, ``":B"`` or a pair.

    Raises:
        SequenceError: It is no such range.
    """
    if frames is None:
        return 0, None
    # a pair is written as text, and read like it
    if not isinstance(frames, str):
        ends = frames if isinstance(frames, Iterable) else [frames]
        frames = ":".join("" if end is None else str(end) for end in ends)
    match = re.fullmatch(r"\s*([0-9]{0,12})\s*:\s*([0-9]{0,12})\s*", frames, re.ASCII)
    if match is None:
        raise SequenceError(f"'{frames}' is no range of frames", "write it as A:B, A: or :B")
    start = int(match[1] or 0)
    stop = int(match[2]) if match[2] else None
    if stop is not None and stop <= start:
        raise SequenceError(f"frames {frames} is no range of frames", "0 <= A < B")
    return start, stop


# Data sets as plug-ins: each serves the sequences below one prefix, ``tum/...`` for example.


def _builtin() -> Iterator[DatasetSpec]:
    """The data sets that come with the package."""
    for name, group in groupby(catalogue().values(), key=attrgetter("dataset")):
        first, *others = group
        ids = tuple(entry.id for entry in (first, *others))
        yield DatasetSpec(
            name, f"{__name__}:open_public", ids, first.title, first.license, first.citation
        )
    summary = "rendered scenes with exact poses, masks and flow"
    yield DatasetSpec(
        "synthetic", f"{__name__}:open_rendered", SYNTHETIC_IDS, summary, "CC0-1.0", "dynslam-bench"
    )


DATASETS: Registry[DatasetSpec] = Registry("sequences", DatasetSpec, _builtin)
"""Data sets by the prefix of their ids, built in and of plug-ins."""


# Lists and descriptions for people.


def summaries(*, data_root: str | Path | None = None) -> list[dict[str, Any]]:
    """All listed sequences, in the order of their data sets.

    Args:
        data_root: Folder of the sequences.

    Returns:
        One dictionary a sequence: its ``id``, whether it is ``here`` on this machine (rendered ones
        always are), the ``size`` of its archive for people, ``tags``, ``split``, whether its
        ``ground_truth`` is public, ``license``, ``url`` and the ``dataset``'s name. ``layout``
        says whether the reader was ``verified`` on the publisher's files or ``not verified``;
        ``by_hand`` why this program cannot fetch it; ``checksum`` whether that is known before
        it is fetched, None for what is rendered.
    """
    root = find_data_root(data_root)
    rows = []
    for spec in (dataset.spec for dataset in DATASETS.all()):
        for name in spec.sequences:
            row = _blank_summary(spec, name)
            entry = catalogue().get(name)
            if entry is not None:
                row |= _public_summary(entry, root)
            elif spec.id == "synthetic":
                parsed = parse_synthetic_id(name)
                row |= {"size": "rendered", "tags": (parsed.variant.tag,), "split": parsed.split}
            rows.append(row)
    return rows


def _blank_summary(spec: DatasetSpec, name: str) -> dict[str, Any]:
    """A row of `summaries` with its defaults: the sequence of a plug-in, which is taken to be on this machine."""
    return {
        "id": name,
        "here": True,
        "size": "",
        "tags": (),
        "split": "",
        "ground_truth": True,
        "license": spec.license,
        "url": "",
        "dataset": spec.summary or spec.id,
        "layout": "",
        "by_hand": "",
        "checksum": None,
    }


def _public_summary(entry: CatalogueEntry, data_root: Path) -> dict[str, Any]:
    """Row of a public sequence in the list of the catalogue."""
    stated = {"tags", "split", "ground_truth", "license", "url", "by_hand"}
    return entry.model_dump(include=stated) | {
        "here": entry.find(data_root) is not None,
        "size": entry.size_text(),
        "dataset": entry.title,
        "layout": "verified" if entry.verified else "not verified",
        "checksum": entry.sha256 is not None,
    }


def describe(
    name: str, *, data_root: str | Path | None = None, camera: str | Path | None = None
) -> dict[str, Any]:
    """Everything known of a sequence: the catalogue's entry, and what it holds if it is here.

    Args:
        name: Id, published folder name or path.
        data_root: Folder of the sequences.
        camera: In place of what the catalogue or the folder says.

    Raises:
        SequenceError: Unknown name, or it is here but damaged.
    """
    root = find_data_root(data_root)
    # what the catalogue says
    entry = entry_of(name)
    facts: dict[str, Any] = {}
    if entry is not None:
        facts = _public_facts(entry)
        if entry.find(root) is None:
            return facts | {"here": False, "fetch": entry.how_to_get()}

    # what is here
    sequence = open_sequence(name, data_root=data_root, camera=camera)
    truth = sequence.ground_truth
    folder = getattr(sequence, "folder", None)
    stamps = sequence.timestamps
    return facts | {
        "id": sequence.id,
        "here": True,
        "folder": None if folder is None else str(folder),
        "frames": len(sequence),
        "duration_s": round(float(stamps[-1] - stamps[0]), 3),
        "fps": round(sequence.fps, 3),
        "camera": repr(sequence.camera),
        "ground_truth_poses": 0 if truth is None else len(truth),
        "path_length_m": None if truth is None else round(truth.path_length_m, 3),
        "masks": "exact" if sequence.masks is not None else "none",
        "license": sequence.license,
        "citation": sequence.citation,
        "association": getattr(sequence, "dropped", None),
        "digest": sequence.digest(),
    }


def _public_facts(entry: CatalogueEntry) -> dict[str, Any]:
    """Facts that the catalogue holds on a public sequence, for people."""
    if entry.sha256:
        checksum = "known: another archive is refused"
    else:
        checksum = "not published: the first fetch takes it, every later one has to bring the same"
    verified = "verified" if entry.verified else "not verified"
    return {
        "id": entry.id,
        "alias": entry.folder,
        "url": entry.url,
        "page": entry.page,
        "size": entry.size_text(),
        "size_bytes": entry.size_bytes,
        "sha256": entry.sha256,
        "license": entry.license,
        "checksum": checksum,
        "citation": entry.citation,
        "tags": list(entry.tags),
        "split": entry.split,
        "ground_truth": "public" if entry.ground_truth else "not public",
        "camera": repr(CAMERAS.get(entry.camera, "as its files or its layout state")),
        "layout": f"{entry.layout}: {verified} on the publisher's files",
        "remark": entry.remark,
    }


def expand(names: Iterable[str]) -> list[str]:
    """Ids that match patterns such as ``bonn/*``; everything else stays as it is.

    Raises:
        SequenceError: A pattern matches nothing.
    """
    expanded: dict[str, None] = {}
    for name in names:
        pattern = any(character in name for character in "*[") and not Path(name).exists()
        matching = fnmatch.filter(catalogue(), name) if pattern else [name]
        if not matching:
            raise SequenceError(
                f"no public sequence matches '{name}'", "see: dynslam-bench sequences list"
            )
        expanded |= dict.fromkeys(matching)
    return list(expanded)
