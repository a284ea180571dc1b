"""The command line: every verb is a thin call of a public function; heavy modules load when a verb needs them."""

from __future__ import annotations

__all__ = ["main"]


def main() -> None:
    """Entry point of ``dynslam-bench``.

    Exit codes: 0 done, 1 user error (one line, no traceback), 2 usage, 3 some runs failed or were lost (or could not
    write the map that was asked for), 4 verification failed, 128 and the signal's number after one (130 for Ctrl-C).
    """
    import sys
    from io import TextIOWrapper

    from dynslam_bench.cli.ending import leave_interrupted, watch_signals

    watch_signals()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # a terminal of another encoding shows ? in place of what it lacks
            stream.reconfigure(errors="replace")
    try:
        from dynslam_bench.cli.app import start

        start()
    except KeyboardInterrupt:
        leave_interrupted()
