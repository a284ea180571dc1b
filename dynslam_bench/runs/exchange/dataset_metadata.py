"""Croissant metadata and a data card for rendered sequences, recordings of SLAM-Control, and banks.

Croissant 1.0 with the responsible-AI fields that NeurIPS asks of data sets: limitations, biases,
personal information, uses, social impact, whether the data are synthetic, what they derive from and
how they were made. Both files are written from the same facts, `DatasetFacts`, beside the data.

Sources: Croissant 1.0 (http://mlcommons.org/croissant/1.0), Croissant RAI 1.0
(http://mlcommons.org/croissant/RAI/1.0), PROV-O (https://www.w3.org/TR/prov-o/).
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

from dynslam_bench.core import RunError, file_sha256, find_data_root, read_text, write_atomic
from dynslam_bench.core.version import version
from dynslam_bench.evaluation import get_protocol
from dynslam_bench.runs.bank import SUMS, Bank, check_sound
from dynslam_bench.runs.bank_files import DESCRIPTION_FILE, read_description
from dynslam_bench.sequences.synthetic import render_synthetic

CROISSANT_FILE = "croissant.json"
CARD_FILE = "DATA_CARD.md"
_MADE = "<!-- made by: dynslam-bench describe -->"
"""The first line of the card; a card without it, and the metadata beside it, were written by a person, and stay."""
CROISSANT = "http://mlcommons.org/croissant/1.0"
CROISSANT_RAI = "http://mlcommons.org/croissant/RAI/1.0"
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "prov": "http://www.w3.org/ns/prov#",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
"""The context of the specification, with the prefixes of RAI and PROV."""
_CITATION = (
    "dynslam-bench: a Gymnasium benchmarking and tuning toolkit for visual SLAM in dynamic scenes"
)
_LICENCES = {
    "CC0-1.0": "https://creativecommons.org/publicdomain/zero/1.0/",
    "CC BY 4.0": "https://creativecommons.org/licenses/by/4.0/",
    "MIT": "https://opensource.org/license/mit/",
}
"""Addresses of the licences that the catalogue names."""
_RENDERED_LIMITS = (
    "Rooms, people and sensors are models: errors on recordings differ from errors here, and a ranking of systems "
    "here is not one on recordings. People are simple bodies with painted clothes, without faces."
)
_RENDERED_BIASES = (
    "Indoor scenes of one renderer, at the noise of one Kinect-like camera. Who walks where follows a few scripts, "
    "and all people have the same body shapes."
)
_NOBODY = "None: no person was recorded. People in the images are rendered."
_IMPACT = (
    "Methods that keep out moving people serve robots beside people. The same methods could help to map places without "
    "consent; the data add nothing to that, as they show no real place and no real person."
)


@dataclass(frozen=True)
class RecordField:
    """A field of the records that a group of files holds.

    Attributes:
        name: Its name.
        data_type: Its type in schema.org's terms.
        source: ``content`` or ``lines`` of a file, or a path into its JSON, e.g. ``$.run_id``.
    """

    name: str
    data_type: str
    source: str

    @property
    def extract(self) -> dict[str, str]:
        """How a reader gets it out of a file."""
        if self.source.startswith("$"):
            return {"jsonPath": self.source}
        return {"fileProperty": self.source}


_IMAGE = (RecordField("image", "sc:ImageObject", "content"),)
_LINES = (RecordField("line", "sc:Text", "lines"),)


@dataclass(frozen=True)
class FileGroup:
    """Files of one kind in a data set.

    Attributes:
        id: Its name.
        pattern: Their names, e.g. ``rgb/*.png``; a plain name for a single file.
        media_type: Their media type.
        meaning: What they hold.
        fields: Fields of the records in them; none for files that are no records.
    """

    id: str
    pattern: str
    media_type: str
    meaning: str
    fields: tuple[RecordField, ...] = ()

    @property
    def is_single(self) -> bool:
        """Whether it is one file."""
        return "*" not in self.pattern


@dataclass(frozen=True)
class DatasetFacts:
    """Facts that metadata and card state of a data set.

    Attributes:
        folder: Where its files are.
        name: Its name.
        title: Its heading.
        summary: What it is.
        licences: Licences of what it holds.
        citation: What to cite.
        files: Its files.
        limitations: What it is not fit for.
        biases: In what it is one-sided.
        personal: What it holds of persons.
        uses: What it is made for.
        impact: What it may do to society.
        synthetic: Whether it holds data that were not measured.
        derived_from: What it derives from: names with addresses, which may be empty.
        made_by: How it was made.
        numbers: Further facts, by name.
    """

    folder: Path
    name: str
    title: str
    summary: str
    licences: tuple[str, ...]
    citation: str
    files: tuple[FileGroup, ...]
    limitations: str
    biases: str
    personal: str
    uses: str
    impact: str
    synthetic: bool
    derived_from: tuple[tuple[str, str], ...]
    made_by: str
    numbers: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class DescribedData:
    """Files that describe a data set.

    Attributes:
        kind: ``rendered sequence``, ``recordings of SLAM-Control`` or ``bank``.
        croissant: The metadata.
        card: The data card.
    """

    kind: str
    croissant: Path
    card: Path


def describe_data(
    source: str | Path,
    *,
    url: str = "",
    creator: str = "dynslam-bench contributors",
    data_root: str | Path | None = None,
    today: date | None = None,
) -> DescribedData:
    """Write Croissant metadata and a data card beside a data set.

    Args:
        source: The folder of a rendered sequence, of a Minari data set or of a bank; or the id of a
            rendered sequence, which is rendered if need be.
        url: Where the data set is published, if it is.
        creator: Who publishes it.
        data_root: Folder of the sequences, for an id.
        today: The date of publication; today by default.

    Raises:
        RunError: It is none of these.
        DynslamError: A file cannot be read or written.
    """
    folder = Path(source).expanduser()
    if str(source).startswith("synthetic/"):
        folder = render_synthetic(str(source), find_data_root(data_root))
    folder = folder.absolute()
    _refuse_own_files(folder)
    kind, facts = _facts(folder)
    metadata = croissant(facts, url=url, creator=creator, today=today or date.today())
    write_atomic(folder / CROISSANT_FILE, json.dumps(metadata, indent=2) + "\n")
    write_atomic(folder / CARD_FILE, card(facts, url=url, creator=creator))
    return DescribedData(kind, folder / CROISSANT_FILE, folder / CARD_FILE)


def _refuse_own_files(folder: Path) -> None:
    """Refuse to replace a card or metadata that this module has not written.

    Raises:
        RunError: There is one.
    """
    card_file = folder / CARD_FILE
    if card_file.is_file() and read_text(card_file).startswith(_MADE):
        return
    for file in (card_file, folder / CROISSANT_FILE):
        if file.exists():
            raise RunError(f"{file} was not made by this command, and stays", "rename it")


def _facts(folder: Path) -> tuple[str, DatasetFacts]:
    """The kind of a data set, and the facts of it.

    Raises:
        RunError: It is of no kind that is known.
    """
    if (folder / SUMS).is_file():
        return "bank", _facts_of_bank(folder)
    if (folder / "data" / "metadata.json").is_file():
        return "recordings of SLAM-Control", _facts_of_minari(folder)
    truth = folder / "groundtruth.txt"
    if truth.is_file() and "rendered sequence" in read_text(truth)[:200]:
        return "rendered sequence", _facts_of_rendered(folder)
    raise RunError(
        f"{folder} is no rendered sequence, no Minari data set and no bank",
        "name the folder that `sequences render`, Minari or `bank add` has made",
    )


def _facts_of_rendered(folder: Path) -> DatasetFacts:
    """The facts of a rendered sequence."""
    frames = len(list((folder / "rgb").glob("*.png")))
    scene = folder.name.rpartition("-")[0] or folder.name
    return DatasetFacts(
        folder=folder,
        name=f"dynslam-bench-{scene}",
        title=f"Rendered RGB-D sequence {scene}",
        summary="RGB-D images of a dynamic indoor scene with exact poses, depth and masks, in TUM's layout.",
        licences=("CC0-1.0",),
        citation=_CITATION,
        files=(
            FileGroup("rgb", "rgb/*.png", "image/png", "colour images, 640x480, 8 bits", _IMAGE),
            FileGroup(
                "depth", "depth/*.png", "image/png", "depth images, 16 bits, metres x 5000", _IMAGE
            ),
            FileGroup(
                "masks", "masks/*.png", "image/png", "exact instances, 0 is the background", _IMAGE
            ),
            FileGroup("rgb-list", "rgb.txt", "text/plain", "stamp and file of each image"),
            FileGroup("depth-list", "depth.txt", "text/plain", "stamp and file of each image"),
            FileGroup("masks-list", "masks.txt", "text/plain", "stamp and file of each image"),
            FileGroup(
                "poses", "groundtruth.txt", "text/plain", "exact poses, camera to world", _LINES
            ),
            FileGroup("camera", "camera.toml", "application/toml", "intrinsics and frame rate"),
        ),
        limitations=_RENDERED_LIMITS,
        biases=_RENDERED_BIASES,
        personal=_NOBODY,
        uses="To evaluate and tune visual SLAM in dynamic scenes. Scenes 0 to 99 are for tuning, all others for tests.",
        impact=_IMPACT,
        synthetic=True,
        derived_from=(("dynslam-bench's renderer; no other data set", ""),),
        made_by=f"Rendered by dynslam-bench {version()} from the scene's number alone; no data were collected.",
        numbers={"frames": str(frames)},
    )


def _facts_of_minari(folder: Path) -> DatasetFacts:
    """The facts of recorded episodes, as Minari stores them.

    Raises:
        RunError: Its metadata are no JSON object, or name no environment of this package.
    """
    file = folder / "data" / "metadata.json"
    try:
        stated = json.loads(read_text(file))
    except ValueError as error:
        raise RunError(f"{file} is not valid JSON: {error}") from error
    if not isinstance(stated, dict):
        raise RunError(f"{file} holds a {type(stated).__name__}, expected an object")
    # other data have other licences and persons
    environment = str(stated.get("env_spec", ""))
    if "dynslam" not in environment:
        raise RunError(
            f"{file} names no environment of dynslam-bench in env_spec: {environment[:80] or 'nothing'}",
            "only recordings of SLAM-Control are described",
        )
    wanted = {"total_episodes": "episodes", "total_steps": "steps", "algorithm_name": "policy"}
    numbers = {words: str(stated[key]) for key, words in wanted.items() if key in stated}
    name = str(stated.get("dataset_id", folder.name))
    contents = [
        FileGroup(
            "metadata",
            "data/metadata.json",
            "application/json",
            "spaces and counts",
            (
                RecordField("data set", "sc:Text", "$.dataset_id"),
                RecordField("episodes", "sc:Integer", "$.total_episodes"),
                RecordField("steps", "sc:Integer", "$.total_steps"),
            ),
        ),
    ]
    if (folder / "data" / "main_data.hdf5").is_file():
        contents.append(
            FileGroup(
                "episodes",
                "data/main_data.hdf5",
                "application/x-hdf5",
                "observations, actions, rewards and infos of each episode",
            )
        )
    return DatasetFacts(
        folder=folder,
        name=f"dynslam-bench-{name.replace('/', '-')}",
        title=f"Recordings of SLAM-Control: {name}",
        summary="Episodes of agents that change the settings of a SLAM system at every frame of a rendered sequence.",
        licences=("CC0-1.0",),
        citation=_CITATION,
        files=tuple(contents),
        limitations=f"{_RENDERED_LIMITS} Rewards hold for one tracker and its version.",
        biases=f"{_RENDERED_BIASES} Actions are those of the recorded policies.",
        personal=_NOBODY,
        uses="To learn policies without an environment, and to compare with them.",
        impact=_IMPACT,
        synthetic=True,
        derived_from=(("rendered training scenes of dynslam-bench", ""),),
        made_by=f"Episodes played in an environment of dynslam-bench and stored with Minari; described by {version()}.",
        numbers=numbers,
    )


def _facts_of_bank(folder: Path) -> DatasetFacts:
    """The facts of a bank.

    Raises:
        RunError: It has faults.
    """
    check_sound(folder)
    store = Bank(folder)
    records = list(store.all()[0])
    protocol = get_protocol(read_description(folder).protocol)
    sequences = {record.sequence.id: record.sequence for record in records}
    trackers = sorted({record.tracker.label for record in records})
    licences = {info.license or "not stated" for info in sequences.values()}
    rendered = [name for name in sequences if name.startswith("synthetic/")]
    recorded = sorted(sequences.keys() - set(rendered))
    derived = [(name, "") for name in recorded]
    cited = sorted({info.citation for info in sequences.values() if info.citation})
    derived += [(f"{len(rendered)} rendered sequences of dynslam-bench", "")] if rendered else []
    contents = [
        FileGroup(
            "records",
            "runs/*/run.json",
            "application/json",
            "tracker, settings, machine",
            (
                RecordField("row", "sc:Text", "$.run_id"),
                RecordField("tracker", "sc:Text", "$.tracker.id"),
                RecordField("sequence", "sc:Text", "$.sequence.id"),
                RecordField("status", "sc:Text", "$.status"),
            ),
        ),
        FileGroup("trajectories", "runs/*/trajectory_*.txt", "text/plain", "estimated poses"),
        FileGroup("stamps", "sequences/*/timestamps.txt", "text/plain", "stamps of the frames"),
        FileGroup("truth", "sequences/*/groundtruth.txt", "text/plain", "ground truth"),
        FileGroup("marks", "marks/*/*.json", "application/json", "who has run a row again"),
        FileGroup("checksums", SUMS, "text/plain", "SHA-256 of all these files"),
    ]
    if (folder / DESCRIPTION_FILE).is_file():
        contents.append(
            FileGroup("description", DESCRIPTION_FILE, "application/json", "protocol of the errors")
        )
    return DatasetFacts(
        folder=folder,
        name=f"dynslam-bench-bank-{folder.name}",
        title=f"Bank of trajectories {folder.name}",
        summary=f"{len(records)} trajectories of {len(trackers)} SLAM systems on {len(sequences)} sequences, "
        f"with ground truth; errors are under the protocol {protocol.id}.",
        licences=tuple(sorted(licences)),
        citation="; ".join(cited) or _CITATION,
        files=tuple(contents),
        limitations="Errors hold for these sequences, settings and machines. A row that nobody has run again is its "
        "owner's word; an imported one names where it comes from.",
        biases="Systems and sequences are those that people have added; they are no sample of the field.",
        personal="None in the bank: it holds poses and no images. Recordings that it refers to may show persons.",
        uses="To compare SLAM systems, to score their trajectories under other protocols, and to check published rows.",
        impact="Rows that others can run again make results easier to trust. A rank can be taken for fitness "
        "for a use that was not tested.",
        synthetic=bool(rendered),
        derived_from=tuple(derived),
        made_by=f"Runs of the named systems, stored and scored by dynslam-bench; described by {version()}.",
        numbers={
            "rows": str(len(records)),
            "trackers": ", ".join(trackers),
            "sequences": str(len(sequences)),
            "protocol": f"{protocol.id}, digest {protocol.digest()}",
        },
    )


def croissant(facts: DatasetFacts, *, url: str, creator: str, today: date) -> dict[str, Any]:
    """The metadata of a data set as JSON-LD.

    Args:
        facts: What is known of it.
        url: Where it is published; empty if it is not.
        creator: Who publishes it.
        today: When.
    """
    licences = [_LICENCES.get(name, name) for name in facts.licences]
    metadata: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": [CROISSANT, CROISSANT_RAI],
        "name": facts.name,
        "description": facts.summary,
        "license": licences[0] if len(licences) == 1 else licences,
        "citeAs": facts.citation,
        "creator": {"@type": "sc:Organization", "name": creator},
        "datePublished": today.isoformat(),
        "version": "1.0.0",
        "keywords": ["SLAM", "RGB-D", "dynamic scenes", "trajectories"],
    }
    if url:
        metadata["url"] = url
    metadata |= {
        "rai:dataLimitations": facts.limitations,
        "rai:dataBiases": facts.biases,
        "rai:personalSensitiveInformation": facts.personal,
        "rai:dataUseCases": facts.uses,
        "rai:dataSocialImpact": facts.impact,
        "rai:hasSyntheticData": facts.synthetic,
        "prov:wasDerivedFrom": [_entity(name, place) for name, place in facts.derived_from],
        "prov:wasGeneratedBy": [{"@type": "prov:Activity", "prov:label": facts.made_by}],
        "distribution": [_distribution(facts.folder, group) for group in _present(facts)],
        "recordSet": [_record_set(group) for group in _present(facts) if group.fields],
    }
    return metadata


def _present(facts: DatasetFacts) -> Iterable[FileGroup]:
    """The groups of files of which there is one at least."""
    return [group for group in facts.files if any(facts.folder.glob(group.pattern))]


def _entity(name: str, place: str) -> dict[str, str]:
    """A source of a data set, in the terms of PROV."""
    entity = {"@type": "prov:Entity", "prov:label": name}
    return entity | ({"url": place} if place else {})


def _distribution(folder: Path, group: FileGroup) -> dict[str, Any]:
    """A file with its checksum, or a set of files by the pattern of their names."""
    entry: dict[str, Any] = {"@id": group.id, "name": group.id, "description": group.meaning}
    if not group.is_single:
        media_type = {"encodingFormat": group.media_type, "includes": group.pattern}
        return {"@type": "cr:FileSet"} | entry | media_type
    file = folder / group.pattern
    return {
        "@type": "cr:FileObject",
        **entry,
        "contentUrl": group.pattern,
        "contentSize": f"{file.stat().st_size} B",
        "encodingFormat": group.media_type,
        "sha256": file_sha256(file),
    }


def _record_set(group: FileGroup) -> dict[str, Any]:
    """The records that a group of files holds."""
    name = f"{group.id}-records"
    files = {"fileObject" if group.is_single else "fileSet": {"@id": group.id}}
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "description": group.meaning,
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"{name}/{part.name.replace(' ', '-')}",
                "name": part.name.replace(" ", "-"),
                "description": part.name,
                "dataType": part.data_type,
                "source": files | {"extract": part.extract},
            }
            for part in group.fields
        ],
    }


def card(facts: DatasetFacts, *, url: str, creator: str) -> str:
    """The data card of a data set as Markdown, from the facts of its metadata."""
    derived = ", ".join(f"{name} {place}".strip() for name, place in facts.derived_from)
    about = {
        **facts.numbers,
        "publisher": creator,
        "address": url,
        "licence": ", ".join(facts.licences),
        "cite": facts.citation,
        "synthetic data": "yes" if facts.synthetic else "no",
    }
    lines = [_MADE, f"# {facts.title}", "", facts.summary, ""]
    lines += ["| fact | value |", "| --- | --- |"]
    lines += [f"| {name} | {value} |" for name, value in about.items() if value]
    lines += ["", "## Files", "", "| files | type | content |", "| --- | --- | --- |"]
    lines += [
        f"| `{group.pattern}` | {group.media_type} | {group.meaning} |" for group in _present(facts)
    ]
    for heading, text in (
        ("How it was made", facts.made_by),
        ("What it derives from", derived or "nothing else"),
        ("Uses", facts.uses),
        ("Limitations", facts.limitations),
        ("Biases", facts.biases),
        ("Personal information", facts.personal),
        ("Social impact", facts.impact),
    ):
        lines += ["", f"## {heading}", "", text]
    return "\n".join(lines) + "\n"
