"""Programs in container images: the command that docker, podman or apptainer gets."""

import os
import shutil
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dynslam_bench.core import SettingsError

ENGINES = ("docker", "podman", "apptainer")
"""Programs that run images, in the order in which they are looked for."""
INSPECT_S = 30.0
"""Seconds that an engine may take to say which image it has."""
_ENDS_WITH_THE_RUN = (
    'exec 3<&0; "$@" <&3 & program=$!; '
    '(while [ -e "$0" ]; do sleep 1; done; kill -9 $program) </dev/null >/dev/null 2>&1 3<&- & '
    "wait $program"
)
"""A container of docker or podman is no child of the run's process, and would go on when that is killed.

So it ends itself when the run's folder is gone, which is removed with every run. Its standard input
is the program's."""
_CONTAINER_VARIABLES = ("CUDA_VISIBLE_DEVICES", "NVIDIA_TF32_OVERRIDE")
"""Variables of a run that mean the same in a container."""


@dataclass(frozen=True)
class Container:
    """An image and what runs it.

    Args:
        engine: ``docker``, ``podman`` or ``apptainer``; empty for the first one that is here.
        image: Name of an image that the engine has, or a ``.sif`` file.
        gpu: Whether the container sees the GPUs.
        here: The folder in which a ``.sif`` file lies; the container sees it, and cannot write there.
    """

    engine: str
    image: str
    gpu: bool
    here: Path

    @property
    def is_file(self) -> bool:
        """Whether the image is a file of apptainer."""
        return self.image.endswith(".sif")

    @property
    def files(self) -> list[Path]:
        """The image where it is a file."""
        return [self.here / self.image] if self.is_file else []

    @property
    def ends_with_its_command(self) -> bool:
        """Whether the processes in the container are children of the engine's command, and measured with it."""
        return self._chosen() == "apptainer"

    def identity(self) -> str:
        """Text that tells one image from another: its digest; of a file its name, as its content counts by itself.

        The image's name where the engine is not here, or has no such image: nothing runs then.
        """
        return self.image if self.is_file else (self._digest() or self.image)

    def check(self) -> None:
        """The engine and the image must be here.

        Raises:
            SettingsError: One is not; says how to get it.
        """
        engine = self._chosen()
        if shutil.which(engine) is None:
            raise SettingsError(
                f"the image '{self.image}' needs {engine}, which is not installed",
                f"install one of {', '.join(ENGINES)}, or name another engine",
            )
        if self.is_file:
            if not self.files[0].is_file():
                raise SettingsError(f"no image {self.files[0]}", f"apptainer pull {self.image} ...")
            return
        if engine == "apptainer":
            raise SettingsError(
                f"apptainer runs image files, and '{self.image}' is none",
                f"apptainer pull NAME.sif docker://{self.image}, and image = 'NAME.sif'",
            )
        if not self._digest():
            raise SettingsError(
                f"{engine} has no image '{self.image}' here, or does not run",
                f"{engine} pull {self.image}",
            )

    def command(
        self,
        words: Sequence[str],
        *,
        work: Path,
        writable: Iterable[Path],
        variables: Mapping[str, str],
        alive: Path,
    ) -> list[str]:
        """The command that runs a program in the image.

        Args:
            words: Program and arguments, as the container sees them: paths are the same inside.
            work: Working folder.
            writable: Folders that it may write.
            variables: Environment variables of the program.
            alive: A file or folder below a writable one that is there as long as the run.
        """
        engine = self._chosen()
        if engine == "apptainer":
            return self._apptainer(words, work, writable, variables)
        return self._docker(engine, words, work, writable, variables, alive)

    def _docker(
        self,
        engine: str,
        words: Sequence[str],
        work: Path,
        writable: Iterable[Path],
        variables: Mapping[str, str],
        alive: Path,
    ) -> list[str]:
        """The command of docker or podman; arguments as of `command`."""
        command = [engine, "run", "--rm", "--interactive", "--network", "none"]

        # files belong to this user
        if engine == "podman":
            command += ["--userns", "keep-id"]
        else:
            command += ["--user", f"{os.getuid()}:{os.getgid()}"]
        if self.gpu:
            command += (
                ["--gpus", "all"] if engine == "docker" else ["--device", "nvidia.com/gpu=all"]
            )

        # the run's folders, and the TOML file's
        command += ["--mount", f"type=bind,source={self.here},target={self.here},readonly"]
        for folder in dict.fromkeys(writable):
            command += ["--mount", f"type=bind,source={folder},target={folder}"]
        command += ["--workdir", str(work)]
        for name, value in {"HOME": str(work), **variables}.items():
            command += ["--env", f"{name}={value}"]

        # the image that was identified, whatever its name stands for by now
        image = self._digest() or self.image
        return [
            *command,
            "--entrypoint",
            "/bin/sh",
            image,
            "-c",
            _ENDS_WITH_THE_RUN,
            str(alive),
            *words,
        ]

    def _apptainer(
        self,
        words: Sequence[str],
        work: Path,
        writable: Iterable[Path],
        variables: Mapping[str, str],
    ) -> list[str]:
        """The command of apptainer; arguments as of `command`."""
        command = ["apptainer", "exec", "--cleanenv", "--no-home"]
        if self.gpu:
            command.append("--nv")
        command += ["--bind", f"{self.here}:{self.here}:ro"]
        for folder in dict.fromkeys(writable):
            command += ["--bind", f"{folder}:{folder}"]
        command += ["--pwd", str(work)]
        for name, value in {"HOME": str(work), **variables}.items():
            command += ["--env", f"{name}={value}"]
        return [*command, str(self.here / self.image), *words]

    def _chosen(self) -> str:
        """The engine's name."""
        if self.engine:
            return self.engine
        if self.is_file:
            return "apptainer"
        there = [engine for engine in ENGINES[:2] if shutil.which(engine)]
        return there[0] if there else ENGINES[0]

    def _digest(self) -> str:
        """The digest by which the engine knows the image; empty where it has none of that name, or does not run."""
        engine = self._chosen()
        if shutil.which(engine) is None or engine == "apptainer":
            return ""
        question = [engine, "image", "inspect", "--format", "{{.Id}}", self.image]
        try:
            answer = subprocess.run(
                question, capture_output=True, text=True, check=False, timeout=INSPECT_S
            )
        except (OSError, subprocess.TimeoutExpired):
            return ""
        return answer.stdout.strip() if answer.returncode == 0 else ""


def container_variables(environment: Mapping[str, str], declared: Iterable[str]) -> dict[str, str]:
    """The variables of a run that a container gets: variables that mean the same there, and declared ones."""
    names = (*_CONTAINER_VARIABLES, *declared)
    return {name: environment[name] for name in names if name in environment}
