"""Makes runs one after the other for a gate, in the folder of one checkout: a process of its own.

It is started by its path, so that it imports the package that this process is to use, which may be
another version. Each line of standard input is a run: ``{"spec": {...}, "results": FOLDER}``. Each
has one line as its answer: ``{"run_id": ID}``, or ``{"error": REASON, "hint": CURE}``.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

# The folder of this file, where Python begins to look, is no place to import from.
HERE = Path(__file__).resolve().parent
sys.path[:] = [place for place in sys.path if Path(place).resolve() != HERE]


def make(request: dict[str, Any]) -> dict[str, str]:
    """Make one run."""
    from pydantic import ValidationError

    from dynslam_bench.core import DynslamError
    from dynslam_bench.runs import RunSpec, run_many

    try:
        spec = RunSpec.model_validate(request["spec"])
        records = run_many([spec], results=request["results"])
        return {"run_id": records.run_ids[0]}
    except ValidationError as error:
        # the checkout's own version of this package may not know all that was asked for
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"]))
        return {"error": f"the package in {Path.cwd()} refuses the run: {field}: {first['msg']}"}
    except DynslamError as error:
        return {"error": str(error.args[0]), "hint": error.hint}


def main() -> None:
    """Answer until standard input ends; what else is written to standard output is log output."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    for line in sys.stdin:
        answers.write(json.dumps(make(json.loads(line))) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
