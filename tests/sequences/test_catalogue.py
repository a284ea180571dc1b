"""Finding sequences: ids, aliases, data roots, cameras, plug-ins, and errors that help."""

import errno
import hashlib
import io
import shutil
import stat
import tarfile
import zipfile
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from helpers.fetch_server import FOLDER, NAME, Server, left_behind, tgz
from helpers.published_folders import random_poses, write_eth3d
from helpers.sequence_folders import flipped, make_folder

from dynslam_bench.core.download import download
from dynslam_bench.core.errors import DownloadError, DynslamError, SequenceError
from dynslam_bench.geometry import Camera, Trajectory
from dynslam_bench.sequences import SequenceView, open_sequence
from dynslam_bench.sequences import fetch as fetching
from dynslam_bench.sequences.cameras import CAMERAS, read_camera, write_camera
from dynslam_bench.sequences.catalogue import catalogue, entry_of
from dynslam_bench.sequences.fetch import Receipt, fetch, verify
from dynslam_bench.sequences.synthetic import REPLICA_IDS, RenderSettings, open_synthetic
from dynslam_bench.sequences.tags import motion_tags, sequence_tags


def vga(folder):
    """Makes a small sequence of full-size images."""
    return make_folder(folder, frames=2, width=640, height=480)[0]


def test_the_catalogue_is_complete_and_sound():
    entries = catalogue()
    assert sum(entry.ground_truth for entry in entries.values() if entry.dataset == "tum") == 47
    assert Counter(entry.dataset for entry in entries.values()) == {
        "tum": 80, "bonn": 26, "wild-slam": 10, "eth3d": 55, "icl": 4, "7scenes": 18, "shibuya": 7, "openloris": 22,
    }  # fmt: skip
    assert {id.replace("synthetic", "tum/fr3") for id in REPLICA_IDS} <= {*entries}
    assert not entries["tum/fr1/360_validation"].ground_truth
    fetched = [entry for entry in entries.values() if not entry.by_hand]
    assert len({entry.url for entry in fetched}) == len(fetched)
    assert len({(entry.dataset, entry.folder) for entry in entries.values()}) == len(entries)
    for key, entry in entries.items():
        assert key == entry.id
        assert entry.tags
        assert entry.license
        assert entry.citation
        assert entry.title
        assert entry.camera in CAMERAS or (entry.camera == "" and entry.layout != "tum")
        assert (entry.split == "") == (not entry.ground_truth)
        assert entry.verified == (entry.dataset in ("tum", "bonn"))
        assert entry.verified or entry.remark.startswith(
            "layout: not verified on the publisher's files"
        )
    assert all(
        url.startswith("https://") for entry in fetched for url in (entry.url, *entry.more_urls)
    )
    for entry in (entry for entry in fetched if entry.dataset in ("tum", "bonn")):
        assert entry.url.split("/")[-1].split(".")[0] == entry.folder
        assert entry.camera == (
            "bonn" if entry.dataset == "bonn" else f"tum-{entry.id.split('/')[1]}"
        )


def test_common_folder_names_name_no_sequence(tmp_path):
    """A folder of one's own called crowd is not Wild-SLAM's."""
    folder, *_ = make_folder(tmp_path / "crowd")
    assert open_sequence(folder).id == "folder/crowd"
    assert entry_of("crowd") is None
    assert entry_of("living_room_traj0_frei_png").id == "icl/living_room_0"


@pytest.mark.parametrize(
    "place",
    [
        "tum/rgbd_dataset_freiburg3_walking_xyz",
        "rgbd_dataset_freiburg3_walking_xyz",
        "tum/fr3/walking_xyz",
    ],
)
def test_ids_and_aliases_find_a_folder_below_the_root(tmp_path, place):
    vga(tmp_path / place)
    for name in ("tum/fr3/walking_xyz", "rgbd_dataset_freiburg3_walking_xyz"):
        sequence = open_sequence(name, data_root=tmp_path, camera="tum-fr3")
        assert sequence.id == "tum/fr3/walking_xyz"
        assert sequence.camera == CAMERAS["tum-fr3"]
        assert sequence.license == "CC-BY-4.0"
        assert "IROS 2012" in sequence.citation
        assert sequence.tags == {"high-dynamic"}
        assert sequence.split == "tune"
        assert sequence.fps == 30


def test_camera_of_a_published_folder_name(tmp_path):
    folder = vga(tmp_path / "anywhere/rgbd_bonn_crowd2")
    (folder / "camera.toml").unlink()
    sequence = open_sequence(folder)
    assert (sequence.id, sequence.camera) == ("bonn/crowd2", CAMERAS["bonn"])


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "tum/fr3/walking_xyz",
            r"^[^\n]*\(0\.53 GB, https://cvg.cit.tum.de/rgbd/dataset/freiburg3/rgbd_dataset_freiburg3_walking_xyz.tgz"
            r"\) is not at .*/tum/rgbd_dataset_freiburg3_walking_xyz \(fetch it with: dynslam-bench sequences fetch "
            r"tum/fr3/walking_xyz\)$",
        ),
        ("tum/fr2/xyz", "size unknown"),
        (
            "openloris/market1-1",
            r"is not at .*openloris/market1-1 \(get it by hand from https://lifelong",
        ),
        ("tum/fr3/walkng_xyz", "did you mean 'tum/fr3/walking_xyz'"),
        ("bonn/crowd9", "did you mean 'bonn/crowd"),
        ("rgbd_dataset_freiburg3_walking_xy", "rgbd_dataset_freiburg3_walking_xyz"),
        ("./nowhere", "there is no sequence folder"),
        ("zzz", "none is close"),
    ],
)
def test_what_is_not_here(tmp_path, name, words):
    with pytest.raises(SequenceError, match=words):
        open_sequence(name, data_root=tmp_path)


def test_camera_file_round_trip(tmp_path):
    lens = (0.1, -0.2, 1e-4, -2e-5, 0.3)
    camera = Camera(
        320, 200, 300.1, np.float64(301.2), 159.5, 99.5, lens, 1000.0, 0.05, 0.02, -1 / 30
    )
    write_camera(tmp_path / "camera.toml", camera, fps=15)
    file = read_camera(tmp_path / "camera.toml")
    assert file.camera() == camera
    assert file.fps == 15


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("fx = ", "not valid TOML"),
        ("width = 640\nheight = 480\nfx = 500.0", "lacks fy, cx, cy"),
        ("name = 'tum-fr9'", "unknown camera 'tum-fr9'.*one of tum-fr1"),
        ("name = 'tum-fr1'\nfocal = 3", "unknown setting 'focal'"),
        ("width = 640\nheight = 480\nfx = -5.0\nfy = 1.0\ncx = 0.0\ncy = 0.0", "'fx' is -5.0"),
        (
            "width = 640\nheight = 480\nfx = 5.0\nfy = 1.0\ncx = 0.0\ncy = 0.0\ndistortion = [1.0]",
            "distortion",
        ),
    ],
)
def test_bad_camera_files(tmp_path, text, words):
    folder, *_ = make_folder(tmp_path / "s")
    (folder / "camera.toml").write_text(text)
    with pytest.raises(SequenceError, match=words):
        open_sequence(folder)


def test_camera_choices(tmp_path):
    folder = vga(tmp_path / "s")
    assert open_sequence(folder, camera="tum-fr2").camera == CAMERAS["tum-fr2"]
    write_camera(tmp_path / "mine.toml", CAMERAS["bonn"])
    assert open_sequence(folder, camera=tmp_path / "mine.toml").camera == CAMERAS["bonn"]
    (folder / "camera.toml").unlink()
    with pytest.raises(
        SequenceError, match=r"camera of .* is not known.*--camera tum-fr1\|.*--camera FILE.toml"
    ):
        open_sequence(folder)
    with pytest.raises(SequenceError, match="unknown camera 'tum-f3'"):
        open_sequence(folder, camera="tum-f3")


# Tags: what moves in a scene, and what a camera's path is like.


def path(positions, rate=30):
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, : positions.shape[1], 3] = positions
    return Trajectory(np.arange(len(positions)) / rate, poses)


@pytest.mark.parametrize(
    ("name", "people", "tags"),
    [
        ("walking_xyz", "moving", ["high-dynamic"]),
        ("walking_xyz", "frozen", ["static"]),
        ("sitting_rpy", "moving", ["low-dynamic"]),
        ("fast_desk", "moving", ["fast", "static"]),
        ("loop_room_moved", "moving", ["loop", "low-dynamic"]),
        ("objects_trolley", "moving", ["unknown-objects"]),
    ],
)
def test_tags_of_rendered_sequences(name, people, tags):
    sequence = open_synthetic(
        f"synthetic/{name}?scene=100", None, settings=RenderSettings(people=people)
    )
    assert sequence_tags(sequence) == tags
    assert "loop" not in sequence_tags(SequenceView(sequence, 0, 200)), (
        "the part has not come back yet"
    )


@pytest.mark.parametrize(
    ("radius_m", "turns", "loop"), [(2.5, 1.0, True), (2.5, 0.8, False), (0.9, 4.0, False)]
)
def test_a_loop_is_a_long_path_that_comes_back_to_where_it_was(radius_m, turns, loop):
    angle = 2 * np.pi * np.linspace(0, turns, 1200)
    assert (
        "loop" in motion_tags(path(radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)))
    ) == loop


def test_noise_of_the_ground_truth_is_no_fast_motion():
    noise = np.random.default_rng(0).normal(0, 0.005, (3000, 3))
    assert (motion_tags(path(noise, rate=300)), motion_tags(path(0.0 * noise))) == (
        set(),
        {"fixed-camera"},
    )
    assert motion_tags(path(np.linspace(0, 1.2, 31)[:, None])) == {"fast"}


@pytest.fixture
def sha256(packed):
    return hashlib.sha256(packed).hexdigest()


def test_fetch_makes_a_sequence_that_opens(get, server, packed, tmp_path, sha256):
    seen = []
    place = get(progress=seen.append)
    root = tmp_path / "root"
    assert place == root / "tum" / FOLDER
    assert len(open_sequence(NAME, data_root=root)) == 4
    receipt = Receipt.read(place / "fetched.json")
    assert (receipt.sha256, receipt.size_bytes) == (sha256, len(packed))
    assert not receipt.checked
    assert receipt.files == 11
    assert [p.stage for p in seen if p.done == len(packed)] == ["download", "check"]
    assert seen[-1].stage == "extract"
    assert all(file.startswith(f"tum/{FOLDER}/") for file in left_behind(root))
    # what is there is left alone
    assert get() == place
    assert len(server.requests) == 1
    assert stat.S_IMODE((place / "rgb.txt").stat().st_mode) & 0o111 == 0


@pytest.mark.parametrize(
    ("plan", "ranges", "requests"),
    [
        (
            [{"cut": 10_000}, {"cut": 20_000}, {"status": 503}, {"cut": 0}],
            True,
            ["10000", *["30000"] * 3],
        ),
        ([{"cut": 50_000}, {"cut": 10_000}], False, ["50000", "10000"]),
        # more is announced than there is: a resumed request reveals the true end
        ([{"lie": 1000}], True, ["end"]),
        ([{"chunked": "cut"}, {"chunked": "whole"}], True, ["half"]),
    ],
)
def test_connections_that_break_are_resumed(get, server, packed, plan, ranges, requests):
    server.plan = list(plan)
    server.ranges = ranges
    get()
    names = {"end": str(len(packed)), "half": str(len(packed) // 2)}
    assert server.requests == [None, *[f"bytes={names.get(start, start)}-" for start in requests]]


@pytest.mark.parametrize("changed", [False, True])
def test_the_next_call_goes_on_where_this_one_stopped(get, server, packed, tmp_path, changed):
    """A file that changed on the server is fetched from its beginning."""
    server.plan = [{"cut": 50_000}, *[{"cut": 0}] * 3]
    with pytest.raises(
        DownloadError,
        match=rf"stopped at 50000 of {len(packed)} bytes: .*run the same command again",
    ):
        get(attempts=3)
    assert not (tmp_path / "root" / "tum").exists()
    server.requests.clear()
    if changed:
        server.etag = '"two"'
        server.data = packed + b"\0" * 100
    assert len(open_sequence(get())) == 4
    assert server.requests[0] == "bytes=50000-"


def test_wrong_checksum(get, server, monkeypatch, tmp_path, packed, sha256):
    stated = {"sha256": "0" * 64}
    monkeypatch.setattr(fetching, "entry_of", lambda name: entry_of(NAME).model_copy(update=stated))
    with pytest.raises(
        DownloadError, match=f"has the checksum {sha256} .{len(packed)} bytes., expected {'0' * 64}"
    ):
        get()
    assert left_behind(tmp_path / "root") == []
    stated["sha256"] = sha256
    assert Receipt.read(get() / "fetched.json").checked


def test_without_a_known_checksum_the_first_one_counts(get, server, tmp_path, sha256):
    shutil.rmtree(get())
    shutil.rmtree(get())
    (kept,) = (tmp_path / "root" / ".downloads").iterdir()
    assert kept.read_text() == f"{sha256}  {server.url}\n"
    kept.write_text(kept.read_text().replace(sha256, "0" * 64))
    with pytest.raises(
        SequenceError, match=f"has the checksum {sha256}, but gave {'0' * 64} before"
    ):
        get()
    assert list((tmp_path / "root" / ".downloads").iterdir()) == [kept]
    assert Receipt.read(get(checksum=False) / "fetched.json").sha256 == sha256
    assert kept.read_text().startswith(sha256)


@pytest.mark.parametrize(
    ("status", "url", "words"),
    [
        (404, None, "the server answers 404 Not Found for http://127.0.0.1"),
        (500, None, "stopped at 0 bytes: the server answers 500"),
        (200, "http://127.0.0.1:9/x.tgz", r"stopped at 0 bytes: .*refused"),
        (200, "file:///etc/passwd", "has to begin with http"),
    ],
)
def test_refusals(server, tmp_path, status, url, words):
    server.plan = [{"status": status}] * 3
    with pytest.raises(DownloadError, match=words):
        fetch(NAME, data_root=tmp_path, url=url or server.url, attempts=3, wait_s=0.0)


@pytest.mark.parametrize(
    ("pattern", "words", "kept", "requests"),
    [
        (
            "*.part",
            "make room and run the same command again",
            f"{FOLDER}.tgz.part",
            ["bytes=40000-"],
        ),
        # the archive is kept
        ("*/2.png", "cannot extract .*No space left.*make room", f"{FOLDER}.tgz", []),
    ],
)
def test_full_disk(get, server, monkeypatch, tmp_path, pattern, words, kept, requests):
    """The disk is full when a file is opened to be written whose path matches."""

    def full(self, mode="r", *args, **kwargs):
        if self.match(pattern) and mode != "rb" and "b" in mode:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(self, mode, *args, **kwargs)

    real = Path.open
    server.plan = [{"cut": 40_000}, *[{"cut": 0}] * 2]
    with pytest.raises(DownloadError):
        get(attempts=2)
    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(DynslamError, match=words):
        get()
    monkeypatch.undo()
    assert f".downloads/{kept}" in left_behind(tmp_path / "root")
    server.requests.clear()
    get()
    assert server.requests == requests


def test_too_little_room_is_noticed_at_once(get, monkeypatch, packed):
    monkeypatch.setattr(
        shutil, "disk_usage", lambda _: SimpleNamespace(total=1, used=1, free=len(packed) - 1)
    )
    with pytest.raises(DownloadError, match=r"GB free, but .* GB are still to download"):
        get()


def test_an_unwritable_root(get, tmp_path):
    (tmp_path / "root").write_text("a file")
    with pytest.raises(DynslamError, match="cannot write"):
        get()


def test_two_at_once(server, tmp_path):
    import fcntl

    target = tmp_path / "file"
    with (tmp_path / "file.part.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(DownloadError, match="another process is downloading"):
            download(server.url, target)
    download(server.url, target)


def test_verify(get, tmp_path):
    place = get()
    root = tmp_path / "root"
    progress = Mock()
    report = verify(NAME, data_root=root, progress=progress)
    assert report.ok
    assert report.manifest
    assert report.frames == 4
    assert [call.args for call in progress.call_args_list] == [(done, 4) for done in (1, 2, 3, 4)]
    image = place / "rgb" / "2.png"
    image.write_bytes(image.read_bytes()[:-300])
    (place / "groundtruth.txt").unlink()
    report = verify(NAME, data_root=root)
    assert [fault.split(" ")[0] for fault in report.faults] == [
        "frame",
        "groundtruth.txt",
        "rgb/2.png",
    ]
    (place / "depth.txt").write_text("")
    assert "lists no image" in verify(NAME, data_root=root).faults[0]


def test_verify_of_folders_and_of_nothing(folder, tmp_path):
    report = verify(str(folder))
    assert report.ok
    assert not report.manifest
    assert report.id == NAME
    for call, name, words in (
        (verify, NAME, "sequences fetch"),
        (fetch, "tum/fr3/siting_static", "did you mean"),
        (fetch, "synthetic/walking_xyz", "needs no fetching"),
        (
            fetch,
            "shibuya/standing01",
            "cannot be fetched by this program: one archive of all sequences",
        ),
    ):
        with pytest.raises(SequenceError, match=words):
            call(name, data_root=tmp_path)


# Archives that want out of their folder, that grow too large, or that are damaged.


def member(name, kind=tarfile.REGTYPE, link=""):
    info = tarfile.TarInfo(name)
    info.type = kind
    info.linkname = link
    return info


def zipped(files, *extra, name=FOLDER):
    """A zip archive of files, each as path and folder, and of further entries."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for path, folder in files:
            archive.write(path, f"{name}/{path.relative_to(folder).as_posix()}")
        for entry, content in extra:
            archive.writestr(entry, content)
    return buffer.getvalue()


@pytest.fixture
def two_archives(tmp_path, monkeypatch):
    """A sequence whose colour and depth lie in archives of their own, served as ETH3D publishes them."""
    made = tmp_path / "cables_1"
    write_eth3d(made, random_poses(0))
    files = [path for path in made.rglob("*") if path.is_file()]
    depth = [path for path in files if "depth" in path.parts or path.name == "associated.txt"]
    readme = ("cables_1/README", "the same in both")
    parts = ([path for path in files if path not in depth], depth)
    servers = [
        Server(zipped([(path, made) for path in part], readme, name="cables_1")) for part in parts
    ]
    urls = [server.url.replace(".tgz", f"_{i}.zip") for i, server in enumerate(servers)]
    entry = entry_of("eth3d/cables_1").model_copy(update={"more_urls": (urls[1],)})
    monkeypatch.setattr(fetching, "entry_of", lambda name: entry)
    yield (
        servers,
        lambda: fetch(
            "eth3d/cables_1", data_root=tmp_path / "root", url=urls[0], wait_s=0.0, timeout_s=5.0
        ),
    )
    for server in servers:
        server.close()


def test_a_sequence_of_two_archives(two_archives, tmp_path):
    place = two_archives[1]()
    assert place == tmp_path / "root" / "eth3d" / "cables_1"
    assert not (place / ".part").exists()
    assert len(open_sequence("eth3d/cables_1", data_root=tmp_path / "root")) == 3
    assert verify("eth3d/cables_1", data_root=tmp_path / "root").ok


def test_two_archives_that_contradict_each_other_are_refused(two_archives, tmp_path):
    servers, get = two_archives
    buffer = io.BytesIO(servers[1].data)
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.writestr("cables_1/rgb.txt", "1.0 rgb/0.png")
    servers[1].data = buffer.getvalue()
    with pytest.raises(
        SequenceError, match=r"holds another cables_1/rgb\.txt than the first archive, refused"
    ):
        get()
    assert left_behind(tmp_path / "root") == []


LINK = zipfile.ZipInfo(f"{FOLDER}/link")
LINK.external_attr = (stat.S_IFLNK | 0o777) << 16
OUTSIDE = "outside the sequence's folder"
SPECIAL = "a link or device"
HOSTILE = [
    (member("../outside.txt"), OUTSIDE),
    (member("/etc/evil"), OUTSIDE),
    (member(f"{FOLDER}/../../evil"), OUTSIDE),
    (member(f"{FOLDER}\\..\\evil"), OUTSIDE),
    (member(f"{FOLDER}/link", tarfile.SYMTYPE, "/etc/passwd"), SPECIAL),
    (member(f"{FOLDER}/hard", tarfile.LNKTYPE, f"{FOLDER}/rgb.txt"), SPECIAL),
    (member(f"{FOLDER}/device", tarfile.CHRTYPE), SPECIAL),
    (member(f"{FOLDER}/pipe", tarfile.FIFOTYPE), SPECIAL),
    (member(f"{FOLDER}/rgb.txt"), "one name twice"),
    (member(f"{FOLDER}/rgb.txt/below"), "one name twice"),
]
"""Members that no archive may hold."""


@pytest.mark.parametrize(
    ("data", "missing", "words"),
    [
        *(
            (lambda folder, info=info: tgz(folder, extra=[(info, b"")]), 0, words)
            for info, words in HOSTILE
        ),
        (lambda folder: zipped([], ("a/../../evil", "x")), 0, OUTSIDE),
        (lambda folder: zipped([], (LINK, "/etc/passwd")), 0, "no regular file"),
        (lambda _: b"<html>moved</html>" * 100, 0, rf"{FOLDER}.tgz is damaged \(1800 bytes\)"),
        (lambda folder: flipped(tgz(folder)), 0, "is damaged"),
        (tgz, 3000, "is damaged"),  # a shorter length is announced
        (lambda folder: tgz(folder / "rgb"), 0, r"holds no rgb\.txt"),
        (lambda folder: tgz(folder, "deep/er"), 0, r"holds no rgb\.txt"),
    ],
)
def test_hostile_and_damaged_archives_leave_nothing(
    get, server, packed, folder, tmp_path, data, missing, words
):
    server.data = data(folder)
    server.plan = [{"lie": -missing}]
    with pytest.raises(SequenceError, match=words):
        get()
    assert left_behind(tmp_path) == []


@pytest.mark.parametrize(
    "pack",
    [
        lambda folder: tgz(folder, "."),
        lambda folder: tgz(folder, "another_name"),
        lambda folder: zipped([(path, folder) for path in folder.rglob("*")]),
    ],
)
def test_a_zip_archive_and_folders_inside_of_any_name(get, server, folder, pack):
    server.data = pack(folder)
    assert len(open_sequence(get())) == 4
