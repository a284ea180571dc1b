"""How conformance checks are run and reported."""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Literal, Protocol


class ConformanceError(AssertionError):
    """A plug-in breaks its contract; the message names the check, what was found and the likely cause."""


class NotApplicable(Exception):
    """A check does not apply to this subject; the message says why."""


@dataclass(frozen=True)
class Check:
    """The outcome of one check.

    Attributes:
        name: What was checked.
        status: How it ended.
        message: What was found and the likely cause, or why it does not apply; empty if passed.
    """

    name: str
    status: Literal["passed", "failed", "skipped"]
    message: str = ""


class Observer(Protocol):
    """Follows the checks of a report while they run; see `isolated`."""

    def verdict(self, name: str) -> Check | None:
        """The outcome of a check that is known already and need not be found out; else it begins now."""

    def alive(self) -> None:
        """A check got on a little."""

    def ended(self, check: Check) -> None:
        """A check came to its end."""


OBSERVER: ContextVar[Observer | None] = ContextVar("OBSERVER", default=None)
"""Who is told of the checks; nobody by default."""


def still_alive() -> None:
    """Tell whoever follows that a check has got on; for checks that take long."""
    observer = OBSERVER.get()
    if observer is not None:
        observer.alive()


@dataclass
class ConformanceReport:
    """The checks that were run on one subject.

    Attributes:
        subject: What was checked, for messages.
        checks: Outcomes in the order in which they were run.
    """

    subject: str
    checks: list[Check] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether no check failed."""
        return not self.failed

    @property
    def failed(self) -> list[Check]:
        """The checks that failed."""
        return [check for check in self.checks if check.status == "failed"]

    def run(self, name: str, check: Callable[[], None]) -> bool:
        """Run one check; whatever it raises is its outcome. True unless it failed."""
        observer = OBSERVER.get()
        outcome = None if observer is None else observer.verdict(name)
        if outcome is None:
            outcome = _outcome(name, check)
            if observer is not None:
                observer.ended(outcome)
        self.checks.append(outcome)
        return outcome.status != "failed"

    def raise_for_failures(self) -> None:
        """Raise if any check failed.

        Raises:
            ConformanceError: Names every failed check with its message.
        """
        if self.failed:
            lines = "".join(f"\n  {check.name}: {check.message}" for check in self.failed)
            raise ConformanceError(f"{self.subject} fails {len(self.failed)} of {len(self.checks)} checks:{lines}")


def _outcome(name: str, check: Callable[[], None]) -> Check:
    try:
        check()
    except NotApplicable as reason:
        return Check(name, "skipped", str(reason))
    except ConformanceError as error:
        return Check(name, "failed", str(error))
    except Exception as error:  # the subject's own code may raise anything: that is what is tested
        return Check(name, "failed", f"raised {type(error).__name__}: {error}")
    except SystemExit as error:
        return Check(name, "failed", f"called sys.exit({error.code!r}) (a tracker raises, it never exits)")
    return Check(name, "passed")


def require(condition: object, found: str, cause: str = "") -> None:
    """Raise unless the condition holds.

    Args:
        condition: What must hold.
        found: What was found in its place.
        cause: The likely cause.

    Raises:
        ConformanceError: It does not hold.
    """
    if not condition:
        raise ConformanceError(f"{found} (likely cause: {cause})" if cause else found)
