"""Revisions of the repository that holds a gate: checked out beside it, built, and run in processes of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dynslam_bench.core import InfrastructureError, RunError, translate_errors
from dynslam_bench.gate import worker
from dynslam_bench.gate.baseline import Origin
from dynslam_bench.runs.spec import RunSpec

WORKING_TREE = "the working tree"
_LAST_LINES = 3
"""Lines of a failed build that its error quotes."""


def git(folder: Path, *arguments: str) -> str:
    """The output of a git command in a folder, without white space around it.

    Raises:
        RunError: Git is not installed, or refuses.
    """
    command = ["git", "-C", str(folder), *arguments]
    with translate_errors(RunError, "git cannot be started", "install git"):
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
    if ended.returncode != 0:
        words = ended.stderr.strip().splitlines() or [f"exit code {ended.returncode}"]
        raise RunError(f"git {arguments[0]}: {words[-1]}")
    return ended.stdout.strip()


def repository_of(folder: Path) -> Path | None:
    """The top folder of the repository that a folder lies in; None where it lies in none."""
    try:
        return Path(git(folder, "rev-parse", "--show-toplevel"))
    except RunError:
        return None


def working_tree(folder: Path, own: tuple[Path, ...] = ()) -> Origin:
    """The working tree: its commit, and tracked files that differ from it.

    Args:
        folder: A folder in it.
        own: Files of the gate, whose changes do not count.
    """
    top = repository_of(folder)
    if top is None:
        return Origin(name=WORKING_TREE)
    try:
        revision = git(top, "rev-parse", "HEAD")
    except RunError:  # nothing is committed yet
        return Origin(name=WORKING_TREE)
    lines = git(top, "status", "--porcelain", "--untracked-files=no").splitlines()
    ignored = {path.resolve() for path in own}
    changed = [line.split(maxsplit=1)[1] for line in lines]
    uncommitted = [name for name in changed if (top / name).resolve() not in ignored]
    return Origin(name=WORKING_TREE, revision=revision, uncommitted=uncommitted)


def commit_of(folder: Path, revision: str) -> str:
    """The full hash of a revision.

    Raises:
        RunError: The folder lies in no repository, or has no such revision.
    """
    if repository_of(folder) is None:
        raise RunError(
            f"{folder} lies in no git repository, so it has no revision {revision}",
            "run git init and commit, or name a folder in a repository",
        )
    try:
        return git(folder, "rev-parse", "--verify", "--quiet", f"{revision}^{{commit}}")
    except RunError:
        raise RunError(
            f"there is no revision '{revision}' in {repository_of(folder)}",
            "list them with git log --all --oneline; a shallow clone lacks old ones: git fetch --unshallow",
        ) from None


@contextmanager
def checked_out(folder: Path, revision: str) -> Iterator[Path]:
    """A checkout of a revision in a temporary folder, removed afterwards.

    Args:
        folder: A folder in the repository.
        revision: The commit.

    Yields:
        The counterpart of `folder` in the checkout.

    Raises:
        RunError: Git cannot check it out, or the revision lacks the folder.
    """
    top = repository_of(folder)
    if top is None:
        raise RunError(f"{folder} lies in no git repository")
    with tempfile.TemporaryDirectory(prefix="dynslam-gate-") as temporary:
        place = Path(temporary) / revision[:12]
        git(top, "worktree", "add", "--detach", "--force", str(place), revision)
        try:
            if (place / ".gitmodules").is_file():
                git(place, "submodule", "update", "--init", "--recursive")
            same = place / folder.resolve().relative_to(top.resolve())
            if not same.is_dir():
                raise RunError(f"revision {revision[:12]} has no folder {same.relative_to(place)}")
            yield same
        finally:
            git(top, "worktree", "remove", "--force", str(place))


def build(command: str, folder: Path, name: str) -> None:
    """Run the command that builds a checkout.

    Args:
        command: For the shell; empty for none.
        folder: Folder in which the command runs.
        name: What is built, for messages.

    Raises:
        RunError: It fails; quotes its last lines.
    """
    if not command:
        return
    with tempfile.TemporaryFile("w+", errors="replace") as log:
        ended = subprocess.run(
            command, shell=True, cwd=folder, stdout=log, stderr=subprocess.STDOUT, check=False
        )
        log.seek(0)
        last = deque((line.strip() for line in log if line.strip()), maxlen=_LAST_LINES)
    if ended.returncode != 0:
        raise RunError(
            f"the build of {name} failed with exit code {ended.returncode}: {' | '.join(last)}",
            f"try it there: {command}",
        )


class Runner:
    """A process that makes runs in one checkout.

    Args:
        folder: Its working folder: the gate's, in the checkout.
        results: Its results folder.
        environment: Further environment variables; ``{folder}`` is the working folder.
    """

    def __init__(self, folder: Path, results: Path, environment: Mapping[str, str]) -> None:
        self.results = results
        added = {
            name: value.replace("{folder}", str(folder)) for name, value in environment.items()
        }
        self._process = subprocess.Popen(
            [sys.executable, str(Path(worker.__file__).resolve())],
            cwd=folder,
            env=os.environ | added,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> Runner:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End the process; after an error or an interrupt without waiting for its run."""
        if kind is not None:
            self._process.terminate()
        if self._process.stdin is not None:
            self._process.stdin.close()
        self._process.wait()

    def run(self, spec: RunSpec) -> str:
        """Make a run.

        Returns:
            Its id in the results folder.

        Raises:
            RunError: It cannot be made: no outcome of the system.
            InfrastructureError: The process has ended.
        """
        # what has its default is left out: another version may not know it
        asked = spec.model_dump(mode="json", exclude_defaults=True)
        answer = self._ask({"spec": asked, "results": str(self.results)})
        if "error" in answer:
            raise RunError(answer["error"], answer.get("hint", ""))
        return str(answer["run_id"])

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        """Send a request as a line of JSON, and wait for the line of its answer.

        Raises:
            InfrastructureError: The process has ended.
        """
        asked = self._process.stdin
        answers = self._process.stdout
        line = ""
        if asked is not None and answers is not None:
            try:
                asked.write(json.dumps(request) + "\n")
                asked.flush()
                line = answers.readline()
            except BrokenPipeError:
                line = ""
        if not line:
            raise InfrastructureError(
                f"the process that makes the runs ended with code {self._process.wait()}",
                "its last lines are above; nothing is judged",
            )
        answer: dict[str, Any] = json.loads(line)
        return answer
