"""The errors a user can cause; everything else is a bug and keeps its traceback.

Each message is one line: what was found (with the measured numbers), what was expected. The `hint`
says what to do.
"""

import difflib
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dynslam_bench.core.sanitise import without_passwords


class DynslamError(Exception):
    """Base of all errors that the user of the toolkit can cause and cure.

    Whatever the message names, it is one line of bounded length, and the passwords of addresses are
    left out.

    Args:
        message: One line with the measured numbers and the expectation.
        hint: One line that says how to cure it; empty if there is nothing to add.
        options: Several cures to choose from, a line each; the command line writes them below each
            other.
        template: A file to copy and complete, of several lines; the command line writes it as it
            stands.
    """

    def __init__(
        self, message: str, hint: str = "", *, options: Iterable[str] = (), template: str = ""
    ) -> None:
        super().__init__(_one_line(str(message)))
        self.hint = _one_line(hint)
        self.options = tuple(_one_line(option) for option in options)
        self.template = template

    @property
    def headline(self) -> str:
        """The message with its hint, without the options."""
        message = str(self.args[0])
        return f"{message} ({self.hint})" if self.hint else message

    def __str__(self) -> str:
        text = self.headline
        if self.options:
            text += f" (choose: {'; '.join(self.options)})"
        if self.template:
            statements = [line.partition("  #")[0].strip() for line in self.template.splitlines()]
            text += f" (template: {'; '.join(line for line in statements if '=' in line)})"
        return text

    def __reduce__(self) -> tuple[Any, ...]:
        return (
            type(self),
            (str(self.args[0]), self.hint),
            {"options": self.options, "template": self.template},
        )


LONGEST = 1000
"""Characters of the longest message, and of the longest hint."""


_HIDDEN_FOLDERS: list[str] = []
"""Beginnings of paths that messages leave out, see `hide_folder_in_messages`."""


def hide_folder_in_messages(folder: Path) -> Path:
    """Leave a temporary folder's path out of messages, which then name what lies below it, e.g. in an archive.

    Returns:
        The folder.
    """
    _HIDDEN_FOLDERS.append(f"{folder}{os.sep}")
    return folder


def hidden_folders() -> list[Path]:
    """The folders that messages of this process leave out, for a process that goes on with its work."""
    return [Path(folder) for folder in _HIDDEN_FOLDERS]


def _one_line(text: str) -> str:
    """The text as one line without passwords; of a long one its beginning and its end."""
    text = without_passwords(" ".join(text.splitlines()))
    for folder in _HIDDEN_FOLDERS:
        text = text.replace(folder, "")
    if len(text) <= LONGEST:
        return text
    return f"{text[: LONGEST // 2]} [...] {text[-LONGEST // 2 :]}"


class SettingsError(DynslamError):
    """A setting is unknown, has the wrong type or lies outside its limits."""


class SequenceError(DynslamError):
    """A sequence is unknown, missing, damaged or lacks what was asked of it."""


class TrajectoryError(DynslamError):
    """A trajectory file cannot be read, or a trajectory is not what it has to be."""


class EvaluationError(DynslamError):
    """A trajectory cannot be evaluated under the protocol."""


class SegmentationError(DynslamError):
    """A segmenter cannot be built or its network gives outputs that are not understood."""


class PluginError(DynslamError):
    """A plug-in is unknown, cannot be loaded or breaks its contract."""


class TrackerError(DynslamError):
    """A tracker cannot be built, or broke its contract while it ran."""


class TrackerTimeoutError(TrackerError):
    """An external program did not end in the time that it was given."""


class DownloadError(DynslamError):
    """A file cannot be downloaded."""


class RunError(DynslamError):
    """A run cannot be started, stored or found."""


class InfrastructureError(RunError):
    """A fault of what a run needs, not of the run: a full disk, a process that was killed.

    It is no outcome of a tracker, so nothing is stored, and the same command goes on from there.
    """


class StudyError(DynslamError):
    """A tuning study is ill-defined or does not fit what is stored under its name."""


class ReportError(DynslamError):
    """A report cannot be made of what was given."""


@contextmanager
def translate_errors(
    kind: type[DynslamError],
    message: str,
    hint: str = "",
    *,
    of: type[Exception] | tuple[type[Exception], ...] = OSError,
) -> Iterator[None]:
    """Turn what a library raises in the block into one line: the message, a colon, the reason.

    Args:
        kind: What is raised; errors of this package pass as they are.
        message: What cannot be done, or what is damaged.
        hint: One line that says how to cure it.
        of: What is caught.

    Raises:
        DynslamError: Raised as `kind`: the block raised an exception of the class `of`.
    """
    try:
        yield
    except DynslamError:
        raise
    except of as error:
        raise kind(f"{message}: {reason_of(error)}", hint) from error


def reason_of(error: BaseException) -> str:
    """Reason for an error in the words of the library or of the system, one short line."""
    if isinstance(error, shutil.Error) and error.args and isinstance(error.args[0], list):
        source, _, reason = error.args[0][0]  # a folder could not be copied: the first of its files
        return f"{reason} ({source})"
    words_of_system = getattr(error, "strerror", None)
    words_of_library = " ".join(str(error).split())[:200]
    return words_of_system or words_of_library or type(error).__name__


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A hint naming the closest known names, or listing them all if there are few.

    Args:
        name: What the user wrote.
        known: The names that exist.

    Returns:
        For example ``"did you mean 'epipolar.threshold_px'?"``; empty if nothing is known.
    """
    # upper and lower case do not count
    wanted = name.lower()
    names = sorted(set(known))
    if not names:
        return ""

    spellings = {candidate.lower() for candidate in names}
    meant: list[str] = []
    for match in difflib.get_close_matches(wanted, spellings, n=3, cutoff=0.5):
        meant += [repr(candidate) for candidate in names if candidate.lower() == match]

    if meant:
        return f"did you mean {' or '.join(meant)}?"
    if len(names) <= 16:
        return "known: " + ", ".join(names)
    return f"{len(names)} are known, none is close"
