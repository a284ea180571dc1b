"""The job that a child is given, and the files by which it answers beside its messages."""

import os
import sys
from pathlib import Path
from typing import Any

LOG_FILE = "log.txt"
"""File of everything that is printed in the child."""
READS_FILE = "reads.json"
"""File of what plug-ins and programs have read in the child."""
THREAD_VARIABLES = (
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "BLIS_NUM_THREADS",
)
"""Set to 1 before anything is imported: BLAS must not spin up threads of its own beside the run's."""


def make_job(work: str, folder: Path | str, **details: Any) -> dict[str, Any]:
    """A job for a child, as JSON takes it.

    Args:
        work: ``module:function`` that does it; called with the job, a function that tells the
            parent something, and one that says whether the parent wants an early end.
        folder: Where the child's log and what it finds go.
        details: What `work` wants to know; ``spec`` with the ``threads`` of the run among it.

    Returns:
        The job; the child does it in this process's working folder, with its environment and import
        path.
    """
    environment = {name: text for name, text in os.environ.items() if name not in THREAD_VARIABLES}
    context = {
        "environment": environment,
        "working_folder": str(Path.cwd()),
        "path": list(sys.path),
    }
    return {"work": work, "folder": str(folder), **context, **details}
