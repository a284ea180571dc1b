"""Labelled data from files and sequences, training with resume, evaluation."""

import json
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.segmentation.networks.backbone import NetworkConfig
from dynslam_bench.segmentation.networks.loading import FORMAT, load_network
from dynslam_bench.segmentation.networks.network import (
    IGNORED,
    NEGATIVE,
    MaskRCNN,
    crop_masks,
    match,
    sample,
)
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.segmentation.training import train as training
from dynslam_bench.segmentation.training.evaluate_masks import SegmenterScore, evaluate_segmenter
from dynslam_bench.segmentation.training.labelled_images import (
    LabelledImage,
    PreparedImages,
    coco_images,
    decode_runs,
    open_labelled,
    prepare,
    shrink,
    vary,
    yolo_images,
)
from dynslam_bench.segmentation.training.settings import TrainSettings
from dynslam_bench.segmentation.training.train import network_config, train


def write_yolo(folder, count=6, seed=0):
    """Images with one textured rectangle 'person' each (and a 'chair' nobody learns)."""
    rng = np.random.default_rng(seed)
    for part in ("images", "labels"):
        (folder / part).mkdir(parents=True)
    for k in range(count):
        image = np.full((120, 160, 3), 90, np.uint8)
        x = int(rng.integers(10, 90))
        y = int(rng.integers(10, 50))
        image[y : y + 60, x : x + 40] = (20, 40, 200)
        image[100:115, 5:20] = (200, 200, 20)
        assert cv2.imwrite(str(folder / "images" / f"{k}.png"), image)
        corners = [(x, y), (x + 40, y), (x + 40, y + 60), (x, y + 60)]
        flat = " ".join(f"{a / 160:.6f} {b / 120:.6f}" for a, b in corners)
        chair = "0.03125 0.83333 0.125 0.83333 0.125 0.95833 0.03125 0.95833"
        (folder / "labels" / f"{k}.txt").write_text(f"0 {flat}\n56 {chair}\n")
    return folder


def coco(
    folder: Path, segmentation: object, *, changes: dict[str, object] | None = None, **extra: object
) -> Path:
    """A COCO file of one image and one object; `extra` are fields of the annotation, `changes` replace whole parts."""
    cv2.imwrite(str(folder / "a.png"), np.zeros((6, 8, 3), np.uint8))
    content = {
        "images": [{"id": 1, "file_name": "a.png"}],
        "categories": [{"id": 1, "name": "person"}],
        "annotations": [{"image_id": 1, "category_id": 1, "segmentation": segmentation, **extra}],
    }
    path = folder / "annotations.json"
    path.write_text(json.dumps(content | (changes or {})))
    return path


# --- data --------------------------------------------------------------------------------------------------------


def test_yolo_polygons(tmp_path):
    images = yolo_images(str(write_yolo(tmp_path)))
    assert len(images) == 6
    image = images[2]
    assert image.class_names == ("person", "chair")
    assert image.rgb.shape == (120, 160, 3)
    red = (image.rgb == (200, 40, 20)).all(axis=2)
    assert (image.masks[0] & red).sum() / (image.masks[0] | red).sum() > 0.95
    (tmp_path / "labels" / "2.txt").unlink()
    assert images[2].masks.shape == (0, 120, 160)
    with pytest.raises(SegmentationError, match="there are no images"):
        yolo_images(str(tmp_path / "none"))


@pytest.mark.parametrize("names", ["names: [forklift, Person]", "names: {0: forklift, 1: Person}"])
@pytest.mark.parametrize("place", [".", "set"])
def test_yolo_classes_are_numbered_as_the_data_set_says(tmp_path, names, place):
    folder = write_yolo(tmp_path / "set")
    (folder / "labels" / "0.txt").write_text(
        "1 0.1 0.1 0.5 0.1 0.5 0.5\n0 0.6 0.6 0.9 0.6 0.9 0.9\n"
    )
    assert yolo_images(str(folder))[0].class_names == ("person", "bicycle")[::-1]
    (tmp_path / place / "data.yaml").write_text(f"path: here\n{names}\n")
    assert yolo_images(str(folder))[0].class_names == ("person", "forklift")
    (tmp_path / place / "data.yaml").write_text("nc: 2\n")
    with pytest.raises(SegmentationError, match="'names' is not a table of class names"):
        yolo_images(str(folder))


def test_coco_polygons_and_run_lengths(tmp_path):
    expected = np.zeros((6, 8), bool)
    expected[1:4, 2:6] = True
    polygon = [[2, 1, 6, 1, 6, 4, 2, 4]]
    for segmentation in (polygon, {"size": [6, 8], "counts": [13, 3, 3, 3, 3, 3, 3, 3, 14]}):
        image = coco_images(str(coco(tmp_path, segmentation)))[0]
        assert image.class_names == ("person",)
        assert np.array_equal(image.masks[0], expected)
    capital = coco(tmp_path, polygon, changes={"categories": [{"id": 1, "name": "Person"}]})
    assert coco_images(str(capital))[0].class_names == ("person",)
    assert len(coco_images(str(coco(tmp_path, polygon, iscrowd=1)))[0].masks) == 0


def test_rendered_frames_are_a_function_of_their_name():
    text = "synthetic:scenes=3-4,frames=2,length=30,options=0.5,seed=7"
    one = open_labelled(text)
    two = open_labelled(text)
    assert one.name == text
    assert len(one) == 2 * 8 * 2
    a = one[5]
    b = two[5]
    assert np.array_equal(a.rgb, b.rgb)
    assert np.array_equal(a.masks, b.masks)
    assert "person" in a.class_names
    assert not np.array_equal(a.rgb, one[4].rgb)
    for bad in ("scenes=0-200", "frames=0", "colour=1", "frames=x", "frames=40,length=30"):
        with pytest.raises(SegmentationError, match="synthetic:"):
            open_labelled(f"synthetic:{bad}")
    with pytest.raises(SegmentationError, match=r"did you mean 'synthetic'"):
        open_labelled("syntetic:x")


def test_shrinking_keeps_the_aspect_ratio_and_the_smaller_object_in_front():
    masks = np.zeros((2, 100, 100), bool)
    masks[0, 40:60, 40:60] = True
    masks[1, 20:80, 20:80] = True
    rgb, labels, names = shrink(
        LabelledImage(np.full((100, 100, 3), 9, np.uint8), masks, ("chair", "person")), 60, 80
    )
    assert rgb.shape == (60, 80, 3)
    assert (rgb[:, :10] == 114).all()
    assert (rgb[:, 10:70] == 9).all()
    assert names == ["person", "chair"]
    assert (labels[24:36, 34:46] == 2).all()
    assert (labels == 2).sum() == 144
    assert (labels > 0).sum() == 36 * 36


def test_variation_moves_image_and_labels_alike():
    rgb = np.zeros((120, 160, 3), np.uint8)
    rgb[30:90, 40:100] = 255
    labels = (rgb[:, :, 0] > 0).astype(np.uint8)
    places = set()
    for seed in range(12):
        image, moved = vary(rgb, labels, np.random.default_rng(seed))
        assert image.shape == rgb.shape
        assert image.dtype == np.uint8
        grey = image.mean(axis=2)
        inside = moved > 0
        assert (grey[inside] > (grey[inside].mean() + 60) / 2).mean() > 0.8
        places.add(int(moved.sum()))
    assert len(places) > 5


# --- training ----------------------------------------------------------------------------------------------------


def test_matching_and_sampling():
    boxes = torch.tensor(
        [[0.0, 0, 10, 10], [0, 0, 10, 14], [50, 50, 60, 60], [0, 0, 40, 40], [100, 100, 101, 101]]
    )
    truth = torch.tensor([[0.0, 0, 10, 10], [20, 20, 60, 60]])
    assert match(boxes, truth, high=0.7, low=0.3, keep_best=False).tolist() == [
        0,
        0,
        NEGATIVE,
        NEGATIVE,
        NEGATIVE,
    ]
    assert match(boxes, truth, high=0.8, low=0.1, keep_best=True).tolist() == [
        0,
        IGNORED,
        NEGATIVE,
        1,
        NEGATIVE,
    ]
    assert match(boxes, truth[:0], high=0.7, low=0.3, keep_best=True).tolist() == [NEGATIVE] * 5
    matched = torch.tensor([0, 1, 0, 1] + [NEGATIVE] * 50 + [IGNORED] * 9)
    generator = torch.Generator().manual_seed(0)
    positive, negative = sample(matched, count=8, positive_share=0.25, generator=generator)
    assert len(positive) == 2
    assert len(negative) == 6
    assert int(negative.max()) < 54


def test_mask_targets_are_the_mask_inside_the_box():
    masks = torch.zeros(1, 40, 60, dtype=torch.bool)
    masks[0, 10:30, 20:40] = True
    target = crop_masks(masks, torch.tensor([[20.0, 10, 60, 30]]), 28)
    assert (target[0, :, :14] == 1).all()
    assert (target[0, :, 14:] == 0).all()


@pytest.fixture
def small_images(monkeypatch):
    """Networks of 160 x 120 pixels, a quarter of the embedded one's."""
    small = lambda settings: network_config(settings).model_copy(update={"min_side": 120})  # noqa: E731
    monkeypatch.setattr(training, "network_config", small)
    return small


def settings_for(folder, **changes):
    return TrainSettings(**{
        "data": (f"yolo:{folder}",), "validation": f"yolo:{folder}", "iterations": 3, "batch": 1, "proposals": 16,
        "warmup": 2, "evaluate_every": 3, "checkpoint_every": 1, "average": 0.5, **changes,
    })  # fmt: skip


@pytest.mark.slow
def test_a_resumed_run_equals_an_uninterrupted_one(tmp_path, small_images):
    data = write_yolo(tmp_path / "data", 2)
    cache = tmp_path / "cache"
    whole = train(settings_for(data), tmp_path / "whole", data_cache=cache)
    assert whole.best == tmp_path / "whole" / "best.pt"

    def stop(progress):
        if progress.stage == "train" and progress.done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(settings_for(data), tmp_path / "parts", data_cache=cache, progress=stop)
    train(settings_for(data), tmp_path / "parts", data_cache=cache)
    first, second = (
        torch.load(tmp_path / run / "last.pt", weights_only=True) for run in ("whole", "parts")
    )
    assert first["step"] == second["step"] == 3
    assert all(
        torch.equal(value, second["network"][key]) for key, value in first["network"].items()
    )
    assert first["rows"] == second["rows"]
    assert (tmp_path / "whole" / "curve.html").stat().st_size > 0
    assert (
        (tmp_path / "whole" / "curve.csv")
        .read_text()
        .startswith("step,objectness,anchor,class,box,mask,loss,iou")
    )
    assert load_network(whole.best).config == small_images(settings_for(data))
    with pytest.raises(SegmentationError, match="another learning_rate"):
        train(settings_for(data, learning_rate=0.5), tmp_path / "parts", data_cache=cache)
    started = train(
        settings_for(data, iterations=1, init=str(whole.best), cfpn=True),
        tmp_path / "fine",
        data_cache=cache,
    )
    assert started.step == 1


@pytest.mark.slow
@pytest.mark.usefixtures("small_images")
def test_losses_fall_on_a_simple_task(tmp_path):
    data = write_yolo(tmp_path / "data", 2)
    seen = []
    train(
        settings_for(data, iterations=12, batch=2, evaluate_every=12, checkpoint_every=12),
        tmp_path / "run",
        data_cache=tmp_path / "cache",
        progress=lambda p: seen.append(sum(p.values.values())) if p.stage == "train" else None,
    )
    assert np.mean(seen[-3:]) < 0.75 * np.mean(seen[:3])


def test_what_cannot_be_trained_is_refused(tmp_path):
    for classes, words in (
        ("person,unicorn", "'unicorn' is no COCO class"),
        ("person,person", "named twice"),
    ):
        with pytest.raises(SegmentationError, match=words):
            network_config(TrainSettings(classes=classes))
    assert (
        len(network_config(TrainSettings(classes="dynaslam19", network="resnet18")).classes) == 19
    )
    with pytest.raises(SegmentationError, match="no images"):
        train(settings_for(tmp_path / "none"), tmp_path / "run")
    data = write_yolo(tmp_path / "data", 2)
    with pytest.raises(
        SegmentationError, match=r"none of 2 images of yolo:.* shows an object of the classes dog"
    ):
        train(settings_for(data, classes="dog"), tmp_path / "dogs")


# --- evaluation --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_evaluating_a_network_and_writing_the_score(tmp_path):
    data = write_yolo(tmp_path / "data", 3)
    trained = train(
        settings_for(data, iterations=1), tmp_path / "run", data_cache=tmp_path / "cache"
    )
    settings = SegmentationSettings(source=f"weights:{trained.best}", network_side=0)
    score = evaluate_segmenter(settings, f"yolo:{data}", output=tmp_path / "score.json", limit=2)
    assert score.images == 2
    assert score.classes["person"]["truths"] == 2
    assert len(score.weights) == 12
    assert SegmenterScore.read(tmp_path / "score.json") == score
    with pytest.raises(
        SegmentationError, match=r"none of 3 images .* at least 100000 px: nothing is measured"
    ):
        evaluate_segmenter(settings, f"yolo:{data}", min_area=100_000)
    prepared = PreparedImages(
        prepare(open_labelled(f"yolo:{data}"), tmp_path / "cache", 240, 320), ("person",)
    )
    assert len(prepared) == 3
    assert prepared.example(0).labels.tolist() == [1]
    assert prepared.example(0).masks.shape == (1, 240, 320)


# Labels, checkpoints and recorded masks that somebody else made.


SMALL = NetworkConfig(blocks=(1, 1, 1, 1), bottleneck=False, stem=1, channels=1, classes=("person",), box_hidden=1,
                      mask_channels=1, mask_layers=1)  # fmt: skip


@pytest.mark.parametrize(
    "segmentation",
    [
        {"counts": [10**12, 10**12], "size": [6, 8]},
        {"counts": [-1, 49], "size": [6, 8]},
        {"counts": "0" * 5 + "o" * 100_000, "size": [6, 8]},
        {"counts": "o", "size": [6, 8]},
        {"counts": [64], "size": 8},
        {"counts": [1e400], "size": [6, 8]},
        [[1, 1, 1e300, 1, 1, 1e300]],
        [[0, 0, float("nan"), 1, 1, 1]],
        [["a", "b"]],
        [[1, 2, 3]],
        [10**400],
        "text",
    ],
)
def test_a_damaged_mask_is_one_clear_line(tmp_path: Path, segmentation: Any) -> None:
    images = coco_images(str(coco(tmp_path, segmentation)))
    with pytest.raises(SegmentationError, match="a segmentation is"):
        images[0]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"images": [{"id": 1, "file_name": "../../etc/passwd"}]}, "does not lie in"),
        ({"images": [{"id": 1, "file_name": "/etc/passwd"}]}, "does not lie in"),
        ({"images": [{"id": "x"}]}, "is not in COCO's annotation format"),
        ({"images": None}, "is not in COCO's annotation format"),
        ({"annotations": [[]]}, "is not in COCO's annotation format"),
        ({"annotations": [{"image_id": 1e400}]}, "is not in COCO's annotation format"),
        ({"categories": {"a": 1}}, "is not in COCO's annotation format"),
    ],
)
def test_damaged_annotations_are_one_clear_line(
    tmp_path: Path, changes: dict[str, object], words: str
) -> None:
    with pytest.raises(SegmentationError, match=words):
        coco_images(str(coco(tmp_path, [], changes=changes)))


def test_run_lengths_of_any_text_end(tmp_path: Path) -> None:
    assert decode_runs(":d0R1") == [10, 20, 34 + 10 - 10]
    for text in ("o" * 10**6, "o", "Ω"):
        with pytest.raises(ValueError, match=r"the run lengths are damaged"):
            decode_runs(text * 20)


@pytest.mark.parametrize(
    "line",
    [b"-1 0 0 1 1 0 1", b"0 nan 0 1 1 0 1", b"99 0 0", b"\xff", b"0 1e300 0 1 1 1 0", b"9" * 5000],
)
def test_damaged_yolo_labels_are_one_clear_line(tmp_path: Path, line: bytes) -> None:
    for folder in ("images", "labels"):
        (tmp_path / folder).mkdir()
    cv2.imwrite(str(tmp_path / "images" / "a.png"), np.zeros((8, 8, 3), np.uint8))
    (tmp_path / "labels" / "a.txt").write_bytes(line)
    with pytest.raises(SegmentationError, match=r"is no polygon label|is not a text file"):
        yolo_images(str(tmp_path))[0]


def refused(path: Path, content: object, words: str) -> None:
    torch.save(content, path)
    with pytest.raises(SegmentationError, match=words):
        load_network(path)


def test_a_checkpoint_that_claims_a_huge_network_costs_nothing(tmp_path: Path) -> None:
    state = MaskRCNN(SMALL).state_dict()
    huge = SMALL.model_copy(
        update={"stem": 4096, "channels": 4096, "box_hidden": 4096}
    ).model_dump_json()
    for config, words in (
        (huge, r"\d+ shapes differ"),
        (huge.replace("4096", "99999999"), "the network's shape is not understood"),
    ):
        refused(tmp_path / "net.pt", {"format": FORMAT, "config": config, "model": state}, words)


@pytest.mark.parametrize(
    "value", [torch.zeros(1).expand(10**6, 10**6), torch.zeros(4).to_sparse(), torch.zeros(4) * 1j]
)
def test_weights_that_are_no_plain_numbers_are_refused(tmp_path: Path, value: torch.Tensor) -> None:
    state = {**MaskRCNN(SMALL).state_dict(), "backbone.body.conv1.weight": value}
    refused(tmp_path / "net.pt", state, "is no plain array of numbers")


class Command:
    """What an attacker pickles."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("touch owned",)


def test_a_checkpoint_runs_no_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"a": Command()}, "new.pt")
    torch.save({"a": Command()}, "old.pt", _use_new_zipfile_serialization=False)
    Path("plain.pt").write_bytes(pickle.dumps(Command()))
    for name in ("new.pt", "old.pt", "plain.pt"):
        with pytest.raises(SegmentationError, match="is no torch checkpoint of plain weights"):
            load_network(Path(name))
    assert not Path("owned").exists()


def test_a_checkpoint_that_unpacks_to_far_more_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "net.pt", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(1 << 22))
    with pytest.raises(SegmentationError, match="it claims to unpack to 4194304 bytes"):
        load_network(tmp_path / "net.pt")


def test_damaged_prepared_images_are_one_clear_line(tmp_path: Path) -> None:
    np.save(tmp_path / "pickled.npy", np.array([Command()]), allow_pickle=True)
    np.save(tmp_path / "labels.npy", np.zeros((1, 2, 2), np.uint8))
    (tmp_path / "names.json").write_text("[[]]")
    for content in (b"", b"x" * 99, (tmp_path / "pickled.npy").read_bytes()):
        (tmp_path / "images.npy").write_bytes(content)
        with pytest.raises(SegmentationError, match=r"the prepared images in .* are damaged"):
            PreparedImages(tmp_path, ("person",))


def test_a_network_that_is_only_compared_with_a_file_is_made_of_shapes_alone(monkeypatch):
    """Numbers on torch's ``meta`` device take its compiler, and seconds to load that in every run."""
    monkeypatch.setattr(torch.Tensor, "normal_", pytest.fail)  # no numbers are drawn
    with torch.device("meta"):
        network = MaskRCNN(SMALL)
    assert all(weight.is_meta for weight in network.parameters())
    # made of numbers, so not made there
    assert all(not cell.is_meta for cell in network.rpn._cells)
