"""Runs and reports of conformance checks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray


class ConformanceError(AssertionError):
    """A plug-in breaks its contract; the message names the check, the measured value and the likely cause."""


class NotApplicable(Exception):
    """A check does not apply to this subject; the message says why."""


@dataclass(frozen=True)
class Check:
    """The outcome of one check.

    Attributes:
        name: What was checked.
        status: How it ended.
        message: The fault and its likely cause, or why the check does not apply; empty if passed.
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

    @classmethod
    def of(cls, kind: str, construct: object) -> ConformanceReport:
        """An empty report on what a function constructs."""
        return cls(f"{kind} {getattr(construct, '__name__', type(construct).__name__)!r}")

    @property
    def ok(self) -> bool:
        """Whether no check failed."""
        return not self.failed

    @property
    def failed(self) -> list[Check]:
        """The checks that failed."""
        return [check for check in self.checks if check.status == "failed"]

    def run(self, name: str, check: Callable[[], object]) -> bool:
        """Run one check; an exception of any kind is its outcome. True unless the check failed."""
        try:
            check()
            outcome = Check(name, "passed")
        except NotApplicable as reason:
            outcome = Check(name, "skipped", str(reason))
        except ConformanceError as error:
            outcome = Check(name, "failed", str(error))
        # the subject's own code may raise anything: that is what is tested
        except Exception as error:
            outcome = Check(name, "failed", f"raised {type(error).__name__}: {error}")
        except SystemExit as error:
            outcome = Check(
                name,
                "failed",
                f"called sys.exit({error.code!r}) (a tracker raises, it never exits)",
            )
        self.checks.append(outcome)
        return outcome.status != "failed"

    def run_all(
        self, needed: Mapping[str, Callable[[], object]], others: Mapping[str, Callable[[], object]]
    ) -> ConformanceReport:
        """Run checks by name: the needed ones until one fails; if none does, all others, whatever each gives.

        Returns:
            This report.
        """
        if all(self.run(name, check) for name, check in needed.items()):
            for name, check in others.items():
                self.run(name, check)
        return self

    def alive(self) -> None:
        """Called while a check makes progress."""

    def raise_for_failures(self) -> None:
        """Raise if any check failed.

        Raises:
            ConformanceError: Names every failed check with its message.
        """
        if self.failed:
            lines = "".join(f"\n  {check.name}: {check.message}" for check in self.failed)
            raise ConformanceError(
                f"{self.subject} fails {len(self.failed)} of {len(self.checks)} checks:{lines}"
            )


def require(condition: object, fault: str, cause: str = "") -> None:
    """Raise unless the condition holds.

    Args:
        condition: What must hold.
        fault: What is there in its place.
        cause: The likely cause.

    Raises:
        ConformanceError: It does not hold.
    """
    if not condition:
        raise ConformanceError(f"{fault} (likely cause: {cause})" if cause else fault)


def require_all(*rules: tuple[object, str] | tuple[object, str, str]) -> None:
    """`require` for each of several rules, in their order.

    Raises:
        ConformanceError: The first that does not hold.
    """
    for rule in rules:
        require(*rule)


def require_equal(
    first: object, second: object, names: Sequence[str], fault: str, cause: str
) -> None:
    """Raise unless two results have the same arrays, or other values, under these names.

    Args:
        first: A result.
        second: The result that it is compared with.
        names: Attributes that are compared.
        fault: What is there in place of equal results.
        cause: The likely cause.

    Raises:
        ConformanceError: They have not.
    """
    require(
        all(np.array_equal(getattr(first, name), getattr(second, name)) for name in names),
        fault,
        cause,
    )


def require_methods(candidate: object, *names: str) -> None:
    """Raise unless an object has all methods.

    Raises:
        ConformanceError: Names the missing ones.
    """
    missing = [f"{name}()" for name in names if not callable(getattr(candidate, name, None))]
    require(not missing, f"a {type(candidate).__name__} lacks {', '.join(missing)}")


def require_arrays(
    holder: object,
    expected: Mapping[str, tuple[DTypeLike, tuple[int, ...]]],
    where: str = "",
    cause: str = "",
) -> None:
    """Raise unless the named attributes are arrays of the expected types and shapes.

    Args:
        holder: What has the attributes.
        expected: Type and shape by name.
        where: What is before the fault in the message.
        cause: The likely cause.

    Raises:
        ConformanceError: Names the first other one.
    """
    for name, (kind, shape) in expected.items():
        value = getattr(holder, name)
        require(
            value.dtype == kind and value.shape == shape,
            f"{where}{name} is {value.dtype} {value.shape}, expected {np.dtype(kind)} {shape}",
            cause,
        )


def require_unchanged(call: Callable[[], object], *arrays: NDArray[Any], what: str) -> None:
    """Raise if a call changes one of the arrays.

    Raises:
        ConformanceError: Says that `what` was changed.
    """
    copies = [array.copy() for array in arrays]
    call()
    same = all(np.array_equal(array, copy) for array, copy in zip(arrays, copies, strict=True))
    require(same, f"{what} was changed", "an operation in place: draw on a copy")
