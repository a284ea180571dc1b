"""The board: rows ordered into trackers and sequences, with one label each, and their standings."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from operator import attrgetter
from pathlib import Path
from statistics import geometric_mean, median
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from dynslam_bench.core import ReportError, assignments, did_you_mean
from dynslam_bench.evaluation import Protocol, get_protocol
from dynslam_bench.evaluation.verdicts import FLOOR_M, scenes_needed
from dynslam_bench.reports.model.load import check_one_protocol, load_runs, open_stores
from dynslam_bench.reports.model.names import (
    OUR_BACK_END,
    OUR_OWN,
    make_labels,
    name_columns,
    shortened,
)
from dynslam_bench.reports.model.row import RunRow, command_with, grouped, sequence_options
from dynslam_bench.reports.model.statistics import (
    FAMILY_ERROR,
    FEWEST,
    Interval,
    RankingVerdict,
    Scope,
    Sequences,
    Standing,
    log_medians,
    ratio_interval,
    resolution,
    separable,
    sequences_of,
    standings,
)
from dynslam_bench.runs.rows import part_words
from dynslam_bench.runs.store import RunStore
from dynslam_bench.sequences.families import family_of, same_path
from dynslam_bench.sequences.tags import FIXED_CAMERA
from dynslam_bench.sequences.thumbnails import same_frames

STATIC_CAMERA = "static camera (from ground truth)"
"""Name in captions of the reference where it is a static camera."""
DEFAULT_REFERENCE = "orb-slam2"
"""Tracker that errors are divided by where no other is asked for."""
RankingBasis = Literal["common", "all"]
"""Rank on the sequences that all ranked trackers have, or only trackers that have all sequences."""
OVERALL = "overall"
"""The category of all sequences."""
EXACT_MASKS = "oracle"
"""Source of masks that no tracker could have: a bound, which never ranks beside others."""
_FIXED = "fixed camera"
"""Group of sequences on which the true camera stands still: a static camera has no error there."""
_GROUPS = {
    FIXED_CAMERA: _FIXED,
    "unknown-objects": "unknown objects",
    "static": "static",
    "low-dynamic": "low dynamic",
    "high-dynamic": "high dynamic",
}
"""Tag of a sequence to the name of its group; the first one that a sequence has counts."""
_FURTHER = {"fast": "fast", "loop": "loops", "recorded": "recorded", "rendered": "rendered"}
"""Tag of a sequence to a category that it has beside its group."""
_OTHER = "other"
"""Group of sequences without any of these tags."""
_GROUP_ORDER = ("static", "low dynamic", "high dynamic", "unknown objects", _FIXED, _OTHER, "")
"""Order of the groups in tables."""
_MOST_MISSING = 8
"""Trackers whose missing cells are named."""
_SAME_ERROR = 1e-9
"""Relative difference up to which two errors of a static camera are of one true path."""
_MOVING_M = 1e-3
"""Errors of a static camera below this do not tell true paths apart: the camera hardly moves."""
_SAME_STAMP_S = 1e-6
"""Difference of durations up to which they are equal: rounding in files."""
_NEARLY = 0.1
"""Relative difference of frames, durations and errors of a static camera up to which true poses are compared."""


@dataclass
class Board:
    """Everything the tables and figures are made of.

    Attributes:
        rows: All rows.
        on: What trackers are ranked on.
        rank_seen: Whether cells rank whose masks come from a network that was trained on the scene.
        sequence_names: Sequence key of a row (`RunRow.sequence_key`) to the name of its sequence.
        trackers: Variant keys in order of standing; those of which only final trajectories are
            known stand apart.
        final_only: Variant keys of imports and batch programs of which only the final trajectory is
            known.
        labels: Variant key to the name in tables.
        sequences: Names of the sequences with ground truth, grouped and sorted.
        common: Sequences that the standings are taken over, each recording once.
        copies: Sequence to the one before it whose true path it has: the same recording, by
            another name or with other pixels.
        short: Sequence to what is left of its name without the parts that all share.
        tags: Sequence to its tags, with ``recorded`` or ``rendered``.
        groups: Sequence to the name of its group: what moves in its scene.
        families: Sequence to its family, see `family_of`.
        category: Which category the board is of, `OVERALL` for all sequences: then groups have
            equal weights.
        unscored: Names of the sequences without ground truth.
        cells: Variant key to sequence to its runs.
        static_camera: Sequence to the error of a static camera.
        reference: Variant key of the reference; None if ratios are to a static camera.
        reference_name: How to call the reference in captions.
        asked_reference: The tracker id that was asked for as the reference; empty for none.
        standings: Standing of every variant with a score on the common sequences, in order.
        ranked: Variant keys that take part in the ranking, from the best to the worst.
        incomplete: Variant keys of rankable trackers that are not ranked since they lack sequences.
        ranked_out_by_static: Variant keys of trackers that are not ranked since they are no better than a
            static camera: the geometric mean of their errors over its on the common sequences is 1
            or more.
        never_succeeded: Variant keys that never succeeded on the common sequences.
    """

    rows: list[RunRow]
    on: RankingBasis = "common"
    rank_seen: bool = False
    sequence_names: dict[str, str] = field(default_factory=dict)
    trackers: list[str] = field(default_factory=list)
    final_only: list[str] = field(default_factory=list)
    labels: dict[str, str] = field(default_factory=dict)
    sequences: list[str] = field(default_factory=list)
    common: list[str] = field(default_factory=list)
    copies: dict[str, str] = field(default_factory=dict)
    short: dict[str, str] = field(default_factory=dict)
    tags: dict[str, set[str]] = field(default_factory=dict)
    groups: dict[str, str] = field(default_factory=dict)
    families: dict[str, str] = field(default_factory=dict)
    category: str = OVERALL
    unscored: list[str] = field(default_factory=list)
    cells: dict[str, dict[str, TrackerOnSequence]] = field(default_factory=dict)
    static_camera: dict[str, float] = field(default_factory=dict)
    reference: str | None = None
    reference_name: str = STATIC_CAMERA
    asked_reference: str = ""
    standings: list[Standing] = field(default_factory=list)
    ranked: list[str] = field(default_factory=list)
    incomplete: list[str] = field(default_factory=list)
    ranked_out_by_static: list[str] = field(default_factory=list)
    never_succeeded: list[str] = field(default_factory=list)

    @cached_property
    def _by_key(self) -> dict[str, list[RunRow]]:
        return grouped(self.rows, lambda row: row.variant_key)

    @cached_property
    def names(self) -> dict[str, str]:
        """Labels as sentences, headings and figures say them: without whose they are, unless two would be alike."""
        short = {
            key: label.replace(OUR_BACK_END, "").replace(OUR_OWN, "")
            for key, label in self.labels.items()
        }
        counts = Counter(short.values())
        names = {}
        for key, label in self.labels.items():
            is_unique = counts[short[key]] == 1
            names[key] = short[key] if is_unique else label
        return names

    @property
    def categories(self) -> dict[str, list[str]]:
        """Category to its sequences, of those categories that hold some of the sequences and not all."""
        categories = grouped(self.sequences, self.groups.__getitem__)
        for tag, category in _FURTHER.items():
            categories[category] = [name for name in self.sequences if tag in self.tags[name]]
        return {
            category: names
            for category, names in categories.items()
            if 0 < len(names) < len(self.sequences)
        }

    @property
    def weights(self) -> dict[str, float]:
        """Weights of the common sequences: on an overall board all groups weigh the same, elsewhere all sequences."""
        groups = [""] * len(self.common)
        if self.category == OVERALL:
            groups = [self.groups[name] for name in self.common]
        return dict(zip(self.common, group_weights(groups).tolist(), strict=True))

    @property
    def ranked_sequences(self) -> Sequences:
        """The common sequences with their families and the weights of these."""
        return sequences_of(self.common, self.families, self.weights)

    @property
    def standing_by_key(self) -> dict[str, Standing]:
        """Variant key to its standing, in order."""
        return {standing.key: standing for standing in self.standings}

    @cached_property
    def timing_computer(self) -> str:
        """The computer whose times are shown where runs were made on several: the one with most timed runs."""
        ended = [row for row in self.rows if not row.failed]
        counts = Counter(row.computer for row in timed(ended))
        return min(counts, key=lambda computer: (-counts[computer], computer), default="")

    @property
    def emphasised(self) -> set[str]:
        """Variant keys of those that may be the best, unless that is most of them: then it would say nothing."""
        may_be_best = {standing.key for standing in self.standings if standing.may_be_best}
        return may_be_best if 2 * len(may_be_best) <= len(self.ranked) else set()

    def sequence(self, row: RunRow) -> str:
        """Name of the sequence of a row."""
        return self.sequence_names[row.sequence_key]

    def runs(self, key: str) -> list[RunRow]:
        """All rows of a tracker."""
        return self._by_key[key]

    def first(self, key: str) -> RunRow:
        """Any row of a tracker, for what all its rows share."""
        return self._by_key[key][0]

    def is_rankable(self, key: str) -> bool:
        """Whether a tracker could be ranked: a system, as its spec says, by the program that ranks."""
        row = self.first(key)
        return row.ranked and row.is_current and row.tracker.provenance != "control"

    def unranked_why(self, key: str) -> str:
        """Why a tracker is not ranked, in a few words; empty for one that is, and where nothing is known of it."""
        if key in self.ranked:
            return ""
        if key in self.ranked_out_by_static:
            return "no better than a static camera"
        if key in self.never_succeeded:
            return "nothing succeeded"
        if key in self.incomplete:
            return "lacks sequences"
        row = self.first(key)
        if row.realtime:
            return "in real time"
        if row.segmentation == EXACT_MASKS:
            return "exact masks: a bound"
        if not row.is_current:
            return "by another program"
        if self.is_rankable(key):
            return ""
        # a composition of this project that does not rank is an ablation
        return "ablation" if row.tracker.provenance == "own" else row.tracker.provenance

    def no_better_than_static(self, key: str, sequence: str) -> bool:
        """Whether a tracker's runs that ended well have, by their median, a static camera's error or more.

        Controls make no claim: never. Nor does it count before a fixed camera.
        """
        is_control = self.first(key).tracker.provenance == "control"
        if is_control or self.groups[sequence] == _FIXED:
            return False
        cell = self.cells[key].get(sequence)
        static_m = self.static_camera.get(sequence)
        if cell is None or static_m is None or not cell.succeeded:
            return False
        return median(row.score_m or 0.0 for row in cell.succeeded) >= (1 - 1e-9) * static_m

    def static_ratio(self, key: str) -> float:
        """Geometric mean over the common sequences of a tracker's median error over that of a static camera.

        Sequences of a fixed camera do not count; 0 if there are no others.
        """
        ratios = []
        for name in self.common:
            if self.groups[name] != _FIXED:
                error_m = max(self.cells[key][name].median or 0.0, FLOOR_M)
                ratios.append(error_m / max(self.static_camera[name], FLOOR_M))
        return geometric_mean(ratios) if ratios else 0.0

    def scored(self, key: str) -> list[str]:
        """The sequences on which a tracker has a score."""
        return [
            name
            for name in self.sequences
            if name in self.cells[key] and self.cells[key][name].scores
        ]

    @property
    def typical(self) -> set[str]:
        """Ids of the runs that stand for the cells with a success and ground truth, see `TrackerOnSequence.typical`."""
        cells = (cell for key in self.trackers for cell in self.cells[key].values())
        return {cell.typical.run_id for cell in cells if cell.succeeded}

    def frame(self) -> pd.DataFrame:
        """All rows as a pandas frame.

        Returns:
            One line a run, ordered by label, sequence and repeat; whatever is missing is ``pd.NA``.

            ``string`` columns:

            - run_id, frames, split, repeat, status, segmentation, protocol_id, protocol_digest,
                provenance, tracker, label;
            - kind: ``run here`` or ``imported``;
            - settings: what sets the variant apart, ``name=value; ...``;
            - sequence: name of the column in tables; column_id: its key;
            - ending: how a failed run ended;
            - study: the study of which the run is a trial;
            - trajectory: ``online`` or ``final``, whose errors they are;
            - computer: where the times were taken;
            - program_remark: how many programs share the row, or how the results differ from those
                of the program that ranks.

            ``Int64`` columns: seed, offset, noise (missing for the sequence's own), n_frames,
            n_processed, n_tracked.

            ``boolean`` columns:

            - ranked, failed;
            - cached: whether stage times come from the stage cache;
            - seen_in_training: whether the masks come from a network that was trained on the scene.

            ``Float64`` columns:

            - coverage, truth_share (of imports whose frames are not known) and epipolar_skipped: shares, 0 to 1;
            - score_m: the ATE in metres that ranks: lost frames held, failures as a static camera
                or worse;
            - hold_last_pose_ate_m, final_ate_m and static_camera_ate_rmse_m: metres;
            - frame_ms: median, milliseconds;
            - real_time_factor; peak_memory_mb: MB; mask_iou: 0 to 1;
            - rotation_uncertainty_deg: standard error in degrees of the alignment's rotation; above
                10 the metrics ``ape_rot_*`` say nothing of the tracker;
            - every metric of the protocol under its own name, the unit at its end (``ate_rmse_m``,
                ``rpe_1s_rot_rmse_deg``; see `Evaluation`).
        """
        # column to its type: those that all frames have, then the metrics
        metrics = sorted(
            {name for row in self.rows for name in row.metrics} - set(_COLUMNS["Float64"])
        )
        types = {name: type_ for type_, names in _COLUMNS.items() for name in names}
        types |= dict.fromkeys(metrics, "Float64")

        ordered = sorted(
            self.rows,
            key=lambda row: (self.labels[row.variant_key], self.sequence(row), row.repeat_key),
        )
        lines = []
        for row in ordered:
            # what is not an attribute of the row under the column's name
            values: dict[str, Any] = {
                "kind": row.origin,
                "tracker": row.tracker.id,
                "label": self.labels[row.variant_key],
                "settings": "; ".join(assignments(row.variant)),
                "provenance": row.tracker.provenance,
                "sequence": self.sequence(row),
                "column_id": row.sequence_key,
                "frames": part_words(row),
                "split": row.sequence.split,
                "study": row.trial_of,
                "noise": row.sequence.noise,
                "computer": row.computer or None,
                "program_remark": row.program_remark or None,
            }
            values |= {name: row.metrics.get(name) for name in metrics}
            lines.append([values[name] if name in values else getattr(row, name) for name in types])
        return pd.DataFrame(lines, columns=list(types), dtype=object).astype(types)

    def lost(self, key: str) -> set[str]:
        """The sequences whose cell a tracker lost."""
        return {name for name, cell in self.cells[key].items() if cell.lost}

    def competes(self, key: str, name: str) -> bool:
        """Whether a tracker's number on a sequence may rank: no network that it uses was trained there."""
        return self.rank_seen or not self.cells[key][name].in_training

    def reference_median(self, sequence: str) -> float | None:
        """The reference's median error on a sequence; None where it was not run."""
        if self.reference is None:
            return self.static_camera[sequence]
        cell = self.cells[self.reference].get(sequence)
        return None if cell is None else cell.median

    def unranked_rows(self, keys: Sequence[str]) -> set[int]:
        """Positions among some trackers of those that are not ranked."""
        return {at for at, key in enumerate(keys) if key not in self.ranked}

    def separators(self) -> set[int]:
        """Rows of a table of all trackers above which a line is drawn: the unranked, and those that never succeeded."""
        failed = len(self.trackers) - sum(key in self.never_succeeded for key in self.trackers)
        return {at for at in (len(self.ranked), failed) if 0 < at < len(self.trackers)}


def make_board(
    rows: Sequence[RunRow],
    reference: str | None = None,
    on: RankingBasis = "common",
    *,
    rank_seen: bool = False,
) -> Board:
    """Order rows into a board.

    Args:
        rows: One a run.
        reference: Tracker id that errors are divided by; `DEFAULT_REFERENCE` where none is named.
            Real-time runs, imports and runs by another program than the one that ranks are never
            it. Where it was not run on every ranked sequence, a static camera takes its place.
        on: ``common`` ranks on the sequences that all ranked trackers have, ``all`` only trackers
            that have all.
        rank_seen: Whether trackers are also ranked on scenes that the network behind their masks
            was trained on.

    Raises:
        ReportError: There are no rows, they mix protocols, or no run is of the reference.
    """
    if not rows:
        raise ReportError("there are no runs to report")
    check_one_protocol(rows)
    trackers = sorted({row.tracker.id for row in rows})
    if reference is not None and reference not in trackers:
        raise ReportError(
            f"there is no run of the reference '{reference}'", did_you_mean(reference, trackers)
        )
    board = Board(
        list(rows),
        on,
        rank_seen,
        name_columns(rows),
        labels=make_labels(rows),
        asked_reference=reference or "",
    )
    return _fill_board(board)


def category_boards(board: Board) -> dict[str, Board]:
    """A board of its own for every category of an overall board, under the same labels and with the same reference."""
    boards = {OVERALL: board}
    for category, names in board.categories.items():
        rows = [row for row in board.rows if board.sequence(row) in names]
        keys = {row.variant_key for row in rows}
        labels = {key: label for key, label in board.labels.items() if key in keys}
        category_board = Board(
            rows,
            board.on,
            board.rank_seen,
            board.sequence_names,
            labels=labels,
            category=category,
            asked_reference=board.asked_reference,
        )
        boards[category] = _fill_board(category_board)
    return boards


def _fill_board(board: Board) -> Board:
    """Fill a board that has rows and labels: sequences, cells, ranking, reference, standings and order."""
    # one cell for each tracker and sequence
    _order_sequences(board)
    by_tracker = {key: grouped(board.runs(key), board.sequence) for key in board.labels}
    board.cells = {
        key: {name: make_cell(runs) for name, runs in by_name.items()}
        for key, by_name in by_tracker.items()
    }
    board.final_only = [key for key in board.labels if all(map(_has_final_only, board.runs(key)))]

    # who is ranked, beside which reference, and in which order
    shown = [key for key in board.labels if key not in board.final_only]
    scored = [key for key in shown if board.scored(key)]
    _choose_ranked(board, scored)
    _choose_reference(board, scored, board.asked_reference or DEFAULT_REFERENCE)
    board.standings = rank(board, scored, board.ranked)

    # order: by standing, then the others by label; those that never succeeded come last
    others = sorted(set(shown) - board.standing_by_key.keys(), key=board.labels.__getitem__)
    board.trackers = sorted(
        [*board.standing_by_key, *others], key=lambda key: key in board.never_succeeded
    )
    board.ranked = [key for key in board.trackers if key in board.ranked]
    return board


def _has_final_only(row: RunRow) -> bool:
    """Whether a run is an import, or by a batch program, without the trajectory that the protocol asks for."""
    may_lack_online = row.imported or not row.tracker.online
    return may_lack_online and not row.metrics and row.final_ate_m is not None


def _choose_reference(board: Board, scored: Sequence[str], tracker: str) -> None:
    """Set the reference: the variant of a tracker with the fewest settings that was run on all common sequences.

    Imports, real-time runs, runs that begin in a map and runs by another program are never it.
    Without such a variant a static camera stays the reference.
    """
    candidates = []
    for key in scored:
        row = board.first(key)
        if row.tracker.id != tracker or not row.is_current or row.imported:
            continue
        if row.realtime or "map" in row.variant:
            continue
        if set(board.common) <= set(board.scored(key)):
            candidates.append(key)
    if candidates and board.common:
        board.reference = min(candidates, key=lambda key: len(board.first(key).variant))
        board.reference_name = board.names[board.reference]


def rank(
    board: Board,
    scored: Sequence[str],
    ranked: Sequence[str],
    score: Callable[[RunRow], float | None] = attrgetter("score_m"),
) -> list[Standing]:
    """Standings over the common sequences under one rule for failures.

    Args:
        board: Gives cells and reference.
        scored: Trackers to place.
        ranked: Trackers among `scored` that are ranked.
        score: Error of a run in metres, or None to leave it out.
    """
    # errors in metres of every tracker, by sequence
    keys = {*scored} if board.reference is None else {*scored, board.reference}
    errors: dict[str, dict[str, list[float]]] = {}
    for key in keys:
        errors[key] = {}
        for name in board.common:
            if name in board.cells[key]:
                scores = map(score, board.cells[key][name].kept)
                errors[key][name] = [error for error in scores if error is not None]

    # those of the reference; a static camera has none before a fixed camera
    if board.reference is None:
        static = board.static_camera
        reference = {name: [static[name]] for name in board.common if board.groups[name] != _FIXED}
    else:
        reference = {name: values for name, values in errors[board.reference].items() if values}
    if not reference:
        return []

    # trackers with an error on one of these sequences are placed; of all sequences, ranked
    placed = {
        key: errors[key] for key in scored if any(errors[key].get(name) for name in reference)
    }
    complete = [
        key for key in ranked if key in placed and all(errors[key].get(name) for name in reference)
    ]
    placings = standings(
        placed,
        reference,
        complete,
        families=board.families,
        weights=board.weights,
        lost={key: board.lost(key) for key in placed},
        reference_lost=set() if board.reference is None else board.lost(board.reference),
    )
    return [
        replace(standing, verdict="reference")
        if standing.key == board.reference and standing.verdict
        else standing
        for standing in placings
    ]


def group_of(tags: Collection[str]) -> str:
    """Group of a scene: what moves in it, by the tags of its sequence."""
    return next((group for tag, group in _GROUPS.items() if tag in tags), _OTHER)


def group_weights(groups: Sequence[str]) -> NDArray[np.float64]:
    """Weights of sequences of these groups: all groups weigh the same."""
    sizes = Counter(groups)
    return np.array([1.0 / sizes[group] for group in groups])


def common_logs(board: Board, keys: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """Logarithms of some trackers' median errors on the common sequences ``[S]``, nan for none."""
    return {
        key: log_medians(
            {name: cell.scores for name, cell in board.cells[key].items()}, board.common
        )
        for key in keys
    }


def without_lost(
    board: Board, logs: NDArray[np.float64], lost: Collection[str]
) -> NDArray[np.float64]:
    """Logarithms of errors on the common sequences ``[S]``, nan on lost ones."""
    is_lost = np.array([name in lost for name in board.common], dtype=bool)
    return np.where(is_lost, np.nan, logs)


def board_resolution(board: Board) -> tuple[float, float]:
    """Smallest differences, as shares, that a board shows in four of five: on these families, and beyond them.

    Returns:
        See `statistics.resolution`; 1 where nothing can be shown.
    """
    others = [key for key in board.ranked if key != board.reference]
    logs = common_logs(board, others)
    if board.reference is None:
        # a static camera has no error before a fixed camera
        static = {
            name: [board.static_camera[name]]
            for name in board.common
            if board.groups[name] != _FIXED
        }
        base = log_medians(static, board.common)
        base_lost: set[str] = set()
    else:
        base = common_logs(board, [board.reference])[board.reference]
        base_lost = board.lost(board.reference)

    # lost cells take no part in a claim
    for key in others:
        logs[key] = without_lost(board, logs[key], board.lost(key) | base_lost)
    return resolution(logs, base, board.ranked_sequences)


MOST_FURTHER = 500
"""Further sequences above which none are proposed: nobody runs so many to tell two trackers apart."""


def more_sequences(board: Board, key: str) -> int | None:
    """Number of further sequences that would tell a tracker from the reference, if the truth is what is measured here.

    Returns:
        None where that cannot be said: without a reference or a scatter, or for more than
        `MOST_FURTHER`.
    """
    if board.reference is None or len(board.common) < FEWEST:
        return None
    # log ratios of the errors on sequences that both have tracked
    logs = common_logs(board, [key, board.reference])
    lost = board.lost(key) | board.lost(board.reference)
    is_lost = np.array([name in lost for name in board.common], dtype=bool)
    differences = logs[key] - logs[board.reference]
    differences = differences[~is_lost & np.isfinite(differences)]
    if len(differences) < FEWEST:
        return None
    # the number of sequences that shows the measured gain at this scatter
    spread = float(differences.std(ddof=1))
    gain = 1.0 - math.exp(-abs(float(differences.mean())))
    n_tests = max(len(board.ranked) - 1, 1)
    if not (spread > 0 and gain > 0):
        return None
    needed = scenes_needed(gain, spread, FAMILY_ERROR / 2 / n_tests)
    further = max(needed, len(differences) + 1) - len(differences)
    return further if further <= MOST_FURTHER else None


class TrackerPair(NamedTuple):
    """Two trackers on the common sequences that both have.

    Attributes:
        one: Variant key of the first tracker.
        other: Variant key of the second tracker.
        ratio: Geometric mean of the errors of the first over those of the second where both succeed; over all
            sequences where they succeed on none together.
        sequences: Sequences behind it.
        lost: Sequences that the first alone lost, and the second alone.
        p_value: Holm-corrected over all pairs of ranked trackers; None unless both are ranked.
        verdict: What the test says of the first tracker; empty unless both are ranked.
        scope: How far that goes.
    """

    one: str
    other: str
    ratio: Interval
    sequences: int
    lost: tuple[int, int]
    p_value: float | None
    verdict: RankingVerdict
    scope: Scope


def compare_pairs(board: Board, keys: Sequence[str]) -> list[TrackerPair]:
    """Compare every two of some trackers that have a common sequence in common, in their order."""
    logs = common_logs(board, keys)
    succeeded = {key: without_lost(board, logs[key], board.lost(key)) for key in keys}
    sequences = board.ranked_sequences
    tests = {}
    if board.common:
        ranked = {key: succeeded[key] for key in keys if key in board.ranked}
        tests = separable(ranked, sequences)
    pairs = []
    for one, other in combinations(keys, 2):
        # log ratios [S], nan where one of the two lost or has no run
        differences = succeeded[one] - succeeded[other]
        if not np.isfinite(differences).any():
            differences = logs[one] - logs[other]
        n_sequences = int(np.isfinite(differences).sum())
        if not n_sequences:
            continue
        ratio = ratio_interval(differences, sequences)
        both_ran = {
            name for name in board.common if name in board.cells[one] and name in board.cells[other]
        }
        lost = (
            len(both_ran & board.lost(one) - board.lost(other)),
            len(both_ran & board.lost(other) - board.lost(one)),
        )
        order = tests.get((one, other))
        verdict: RankingVerdict = "" if order is None else "cannot tell"
        if order is not None and order.first_by:
            verdict = "better" if order.first_by < 0 else "worse"
        p_value = None if order is None else order.p_value
        scope: Scope = "" if order is None else order.scope
        pairs.append(TrackerPair(one, other, ratio, n_sequences, lost, p_value, verdict, scope))
    return pairs


def _order_sequences(board: Board) -> None:
    """Name the sequences, their groups and families, static ones first; note what a static camera scores on each."""
    by_sequence = grouped(board.rows, board.sequence)
    for name, rows in by_sequence.items():
        # the error of a static camera; without one there is no ground truth
        static_m = [row.static_camera_ate_rmse_m for row in rows]
        known_m = [error for error in static_m if error is not None]
        if known_m:
            board.static_camera[name] = median(known_m)
        else:
            board.unscored.append(name)

        # tags, group and family
        place = "rendered" if rows[0].sequence.id.startswith("synthetic/") else "recorded"
        board.tags[name] = {place, *(tag for row in rows for tag in row.sequence.tags)}
        board.groups[name] = group_of(board.tags[name])
        board.families[name] = family_of(rows[0].sequence.id)

    # a single group without a meaning gets no heading
    if set(board.groups.values()) == {_OTHER}:
        board.groups = dict.fromkeys(board.groups, "")
    board.sequences = sorted(
        board.static_camera, key=lambda name: (_GROUP_ORDER.index(board.groups[name]), name)
    )
    board.short = shortened(board.sequences)
    board.copies = copies_of({name: by_sequence[name] for name in board.sequences})


def copies_of(columns: Mapping[str, Sequence[RunRow]]) -> dict[str, str]:
    """Find sequences that are copies of others: equal true poses, or equal pictures before a fixed camera.

    Where the true poses are not here, as in a report, equal frames, duration and error of a static camera tell.

    Args:
        columns: Sequence to its rows, in order.

    Returns:
        Sequence to the first one that it is a copy of; those that are no copies are not in it.
    """
    copies = {}
    firsts: dict[str, RunRow] = {}
    for name, rows in columns.items():
        # the truth of the earliest start: a run without ground truth tells nothing
        with_truth = [row for row in rows if row.static_camera_ate_rmse_m is not None]
        if not with_truth:
            continue
        first = min(with_truth, key=lambda row: (row.imported, row.offset))
        is_fixed = (first.static_camera_ate_rmse_m or 0.0) < _MOVING_M
        is_same = _has_same_pictures if is_fixed else _is_same_path
        for other, other_row in firsts.items():
            if is_same(first, other_row):
                copies[name] = other
                break
        else:
            firsts[name] = first
    return copies


def _has_same_pictures(row: RunRow, other: RunRow) -> bool:
    """Whether two runs are on one recording, whose camera never moves."""
    return same_frames(row.sequence.thumbnails, other.sequence.thumbnails)


def _is_same_path(row: RunRow, other: RunRow) -> bool:
    """Whether two runs are on one recording, whose camera moves."""
    static_m = row.static_camera_ate_rmse_m or 0.0
    other_m = other.static_camera_ate_rmse_m or 0.0
    sequence = row.sequence
    other_sequence = other.sequence

    # by their numbers, however the poses are written
    is_equal = (
        (row.offset, sequence.frames) == (other.offset, other_sequence.frames)
        and math.isclose(static_m, other_m, rel_tol=_SAME_ERROR)
        and math.isclose(sequence.duration_s, other_sequence.duration_s, abs_tol=_SAME_STAMP_S)
    )
    if is_equal:
        return True

    # by the poses, of which a copy may lack a few; they are read where the rest is nearly equal
    is_near = (
        math.isclose(sequence.frames, other_sequence.frames, rel_tol=_NEARLY)
        and math.isclose(sequence.duration_s, other_sequence.duration_s, rel_tol=_NEARLY)
        and math.isclose(static_m, other_m, rel_tol=_NEARLY)
    )
    return is_near and same_path(row.ground_truth(), other.ground_truth())


def copies_note(board: Board) -> str:
    """Note on sequences that are one recording and count once, and why; empty where none are."""
    names = grouped(board.copies, board.copies.__getitem__)
    shown = [
        f"{first} counts once for {', '.join([first, *others])}" for first, others in names.items()
    ]
    if not shown:
        return ""
    return (
        f"One recording counts once: {'; '.join(shown)}. Their true paths are the same: equal poses, or "
        "as many frames, the same duration, and the same error of a static camera. Before a fixed camera, "
        "frames spread over both show the same."
    )


def _choose_ranked(board: Board, scored: Sequence[str]) -> None:
    """Set which trackers are ranked, on the sequences that all of them have.

    Trackers with few sequences are left out where that leaves more cells to rank (trackers times
    sequences), so that neither one more sequence of one tracker nor one run of another takes the
    ranking away from the rest. A tracker without any success is not ranked, nor is one that is no
    better than a static camera, nor one where its network was trained (`Board.competes`).
    """
    # trackers that may rank; real-time runs and exact masks only among themselves
    rankable = [key for key in scored if board.is_rankable(key)]
    rankable = [key for key in rankable if not board.first(key).realtime] or rankable
    rankable = [key for key in rankable if board.first(key).segmentation != EXACT_MASKS] or rankable

    # the sequences of each, and a success on any of all
    sequences_of = {
        key: {name for name in board.scored(key) if board.competes(key, name)} for key in rankable
    }
    rankable = [
        key
        for key in rankable
        if sequences_of[key] and any(cell.success for cell in board.cells[key].values())
    ]

    # those that compete, and the sequences that all of them have
    competing = sorted(rankable, key=lambda key: (-len(sequences_of[key]), key))
    if board.on == "all":
        competing = [key for key in competing if sequences_of[key] == set(board.sequences)]
    competing = competing[: _most_cells([sequences_of[key] for key in competing])]
    shared = set(board.sequences)
    if competing:
        shared = set.intersection(*(sequences_of[key] for key in competing))
    board.common = _each_once(board, [name for name in board.sequences if name in shared])

    # ranked, or why not
    board.incomplete = [key for key in rankable if key not in competing]
    for key in scored:
        cells = board.cells[key]
        considered = [name for name in board.common if name in cells] or list(cells)
        if not any(cells[name].success for name in considered):
            board.never_succeeded.append(key)
        elif key in competing and board.static_ratio(key) >= 1 - 1e-9:
            board.ranked_out_by_static.append(key)
        elif key in competing:
            board.ranked.append(key)


def _each_once(board: Board, names: Sequence[str]) -> list[str]:
    """Some sequences, of those that are one recording the first."""
    first = {board.copies.get(name, name): name for name in reversed(names)}
    return [name for name in names if first[board.copies.get(name, name)] == name]


def _most_cells(sequences: Sequence[set[str]]) -> int:
    """Number of trackers to rank so that trackers times common sequences is largest: several, where that is possible.

    Args:
        sequences: The sequences of each tracker, most first.
    """
    n_cells = {n: n * len(set.intersection(*sequences[:n])) for n in range(1, len(sequences) + 1)}
    several = {n: cells for n, cells in n_cells.items() if n > 1 and cells} or n_cells
    return max(several, key=lambda n: (several[n], n), default=0)


@dataclass(frozen=True)
class TrackerOnSequence:
    """All runs of one tracker on one sequence.

    Attributes:
        rows: The runs, ordered by repeat.
        kept: Runs that count: of runs that differ in their seed only and have equal results, one.
    """

    rows: tuple[RunRow, ...]
    kept: tuple[RunRow, ...]

    @cached_property
    def scores(self) -> tuple[float, ...]:
        """Errors in metres of the runs that count, failures imputed."""
        return tuple(score for row in self.kept if (score := row.score_m) is not None)

    @cached_property
    def succeeded(self) -> tuple[RunRow, ...]:
        """The runs that count, ended and have an error."""
        return tuple(row for row in self.kept if not row.failed and row.score_m is not None)

    @cached_property
    def median(self) -> float | None:
        """Median error in metres; None without ground truth."""
        return median(self.scores) if self.scores else None

    @cached_property
    def failed(self) -> int:
        """Runs that failed."""
        return sum(row.failed for row in self.rows)

    @cached_property
    def lost(self) -> bool:
        """Whether the cell is lost: at least half of the runs that count failed."""
        return 2 * sum(row.failed for row in self.kept) >= len(self.kept)

    @property
    def success(self) -> int:
        """Runs that ended and could be evaluated."""
        return len(self.rows) - self.failed

    @property
    def deterministic(self) -> bool:
        """Whether several seeds gave one result to the last digit."""
        return len(self.kept) == 1 < len(self.rows)

    @cached_property
    def typical(self) -> RunRow:
        """The run that stands for the cell: the successful one with the (lower) median error, else its first."""
        ordered = sorted(self.succeeded, key=lambda row: row.score_m or 0.0)
        return ordered[(len(ordered) - 1) // 2] if ordered else self.rows[0]

    @cached_property
    def in_training(self) -> bool:
        """Whether masks of it come from a network that was trained on the scene."""
        return any(row.seen_in_training for row in self.rows)

    @cached_property
    def ending(self) -> str:
        """Words on how the runs failed, e.g. ``crashed at 20/60``; several that ended differently are counted."""
        endings = list(dict.fromkeys(row.ending for row in self.rows if row.failed))
        if len(endings) > 1:
            return f"{self.failed} failed: {'; '.join(endings)}"
        return endings[0] if endings else ""


def make_cell(rows: Sequence[RunRow]) -> TrackerOnSequence:
    """Order the runs of a cell and find the copies among them: other seeds with equal results."""
    ordered = sorted(rows, key=lambda row: row.repeat_key)
    by_input = grouped(ordered, lambda row: (row.offset, row.sequence.noise, row.imported))
    kept: list[RunRow] = []
    for of_seeds in by_input.values():
        n_results = len({_result_of(row) for row in of_seeds})
        kept += of_seeds[:1] if n_results == 1 else of_seeds
    return TrackerOnSequence(tuple(ordered), tuple(kept))


def _result_of(row: RunRow) -> tuple[object, ...]:
    """Status and all errors of a run; equal for copies."""
    errors = (row.score_m, row.final_ate_m, *sorted(row.metrics.items()))
    return (row.status, row.n_processed, row.coverage, *errors)


def timed(runs: Sequence[RunRow]) -> list[RunRow]:
    """The runs with frame times: those that took them themselves, where there is one; else the cached ones."""
    fresh = [row for row in runs if not row.cached and row.real_time_factor is not None]
    return fresh or [row for row in runs if row.real_time_factor is not None]


def timed_on_one(runs: Sequence[RunRow], computer: str) -> list[RunRow]:
    """The runs whose times are compared: those with frame times that one computer has made.

    Args:
        runs: Some runs.
        computer: Taken where it made one of the runs; else it is the one that made most of them.
    """
    by_computer = grouped(timed(runs), lambda row: row.computer)
    if computer in by_computer:
        return by_computer[computer]
    return max(by_computer.values(), key=lambda rows: (len(rows), rows[0].computer), default=[])


def mean_coverage(rows: Sequence[RunRow]) -> tuple[float | None, float | None]:
    """Mean coverage of runs, and the mean share of the truth's time of those whose frames are not known."""
    return mean_of(row.coverage for row in rows), mean_of(row.truth_share for row in rows)


def mean_of(values: Iterable[float | None]) -> float | None:
    """Mean of what is known; None if nothing is."""
    present = [value for value in values if value is not None]
    return float(np.mean(present)) if present else None


# -- the cells that are missing, and the commands that fill them


def missing_cells(board: Board) -> dict[str, list[str]]:
    """The sequences on which each tracker that could be ranked was not run."""
    rankable = [key for key in board.trackers if board.is_rankable(key)]
    missing = {
        key: [name for name in board.sequences if name not in board.cells[key]] for key in rankable
    }
    return {key: names for key, names in missing.items() if names}


def missing_note(board: Board) -> str:
    """One paragraph: what the ranking stands on, and what is missing for more; empty where nothing is."""
    missing = missing_cells(board)
    if not missing:
        return ""
    sentences = []

    # what the ranking stands on, and who is not in it
    n_common = len(board.common)
    n_sequences = len(_each_once(board, board.sequences))
    if board.on == "common" and board.ranked and n_common < n_sequences:
        sentences.append(
            f"The ranking stands on the {n_common} of {n_sequences} sequences that all ranked trackers have."
        )
    if board.incomplete:
        incomplete = ", ".join(board.labels[key] for key in board.incomplete)
        why = "lack sequences" if board.on == "all" else "lack too many of the others' sequences"
        sentences.append(f"Not ranked, since they {why}: {incomplete}.")

    # name the cells that are missing
    cells = []
    for key, names in list(missing.items())[:_MOST_MISSING]:
        others = f" and {len(names) - 4} more" if len(names) > 4 else ""
        cells.append(f"{board.labels[key]} on {', '.join(names[:4])}{others}")
    if len(missing) > _MOST_MISSING:
        cells.append(f"and {len(missing) - _MOST_MISSING} more trackers")
    sentences.append(
        f"Missing cells: {'; '.join(cells)}. The page Reproduce has the commands that fill them."
    )
    return " ".join(sentences)


def missing_commands(board: Board) -> list[str]:
    """Commands that make the runs of the missing cells of all that can be run here."""
    # one run for every sequence, which names it: if possible without noise and offset
    plainest = sorted(board.rows, key=lambda row: (row.sequence.noise is not None, row.offset))
    by_sequence = grouped(plainest, board.sequence)
    commands = []
    for key, names in missing_cells(board).items():
        tracker = board.first(key)
        if tracker.imported:
            continue

        # the seeds and offsets that the tracker has elsewhere
        repeats: list[str] = []
        for name in ("seed", "offset"):
            values = sorted({getattr(run, name) for run in board.runs(key)})
            if values != [0]:
                repeats += [f"--{name}", *map(str, values)]

        # one command for all sequences of which the same part is run
        missing = [by_sequence[name][0] for name in names]
        for part, rows in grouped(missing, lambda row: tuple(sequence_options(row))).items():
            places = [row.place or row.sequence.id for row in rows]
            commands.append(command_with(tracker, [*places, *part, *repeats]))
    return commands


# -- from results folders

_COLUMNS = {
    "string": (
        "run_id",
        "kind",
        "tracker",
        "label",
        "settings",
        "provenance",
        "sequence",
        "column_id",
        "frames",
        "split",
        "repeat",
        "status",
        "ending",
        "study",
        "protocol_id",
        "protocol_digest",
        "trajectory",
        "segmentation",
        "computer",
        "program_remark",
    ),
    "Int64": (
        "seed",
        "offset",
        "n_frames",
        "n_processed",
        "n_tracked",
        "noise",
    ),
    "boolean": (
        "ranked",
        "failed",
        "cached",
        "seen_in_training",
    ),
    "Float64": (
        "coverage",
        "truth_share",
        "score_m",
        "hold_last_pose_ate_m",
        "final_ate_m",
        "static_camera_ate_rmse_m",
        "frame_ms",
        "real_time_factor",
        "peak_memory_mb",
        "mask_iou",
        "epipolar_skipped",
        "rotation_uncertainty_deg",
    ),
}
"""Type of a column of `Board.frame` to the names."""


def load_frame(
    results: Sequence[Path] | Sequence[str] | RunStore | Path | str,
    protocol: Protocol | str = "tum-rgbd/v1",
    *,
    trials: bool = False,
) -> pd.DataFrame:
    """All runs of some results folders, scored under one protocol, one row a run.

    Args:
        results: Results folders, or a store.
        protocol: How to evaluate; SLAM is never run again for it.
        trials: Whether the trials of studies count like other runs.

    Returns:
        One line a run, with the columns of `Board.frame`.

    Raises:
        ReportError: There are no runs.
    """
    return load_board(results, protocol, trials=trials).frame()


def load_board(
    results: Sequence[Path] | Sequence[str] | RunStore | Path | str,
    protocol: Protocol | str = "tum-rgbd/v1",
    *,
    reference: str | None = None,
    on: RankingBasis = "common",
    rank_seen: bool = False,
    trials: bool = False,
) -> Board:
    """The board of some results folders: all runs, ordered and ranked as in a report.

    Args:
        results: Results folders, or a store.
        protocol: How to evaluate; SLAM is never run again for it.
        reference: Tracker id that errors are divided by, see `make_board`.
        on: Which sequences the ranking is taken over: ``common`` or ``all``, see `make_board`.
        rank_seen: Whether trackers are also ranked on scenes that the network behind their masks
            was trained on.
        trials: Whether the trials of studies count like other runs.

    Raises:
        ReportError: There are no rows, they mix protocols, or no run is of the reference.
    """
    loaded = load_runs(open_stores(results), get_protocol(protocol), trials=trials)
    return make_board(loaded.rows, reference, on, rank_seen=rank_seen)
