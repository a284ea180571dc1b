"""Sealed rounds: trackers are frozen first, and scenes that nobody could know are rendered afterwards.

A round is a folder of files, e.g. a git repository. `new_round` draws a salt and publishes its
SHA-256. `enter` freezes a tracker. `reveal` publishes the salt, from which everybody derives the
numbers of the scenes, and the entries that were received. `run` runs them, `verify` checks what
others have run, and `report` makes the board. No server is needed: the renderer gives the same bits
on every machine.
"""

from dynslam_bench.rounds.board import RoundReport, report
from dynslam_bench.rounds.entering import enter
from dynslam_bench.rounds.files import Entry, Results, Reveal, Round, reveal
from dynslam_bench.rounds.opening import new_round
from dynslam_bench.rounds.running import RoundRuns, run
from dynslam_bench.rounds.verifying import Verification, verify

__all__ = [
    "Entry",
    "Results",
    "Reveal",
    "Round",
    "RoundReport",
    "RoundRuns",
    "Verification",
    "enter",
    "new_round",
    "report",
    "reveal",
    "run",
    "verify",
]
