"""Time of every segmenter on one 640x480 frame, and of carrying masks; prints a Markdown table.

Run from the checkout:
``python tests/benchmarks/segmentation_speed.py [--threads 2] [--device cuda:0]``. Wall times are
medians; user CPU time stands beside them, because wall times of a busy machine mean little.
"""

import statistics
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from command_line import parser_of, timed

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.segmentation.build_segmenter import build_segmenter
from dynslam_bench.segmentation.networks.backbone import RESNET18, NetworkConfig
from dynslam_bench.segmentation.networks.mask_rcnn_segmenter import MaskRCNNSegmenter
from dynslam_bench.segmentation.networks.network import MaskRCNN
from dynslam_bench.segmentation.postprocess import dynamic_mask
from dynslam_bench.segmentation.schedule import carry_dense, carry_sparse, dense_flow
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.sequences.catalogue import open_sequence

WEIGHTS = Path(__file__).resolve().parents[3] / "shared" / "weights"


def untrained(config: NetworkConfig, side: int, threads: int, device: str) -> MaskRCNNSegmenter:
    """A network with random weights that gives three detections, so that the mask branch has its usual work."""
    torch.manual_seed(0)
    network = MaskRCNN(config.model_copy(update={"max_detections": 3, "classes": ("person",) * 90}))
    network.roi_heads.config = network.config
    network.set_input(side)
    return MaskRCNNSegmenter(
        network, SegmentationSettings(), device=device, threads=threads, floor=0.0
    )


def main() -> None:
    """Print the table."""
    arguments = parser_of(None, threads=2, repeats=7, device="cpu").parse_args()
    cv2.setNumThreads(arguments.threads)
    sequence = open_sequence("synthetic/walking_xyz?scene=120&frames=60")
    frames = [sequence[index] for index in (30, 31)]
    grays = [cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY) for frame in frames]
    rows: list[tuple[str, Callable[[], object]]] = []

    def add(label: str, segmenter: object) -> None:
        frame: Frame = frames[0]
        rows.append((label, lambda: segmenter.segment(frame)))  # type: ignore[attr-defined]

    for name, config, side in (
        ("50", NetworkConfig(), 480),
        ("50", NetworkConfig(), 800),
        ("18", RESNET18, 480),
    ):
        network = untrained(config, side, arguments.threads, arguments.device)
        add(f"Mask R-CNN, ResNet-{name}, CFPN, shorter side {side}", network)
    settings = SegmentationSettings(source="embedded")
    embedded = build_segmenter(settings, device=arguments.device, threads=arguments.threads)
    add("embedded (half-width ResNet-18, CFPN, 320x240)", embedded)
    for name in ("yolov8n-seg_480x640_fp32", "deeplabv3_mnv2_voc_481x641"):
        if (WEIGHTS / f"{name}.onnx").is_file():
            settings = SegmentationSettings(source=f"onnx:{WEIGHTS / name}.onnx")
            add(name, build_segmenter(settings, threads=arguments.threads))
    oracle = build_segmenter(SegmentationSettings(source="oracle"), masks=sequence.masks)
    assert oracle is not None
    found = oracle.segment(frames[0])
    depth = np.ascontiguousarray(frames[0].depth)
    rows.append((f"carry {len(found)} masks, dis", lambda: carry_dense(found, dense_flow(*grays))))
    rows.append((f"carry {len(found)} masks, sparse", lambda: carry_sparse(found, *grays)))
    rows.append(("dilation by 15 px", lambda: dynamic_mask(found, SegmentationSettings())))
    rows.append(
        (
            "depth repair and dilation",
            lambda: dynamic_mask(found, SegmentationSettings(repair="depth"), depth),
        )
    )
    print("| stage | wall ms | CPU ms |\n| --- | --- | --- |")
    for label, work in rows:
        wall, cpu = map(statistics.median, timed(work, arguments.repeats))
        print(f"| {label} | {wall:.1f} | {cpu:.1f} |", flush=True)


if __name__ == "__main__":
    main()
