"""What a child is told before it begins."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

from .server import THREAD_VARIABLES


def make_job(work: str, folder: Path | str, **details: Any) -> dict[str, Any]:
    """A job for a child, as JSON takes it.

    Args:
        work: ``module:function`` that does it; called with the job, a function that tells the parent something, and
            one that says whether the parent wants an early end.
        folder: Where the child's log and what it finds go.
        details: What `work` wants to know; ``spec`` with the ``threads`` of the run among it.

    Returns:
        The job; the child does it in this process's working folder, with its environment and import path.
    """
    environment = {name: text for name, text in os.environ.items() if name not in THREAD_VARIABLES}
    surroundings = {"environment": environment, "working_folder": str(Path.cwd()), "path": list(sys.path)}
    return {"work": work, "folder": str(folder), **surroundings, **details}
