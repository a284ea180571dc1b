"""Whether a plug-in's module can be imported at all: asked in a process of its own, which the import may end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from functools import cache

from .errors import PluginError

ISOLATED_VARIABLE = "DYNSLAM_BENCH_ISOLATED"
"""Set in processes that may end by an import without harm: the children of runs, and the probes themselves."""
LIMIT_S = 120
_IMPORTED = 113
_PROBE = """
import json, os, sys
location, sys.path[:] = sys.argv[1], json.loads(sys.argv[2])
from dynslam_bench.core.plugins import import_module
try:
    import_module(location)
except Exception:
    pass  # whoever asks meets it again, and words it
os._exit(int(sys.argv[3]))
"""


@cache
def check_import(location: str) -> None:
    """Import a plug-in's module in a process of its own, once for every location.

    What the import raises is left to the caller's own import; here counts that it comes to an end and that the process
    lives on: ``sys.exit``, ``os._exit``, a crash of a native library or an endless loop would end, or hang, whoever
    imports it.

    Args:
        location: Name of a module, or path of a ``.py`` file.

    Raises:
        PluginError: It does not; with how it ended.
    """
    if os.environ.get(ISOLATED_VARIABLE):
        return
    command = [sys.executable, "-c", _PROBE, location, json.dumps(sys.path), str(_IMPORTED)]
    environment = {**os.environ, ISOLATED_VARIABLE: "1"}
    quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    try:
        code = subprocess.run(command, env=environment, timeout=LIMIT_S, check=False, **quiet).returncode  # type: ignore[call-overload]
    except subprocess.TimeoutExpired:
        raise PluginError(f"cannot import {location}: it is not done after {LIMIT_S} s") from None
    if code != _IMPORTED:
        how = f"exit code {code}" if code >= 0 else signal.Signals(-code).name
        raise PluginError(
            f"cannot import {location}: that ends the process ({how})",
            "a plug-in must not call sys.exit or os._exit when it is imported",
        )
