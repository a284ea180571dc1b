"""A tracker that behaves badly in ways that concern the process and not the poses, for the tests of supervision."""

import contextlib
import ctypes
import errno
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import psutil

from dynslam_bench.contracts.tracker import TrackerSpec, TrackResult
from dynslam_bench.core.settings import Settings

DEAF = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(300)"
SLEEPER = [sys.executable, "-S", "-c", DEAF]


class HostileSettings(Settings):
    mode: str = "ok"
    at: int = 2
    pids: str = ""
    """File that the processes it starts are written to, one a line."""


class Hostile:
    """Stands still; on frame `at` it does what `mode` says."""

    def __init__(self, settings: HostileSettings) -> None:
        self.settings = settings
        if settings.mode.startswith("build-"):
            self.act(settings.mode.removeprefix("build-"))

    def reset(self, camera, *, rng) -> None:
        self.seen = 0

    def track(self, frame) -> TrackResult:
        if frame.index == self.settings.at:
            self.act(self.settings.mode)
        return TrackResult(np.eye(4), "ok")

    def note(self, *pids: int) -> None:
        with Path(self.settings.pids).open("a") as file:
            file.writelines(f"{pid}\n" for pid in pids)

    def act(self, mode: str) -> None:
        match mode:
            case "sys.exit":
                sys.exit(0)
            case "os._exit":
                os._exit(0)
            case "hang":
                while True:
                    time.sleep(0.1)
            case "segfault":
                os.kill(os.getpid(), signal.SIGSEGV)
            case "deaf":
                signal.signal(signal.SIGTERM, signal.SIG_IGN)
                time.sleep(300)
            case "raise":
                raise ValueError("too few\npoints")
            case "variable":
                raise ValueError(os.environ.get("DYNSLAM_BENCH_TESTED", "not set"))
            case "full":
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            case "gone":
                shutil.rmtree(self.settings.pids)
                raise ValueError("no folder")
            case "gone-quietly":
                shutil.rmtree(self.settings.pids)
            case "moved":
                Path(self.settings.pids).rename(f"{self.settings.pids}-moved")
            case "made-again":
                for folder in Path(self.settings.pids).glob("runs/.*.tmp"):
                    shutil.rmtree(folder)
                    folder.mkdir()
            case "log-gone":
                for log in Path(self.settings.pids).glob("runs/.*.tmp/frames.jsonl"):
                    log.unlink()
            case "kill-parent":
                os.kill(os.getppid(), signal.SIGKILL)
            case "end-parents-group":
                os.killpg(os.getpgid(os.getppid()), signal.SIGTERM)
            case "kill-program":
                psutil.Process().parents()[1].kill()
            case "ask-parent":
                os.kill(os.getppid(), 0)
            case "c-kill-parent":
                ctypes.CDLL(None).kill(os.getppid(), signal.SIGKILL)
                time.sleep(300)
            case "shell-kill-parent":
                subprocess.run(["kill", "-KILL", str(os.getppid())], check=False)
                time.sleep(300)
            case "children":
                self.leave_children()
            case "flood":
                print("the first line")
                for _ in range(300):
                    os.write(1, b"the same line over and over\n" * 2000)
                print("the last line")
            case "shared":
                self.share()
            case "hog-child":
                self.note(subprocess.Popen([sys.executable, "-S", "-c", HOG]).pid)
                time.sleep(300)
            case "thread":
                threading.Thread(target=time.sleep, args=(300,)).start()

    def leave_children(self) -> None:
        """One in its own process group, one in a session of its own, one whose parent is gone (a daemon)."""
        self.note(
            subprocess.Popen(SLEEPER).pid, subprocess.Popen(SLEEPER, start_new_session=True).pid
        )
        middle = os.fork()
        if middle == 0:
            os.setsid()
            self.note(subprocess.Popen(SLEEPER, start_new_session=True).pid)
            os._exit(0)
        os.waitpid(middle, 0)

    def share(self) -> None:
        """300 MB, and three forks that share them."""
        self.hoard = np.ones(300 * 2**17)
        for _ in range(3):
            pid = os.fork()
            if pid == 0:
                time.sleep(300)
                os._exit(0)
            self.note(pid)
        time.sleep(0.7)


def alive(pids: list[int]) -> list[int]:
    """The processes that still run; a zombie does not."""
    running = []
    for pid in pids:
        with contextlib.suppress(psutil.NoSuchProcess):
            if psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
                running.append(pid)
    return running


HOG = "import time; hoard = [b'x' * 2**24 for _ in range(100)]; time.sleep(300)"


class BlackHater(Hostile):
    """Leaves the process on a black image."""

    def track(self, frame) -> TrackResult:
        if not frame.rgb.any():
            os._exit(0)
        return TrackResult(np.eye(4), "ok")


def _spec(name: str) -> TrackerSpec:
    return TrackerSpec(
        id=name.lower(), entry_point=f"{__file__}:{name}", label=name, settings=HostileSettings
    )


SPEC = _spec("Hostile")
BLACK = _spec("BlackHater")
TARGET = f"{__file__}:SPEC"
