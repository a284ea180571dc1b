"""Where and with what a run was made."""

from __future__ import annotations

import os
import platform
import subprocess
from functools import cache
from pathlib import Path

import dynslam_bench

from .fingerprint import distribution_version, opencv_version
from .records import Record

PACKAGES = ("numpy", "scipy", "torch", "numba", "gtsam", "gymnasium", "optuna")


class Machine(Record):
    """The computer, without its name.

    Attributes:
        cpu: Model name.
        cores: Logical processors that the process may use.
        memory_gb: Main memory.
        system: Operating system and architecture.
        gpu: Name of the GPU the run used, empty without one.
    """

    cpu: str
    cores: int
    memory_gb: float
    system: str
    gpu: str = ""


class GitRevision(Record):
    """The checkout the package was imported from.

    Attributes:
        revision: Commit hash.
        dirty: Whether tracked files differ from it.
    """

    revision: str
    dirty: bool


@cache
def this_machine() -> Machine:
    """This computer."""
    affinity = getattr(os, "sched_getaffinity", None)
    return Machine(
        cpu=_cpu_model(),
        cores=len(affinity(0)) if affinity is not None else os.cpu_count() or 1,
        memory_gb=round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        system=f"{platform.system()} {platform.release()} {platform.machine()}",
    )


@cache
def versions() -> dict[str, str]:
    """Versions of Python, of this package and of those that a result depends on; missing ones are left out."""
    found = {"python": platform.python_version(), "dynslam-bench": dynslam_bench.__version__}
    for name in PACKAGES:
        installed = distribution_version(name)
        if installed:
            found[name] = installed
    if opencv_version():
        found["opencv"] = opencv_version()
    return found


@cache
def git_revision() -> GitRevision | None:
    """The commit of the checkout that the package lies in; None for an installed package or without git."""
    checkout = Path(dynslam_bench.__file__).resolve().parent.parent
    if not (checkout / "pyproject.toml").is_file() or not (checkout / ".git").exists():
        return None
    try:
        revision = _git(checkout, "rev-parse", "HEAD")
        changes = _git(checkout, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return None
    return GitRevision(revision=revision, dirty=bool(changes))


def _git(folder: Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=10).stdout.strip()


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(errors="replace").splitlines():
            if line.lower().startswith(("model name", "hardware")):
                return line.partition(":")[2].strip()
    if platform.system() == "Darwin":
        try:
            command = ["sysctl", "-n", "machdep.cpu.brand_string"]
            return subprocess.run(command, check=True, capture_output=True, text=True, timeout=5).stdout.strip()
        except (OSError, subprocess.SubprocessError):
            return platform.processor()
    return platform.processor() or platform.machine()
