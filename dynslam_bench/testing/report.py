"""How conformance checks are run and reported."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal


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
        try:
            check()
        except NotApplicable as reason:
            self.checks.append(Check(name, "skipped", str(reason)))
        except ConformanceError as error:
            self.checks.append(Check(name, "failed", str(error)))
            return False
        except Exception as error:  # the subject's own code may raise anything: that is what is tested
            self.checks.append(Check(name, "failed", f"raised {type(error).__name__}: {error}"))
            return False
        else:
            self.checks.append(Check(name, "passed"))
        return True

    def raise_for_failures(self) -> None:
        """Raise if any check failed.

        Raises:
            ConformanceError: Names every failed check with its message.
        """
        if self.failed:
            lines = "".join(f"\n  {check.name}: {check.message}" for check in self.failed)
            raise ConformanceError(f"{self.subject} fails {len(self.failed)} of {len(self.checks)} checks:{lines}")


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
