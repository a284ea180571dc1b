"""The program's side of the JSON-lines protocol, for trackers in Python that run in a process of their own."""

import json
import os
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Answer = dict[str, Any]
"""Fields of an answer, which become one JSON object."""


def serve(
    reset: Callable[[dict[str, Any]], None],
    track: Callable[[int, float, NDArray[np.uint8], NDArray[np.float32]], Answer],
    finalize: Callable[[], list[list[float]]] | None = None,
) -> None:
    """Answer requests on standard input until ``close`` or its end.

    Whatever is written to standard output in the meantime, by C++ threads too, goes to standard
    error, so that it cannot get between the answers. The process also ends when its parent has
    died. An exception becomes an ``error`` answer. Only images handed over as ``raw`` are
    understood.

    Args:
        reset: Called with the ``reset`` request.
        track: Called with index, stamp, colour ``[H, W, 3]`` and depth ``[H, W]``; returns the
            answer's fields.
        finalize: Returns rows ``[timestamp, tx, ty, tz, qx, qy, qz, qw]``; None if there is no
            final trajectory.
    """
    # answers go to the real standard output, everything else to standard error
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    sys.stdout.flush()
    os.dup2(2, 1)
    _end_with_parent()
    images: tuple[NDArray[np.uint8], NDArray[np.float32]] | None = None
    for line in sys.stdin:
        request = json.loads(line)
        operation = request.get("op")
        answer = Answer()
        try:
            if operation == "reset":
                images = map_images(request)
                answer = {"ok": True}
                reset(request)
            elif operation == "track":
                if images is None:
                    raise RuntimeError("track before reset")
                index = int(request["index"])
                answer = {"index": index, **track(index, float(request["timestamp"]), *images)}
            elif operation == "finalize" and finalize is not None:
                answer = {"trajectory": finalize()}
            elif operation == "close":
                break
            else:
                raise RuntimeError(f"unknown op {operation!r}")
        except Exception as error:
            # every one is for the other side to report
            answer = {"error": f"{type(error).__name__}: {error}"}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


def map_images(request: dict[str, Any]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Views of the colour ``[H, W, 3]`` and depth ``[H, W]`` image that a ``reset`` announces.

    Raises:
        ValueError: The images do not come as ``raw``.
    """
    images = request["images"]
    camera = request["camera"]
    if images["mode"] != "raw":
        raise ValueError(
            f"images come as '{images['mode']}', only 'raw' is understood; set images=raw"
        )
    height = int(camera["height"])
    width = int(camera["width"])
    memory = np.memmap(images["file"], np.uint8, "r", shape=(int(images["bytes"]),))
    start = int(images["rgb_offset"])
    depth_start = int(images["depth_offset"])
    rgb = memory[start : start + height * width * 3].reshape(height, width, 3)
    depth = memory[depth_start : depth_start + height * width * 4].view("<f4")
    return rgb, depth.reshape(height, width)


def _end_with_parent() -> None:
    """End this process soon after its parent has died, even if a call never comes back."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
