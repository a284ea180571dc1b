"""How often a gate is wrong where nothing changed, what it finds, and what that costs.

    python tests/benchmarks/gate_errors.py [--simulations 2000] [--table null power stored]
    python tests/benchmarks/gate_errors.py --table stored --runs RESULTS   # stored runs of a noisy system

Simulated errors scatter from run to run by 5 to 30 % with the sequence, 18 % in the mean square, which is
what ORB-SLAM3 does. Worlds: normal; t with three degrees of freedom; few noisy, where one of eight
sequences scatters by 30 % and the others by 2 %; losses, where either side loses 3 % of its runs.

Designs beside the gate:

- fixed: so many rounds, then one t test at 5 %;
- 1.10 x: the median of three runs is frozen, and one candidate run above 1.10 times it on any sequence alarms.

With ``--runs`` the two sides of 200 gates are drawn without replacement from stored runs of one system,
so that nothing differs but the run.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from command_line import parser_of
from numpy.typing import NDArray

from dynslam_bench.evaluation.gate import (
    LOOKS,
    GateVerdict,
    decide,
    is_lost_more,
    log_ratios,
    mean_ratio,
)
from dynslam_bench.runs import open_store, score

Array = NDArray[np.float64]
SEQUENCES = (8, 16, 24)
CHANGES = (0.1, 0.2, 0.3)
SPREAD = 0.18
"""Scatter of the logarithm of a run's error, in the mean square over sequences."""
LOSS_SHARE = 0.03
FROZEN_RUNS = 3
MOST_ROUNDS = max(LOOKS)
GATES = 200
"""Gates that are drawn from stored runs."""


def spreads(sequences: int) -> Array:
    """The scatter of each sequence ``[S, 1]``."""
    values = np.linspace(0.05, 0.30, sequences)
    return np.asarray(SPREAD * values / np.sqrt(np.square(values).mean()))[:, None]


def normal(rng: np.random.Generator, sequences: int) -> Array:
    """Errors ``[S, K]`` of one side."""
    return np.exp(spreads(sequences) * rng.normal(size=(sequences, MOST_ROUNDS)))


def heavy_tails(rng: np.random.Generator, sequences: int) -> Array:
    """Student's t with three degrees of freedom, of the same standard deviation."""
    scatter = rng.standard_t(3, size=(sequences, MOST_ROUNDS)) / math.sqrt(3.0)
    return np.exp(spreads(sequences) * scatter)


def few_noisy(rng: np.random.Generator, sequences: int) -> Array:
    """One of eight sequences makes up nearly all of the scatter."""
    scatter = np.where(np.arange(sequences) % 8 == 0, 0.30, 0.02)[:, None]
    return np.exp(scatter * rng.normal(size=(sequences, MOST_ROUNDS)))


def losses(rng: np.random.Generator, sequences: int) -> Array:
    """Some runs are lost."""
    errors = normal(rng, sequences)
    return np.where(rng.random(errors.shape) < LOSS_SHARE, np.nan, errors)


WORLDS: dict[str, Callable[[np.random.Generator, int], Array]] = {
    "normal": normal,
    "t3": heavy_tails,
    "few noisy": few_noisy,
    "losses": losses,
}


class Decision(NamedTuple):
    """What a design says, and the runs of a sequence until then."""

    verdict: GateVerdict
    runs: int


def sequential(candidate: Array, baseline: Array) -> Decision:
    """The gate."""
    ratios = log_ratios(candidate, baseline)
    verdict = GateVerdict.UNDECIDED
    for rounds, level in LOOKS.items():
        lost = np.isnan(candidate[:, :rounds])
        lost_baseline = np.isnan(baseline[:, :rounds])
        counts = (int(lost.sum()), int(lost_baseline.sum()))
        verdict = decide(mean_ratio(ratios[:, :rounds]), counts)
        alone = int((lost & ~lost_baseline).sum())
        if is_lost_more(alone, int((lost_baseline & ~lost).sum()), level):
            verdict = GateVerdict.REGRESSED
        if verdict is not GateVerdict.UNDECIDED:
            return Decision(verdict, 2 * rounds)
    return Decision(verdict, 2 * MOST_ROUNDS)


def fixed(candidate: Array, baseline: Array, rounds: int) -> Decision:
    """So many rounds, then one test at 5 %."""
    ratios = log_ratios(candidate[:, :rounds], baseline[:, :rounds])
    return Decision(decide(mean_ratio(ratios, 0.05)), 2 * rounds)


def frozen(candidate: Array, baseline: Array) -> Decision:
    """One run of each sequence must stay below 1.10 times a frozen number."""
    first = baseline[:, :FROZEN_RUNS]
    all_lost = np.isnan(first).all(axis=1, keepdims=True)
    limits = 1.10 * np.nanmedian(np.where(all_lost, np.inf, first), axis=1)
    is_above = np.isnan(candidate[:, 0]) | (candidate[:, 0] > limits)
    verdict = GateVerdict.REGRESSED if is_above.any() else GateVerdict.NO_DIFFERENCE
    return Decision(verdict, 1)


DESIGNS: dict[str, Callable[[Array, Array], Decision]] = {
    "gate": sequential,
    "fixed 3": lambda candidate, baseline: fixed(candidate, baseline, 3),
    "fixed 10": lambda candidate, baseline: fixed(candidate, baseline, 10),
    "1.10 x": frozen,
}
CLAIMS = (GateVerdict.REGRESSED, GateVerdict.IMPROVED)


def line(*cells: object) -> str:
    """A row of a table."""
    return f"| {' | '.join(map(str, cells))} |"


def simulate(world: str, sequences: int, change: float, simulations: int) -> dict[str, str]:
    """How often each design claims what is there, or anything where nothing is; in % with runs a sequence."""
    rng = np.random.default_rng([sequences, round(100 * change), list(WORLDS).index(world)])
    hits: dict[str, int] = defaultdict(int)
    runs: dict[str, int] = defaultdict(int)
    for _ in range(simulations):
        baseline = WORLDS[world](rng, sequences)
        candidate = (1.0 + change) * WORLDS[world](rng, sequences)
        for name, design in DESIGNS.items():
            decision = design(candidate, baseline)
            wanted = (GateVerdict.REGRESSED,) if change else CLAIMS
            hits[name] += decision.verdict in wanted
            runs[name] += decision.runs
    return {
        name: f"{100 * hits[name] / simulations:.1f} ({runs[name] / simulations:.1f})"
        for name in DESIGNS
    }


def null(simulations: int, worlds: Sequence[str]) -> None:
    """*Regressed* or *improved* where nothing changed, in some worlds."""
    print("\nregressed or improved where nothing changed, % (runs a sequence); bar: 8 %\n")
    print(line("world", "sequences", *DESIGNS))
    print(line(*["---"] * (2 + len(DESIGNS))))
    for world in worlds:
        for sequences in SEQUENCES:
            found = simulate(world, sequences, 0.0, simulations)
            print(line(world, sequences, *found.values()), flush=True)


def power(simulations: int, worlds: Sequence[str]) -> None:
    """*Regressed* where the error has grown, in some worlds."""
    print("\nregressed where the error has grown, % (runs a sequence)\n")
    print(line("world", "change", "sequences", *DESIGNS))
    print(line(*["---"] * (3 + len(DESIGNS))))
    for world in worlds:
        for change in CHANGES:
            for sequences in SEQUENCES:
                found = simulate(world, sequences, change, simulations)
                print(line(world, f"{100 * change:.0f} %", sequences, *found.values()), flush=True)


def stored_errors(results: Path) -> Array:
    """Errors of stored runs ``[S, N]``, as many as every sequence has; nan where a run was lost."""
    store = open_store(results)
    errors: dict[str, list[float]] = defaultdict(list)
    for record in store.all()[0]:
        error = score(store, record).metrics.get("ate_rmse_m", math.nan)
        errors[record.sequence.block].append(error if record.status == "ok" else math.nan)
    count = min(map(len, errors.values()))
    if count < 2 * MOST_ROUNDS:
        raise SystemExit(f"{results} has {count} runs of a sequence: {2 * MOST_ROUNDS} are needed")
    return np.array([values[:count] for values in errors.values()])


def stored(results: Path) -> None:
    """Gates whose two sides are drawn from stored runs of one system."""
    errors = stored_errors(results)
    logs = np.log(errors)
    scatter = np.nanstd(logs, axis=1, ddof=1)
    print(f"\n{errors.shape[1]} runs of {len(errors)} sequences; their scatter: "
          f"{', '.join(f'{value:.2f}' for value in scatter)}; lost: {int(np.isnan(errors).sum())}\n")  # fmt: skip
    print(line("design", f"regressed or improved, of {GATES}", "runs a sequence"))
    print(line("---", "---", "---"))
    for name, design in DESIGNS.items():
        rng = np.random.default_rng(GATES)
        wrong = 0
        runs = 0
        for _ in range(GATES):
            order = np.argsort(rng.random(errors.shape), axis=1)
            drawn = np.take_along_axis(errors, order, axis=1)
            candidate = drawn[:, :MOST_ROUNDS]
            baseline = drawn[:, MOST_ROUNDS : 2 * MOST_ROUNDS]
            decision = design(candidate, baseline)
            wrong += decision.verdict in CLAIMS
            runs += decision.runs
        print(line(name, wrong, f"{runs / GATES:.1f}"), flush=True)


def main() -> None:
    """Print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--simulations", type=int, default=2000)
    parser.add_argument(
        "--table", nargs="+", choices=("null", "power", "stored"), default=["null", "power"]
    )
    parser.add_argument("--world", nargs="+", choices=WORLDS, default=list(WORLDS))
    parser.add_argument("--runs", type=Path, help="results folder with stored runs of one system")
    options = parser.parse_args()
    if "null" in options.table:
        null(options.simulations, options.world)
    if "power" in options.table:
        power(options.simulations, options.world)
    if "stored" in options.table:
        if options.runs is None:
            parser.error("--table stored needs --runs")
        stored(options.runs)


if __name__ == "__main__":
    main()
