"""Which device a run computes on."""

from __future__ import annotations

import re
from pathlib import Path

from dynslam_bench.core.errors import SettingsError


def resolve_device(name: str = "auto") -> str:
    """``cpu`` or ``cuda:N`` for ``auto``, ``cpu``, ``cuda`` or ``cuda:N``.

    ``auto`` is the first CUDA device, or the CPU where there is none. Torch is imported only if a driver is present.

    Raises:
        SettingsError: The name is not understood, or the machine has no such device.
    """
    if name == "cpu":
        return "cpu"
    if name != "auto" and not re.fullmatch(r"cuda(:\d+)?", name):
        raise SettingsError(f"unknown device '{name}'", "write auto, cpu, cuda or cuda:N")
    count = _cuda_devices()
    if name == "auto":
        return "cuda:0" if count else "cpu"
    index = int(name.partition(":")[2] or 0)
    if index >= count:
        raise SettingsError(f"device '{name}' was asked for, this machine has {count} CUDA devices", "use --device cpu")
    return f"cuda:{index}"


def _cuda_devices() -> int:
    if not any(Path(node).exists() for node in ("/dev/nvidiactl", "/dev/dxg", "/dev/kfd")):
        return 0
    import torch

    return torch.cuda.device_count() if torch.cuda.is_available() else 0
