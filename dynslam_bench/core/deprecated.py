"""What still works for a while: one warning that says until when, and what to use instead."""

from __future__ import annotations

import warnings


def warn_deprecated(what: str, instead: str, *, gone_in: str) -> None:
    """Warn with a `DeprecationWarning` that something will be gone.

    Args:
        what: What was used, as a clause: ``"'old.module' has moved"``.
        instead: What to do: ``"import from 'new.module'"``.
        gone_in: The version without it; see docs/stability.md for how long that is.

    The warning names the line that called the function that calls this one; for a module, the line that imports it.
    """
    warnings.warn(f"{what} and will be gone in {gone_in}; {instead}", DeprecationWarning, stacklevel=3)
