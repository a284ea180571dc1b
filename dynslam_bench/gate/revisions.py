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
from dynslam_bench.runs.process.process_trees import end_tree
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
        lines = ended.stderr.strip().splitlines() or [f"exit code {ended.returncode}"]
        # advice may follow the fault
        fatal = [line for line in lines if line.startswith("fatal:")]
        raise RunError(f"git {arguments[0]}: {(fatal or lines)[-1]}")
    return ended.stdout.strip()


def repository_of(folder: Path) -> Path | None:
    """The top folder of the repository that a folder lies in; None where it lies in none.

    Raises:
        RunError: Git refuses to read it, e.g. because the folder belongs to another user.
    """
    try:
        return Path(git(folder, "rev-parse", "--show-toplevel"))
    except RunError as error:
        # git looks upwards for a folder .git; where there is one, it had another reason
        above = (folder.absolute(), *folder.absolute().parents)
        if any((place / ".git").exists() for place in above):
            raise RunError(
                f"git does not read the repository of {folder}: {error.args[0]}",
                f"in containers often: git config --global --add safe.directory {folder}",
            ) from None
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
    ignored = {path.resolve() for path in own}
    changed = git(top, "diff", "--name-only", "-z", "HEAD").split("\0")
    uncommitted = [name for name in changed if name and (top / name).resolve() not in ignored]
    return Origin(name=WORKING_TREE, revision=revision, uncommitted=uncommitted)


def untracked_files(folder: Path, own: tuple[Path, ...] = ()) -> list[str]:
    """Files of the working tree that git neither tracks nor ignores: no revision holds them.

    Args:
        folder: A folder in it.
        own: Files and folders of the gate, which do not count.
    """
    top = repository_of(folder)
    if top is None:
        return []
    names = git(top, "ls-files", "-z", "--others", "--exclude-standard").split("\0")
    ignored = {path.resolve() for path in own}
    return [name for name in names if name and not _lies_in((top / name).resolve(), ignored)]


def _lies_in(file: Path, places: set[Path]) -> bool:
    """Whether a file is one of some places, or lies below one."""
    return not places.isdisjoint((file, *file.parents))


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
    asked = f"{revision}^{{commit}}"
    try:
        commit = git(folder, "rev-parse", "--verify", "--quiet", asked)
    except RunError:
        commit = ""
    # of "^HEAD" git makes a revision that is left out
    if not commit.isalnum():
        raise RunError(
            f"there is no revision '{revision}' in {repository_of(folder)}",
            "list them with git log --all --oneline; a shallow clone lacks old ones: git fetch --unshallow",
        )
    return commit


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


def build(command: str, folder: Path, name: str, minutes: float) -> None:
    """Run the command that builds a checkout.

    Args:
        command: For the shell; empty for none.
        folder: Folder in which the command runs.
        name: What is built, for messages.
        minutes: Longest time that it may take.

    Raises:
        RunError: It fails, or does not end in time; quotes its last lines.
    """
    if not command:
        return
    with tempfile.TemporaryFile("w+", errors="replace") as log:
        # without standard input: a question of the build ends it
        process = subprocess.Popen(
            command,
            shell=True,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        # it has a group of its own: a build that hangs, and one that is interrupted, end with all they started
        code: int | None = None
        try:
            code = process.wait(timeout=60.0 * minutes)
        except subprocess.TimeoutExpired:
            pass
        finally:
            if code is None:
                end_tree(process.pid)
                process.wait()
        log.seek(0)
        last = " | ".join(deque((line.strip() for line in log if line.strip()), maxlen=_LAST_LINES))
    words = last or "it wrote nothing"
    if code is None:
        raise RunError(
            f"the build of {name} did not end in {minutes:g} minutes: {words}",
            f"try it there: {command}; or raise build_minutes in the question",
        )
    if code != 0:
        raise RunError(
            f"the build of {name} failed with exit code {code}: {words}",
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
