"""Instructions of the kernels: functions whose code is written as LLVM's, not as Python."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, TypeAlias, cast

from numba.extending import intrinsic

Code: TypeAlias = Any
"""A type, value or builder of numba and llvmlite, neither of which says its types."""

Arguments = ParamSpec("Arguments")
Definition: TypeAlias = tuple[Code, Callable[[Code, Code, Code, Code], Code]]
"""Numba's signature of an instruction, and what writes its code, of context, builder, signature and arguments."""


def instruction(define: Callable[Concatenate[Code, Arguments], Definition]) -> Callable[Arguments, Code]:
    """Make an instruction that kernels call, of a function of numba's typing context and its arguments' types."""
    return cast("Callable[Arguments, Code]", intrinsic(define))
