"""``report make|publish|compare|audit-paper``, and ``published``."""

from pathlib import Path
from typing import Annotated, Optional

import typer

from dynslam_bench.cli.options import AsJson, DataRoot, DefaultGroup, ProtocolId, names_of
from dynslam_bench.cli.output import announce, present, progress, report_table, warn, wrapped
from dynslam_bench.core import ReportError, did_you_mean, find_data_root, write_atomic

MOST_ROWS = 5
"""Rows of the leaderboard that `report` shows."""
app = typer.Typer(
    cls=DefaultGroup,
    help="Reports of stored runs: `report [RESULTS...] [-o DIR]` is short for `report make ...`.",
)


MostPages = Annotated[
    Optional[int],
    typer.Option(
        min=0,
        help="Runs that have a page of their own; default all of up to 5000, of more some 2000.",
    ),
]


@app.command()
def make(
    results: Annotated[
        Optional[list[Path]],
        typer.Argument(
            help="Results folders, default ./results; manifests of trajectories (.toml) become banks here."
        ),
    ] = None,
    output: Annotated[
        Optional[Path], typer.Option("-o", "--output", help="Folder of the report.")
    ] = None,
    protocol: ProtocolId = "tum-rgbd/v1",
    reference: Annotated[
        Optional[str],
        typer.Option(
            help="Tracker that errors are divided by; default orb-slam2, else a static camera."
        ),
    ] = None,
    on: Annotated[
        str,
        typer.Option(
            help="common: rank on the sequences that all have; all: only trackers that have all."
        ),
    ] = "common",
    rank_seen: Annotated[
        bool,
        typer.Option(
            "--rank-seen", help="Rank also where the network behind the masks was trained."
        ),
    ] = False,
    trials: Annotated[
        bool,
        typer.Option(
            "--trials", help="Show the trials of studies, too, which are left out otherwise."
        ),
    ] = False,
    most_pages: MostPages = None,
    title: Annotated[str, typer.Option(help="Heading.")] = "Visual SLAM in dynamic scenes",
    as_json: AsJson = False,
) -> None:
    """Make an offline HTML page of stored runs, with Markdown, CSV and LaTeX beside it."""
    from dynslam_bench.api import report
    from dynslam_bench.reports.model.load import trial_words

    if on not in ("common", "all"):
        raise ReportError(f"--on is 'common' or 'all', got '{on}'")
    sources = [banked(source) for source in results or [Path("results")]]
    with progress("report") as advance:
        paths = report(
            sources,
            output,
            protocol=protocol,
            reference=reference,
            title=title,
            on=on,
            rank_seen=rank_seen,
            trials=trials,
            most_pages=most_pages,
            on_progress=advance,
        )

    # the headline, the first rows of the leaderboard, what is not in it, and the page
    board = paths.leaderboard
    in_mm = [column.name for column in board.columns if column.name.endswith(", mm")]
    columns = ["#", "tracker", *in_mm, "better?", "success", "coverage", "× real time"]
    more = len(board.rows) - MOST_ROWS
    lines = [
        *(wrapped(sentence) for sentence in [*paths.answers, paths.headline]),
        report_table(board, columns, MOST_ROWS),
        f"... and {more} more; {board.brief}" if more > 0 else board.brief,
    ]
    if paths.trials:
        lines.append(wrapped(f"Left out: {trial_words(paths.trials)}."))
    lines += failure_lines(paths.csv.get("failures"))
    lines.append(str(paths.html))
    facts = ("headline", "answers", "html", "markdown", "latex", "csv", "data")
    present({name: getattr(paths, name) for name in facts}, *lines)


def banked(source: Path) -> Path:
    """The bank that the trajectories of a manifest are added to, named as it is; another source as it is."""
    if source.suffix != ".toml":
        return source
    from dynslam_bench.runs.bank import add

    bank = Path(source.stem)
    merged = add([source], bank)
    announce(f"{source}: {len(merged.added)} trajectories added to the bank {bank}")
    for entry in merged.left_out:
        warn(f"left out {entry.path}: {entry.reason}")
    return bank


def failure_lines(file: Path | None) -> list[str]:
    """One line on how many runs failed, and whose, from a report's table of failures; none without."""
    import pandas as pd

    if file is None:
        return []
    failed = pd.read_csv(file, dtype=str, keep_default_na=False)
    # how a run ended, without where: `crashed at frame 5` counts as `crashed`
    ended = failed["ended"].str.extract(r"(.*?)(?:,| at |$)")[0]
    counts = (failed["tracker"] + " " + ended).value_counts()
    words = ", ".join(f"{name} ({count})" for name, count in counts.head(MOST_ROWS).items())
    if len(counts) > MOST_ROWS:
        words += f" and {len(counts) - MOST_ROWS} more"
    plural = "s" if len(failed) > 1 else ""
    return [wrapped(f"{len(failed)} run{plural} failed: {words}.")]


@app.command()
def publish(
    results: Annotated[list[Path], typer.Argument(help="Results folders.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="The site's folder, e.g. docs/example.")
    ],
    study: Annotated[
        Optional[list[Path]],
        typer.Option(
            help="Folder of a study with its page, as `tune run` names it; once for each study."
        ),
    ] = None,
    title: Annotated[str, typer.Option(help="Heading.")] = "Visual SLAM in dynamic scenes",
    remark: Annotated[
        str, typer.Option(help="What a reader should know, for the first page.")
    ] = "",
    protocol: ProtocolId = "tum-rgbd/v1",
    most_pages: MostPages = None,
    most_pictures: Annotated[
        Optional[int],
        typer.Option(
            min=0,
            help="Runs whose page has pictures, 0.4 MB each; default all failures and typical runs.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make a static site of stored runs and a study: one folder for any web server, or a repository."""
    from dynslam_bench.reports import publish as publish_site

    with progress("site") as advance:
        site = publish_site(
            results,
            output,
            studies=study or [],
            title=title,
            note=remark,
            protocol=protocol,
            most_pages=most_pages,
            most_pictures=most_pictures,
            on_progress=advance,
        )
    present(site, f"{site.index} ({site.files} files, {site.size_mb:.1f} MB)")


@app.command()
def compare(
    a: Annotated[Path, typer.Argument(help="Results folder, or folder of a report.")],
    b: Annotated[Path, typer.Argument(help="The other one.")],
    output: Annotated[
        Optional[Path],
        typer.Option(
            "-o",
            "--output",
            help="Folder of the page that shows it; default compare in the folder B.",
        ),
    ] = None,
    protocol: ProtocolId = "tum-rgbd/v1",
    as_json: AsJson = False,
) -> None:
    """Compare two results folders on the sequences that both have, with the same settings or with others."""
    from dynslam_bench.reports import compare as compare_results

    folder = output or (b if b.is_dir() else b.parent) / "compare"
    result = compare_results(a, b, protocol=protocol, output=folder)
    facts = {
        "verdicts": result.verdicts,
        "findings": result.findings,
        "differences": result.differences,
        "only_a": result.only_a,
        "only_b": result.only_b,
    }
    lines = [result.table.title, report_table(result.table), ""]
    for name, sentences in result.findings.items():
        lines.append(wrapped(f"{name}: {'. '.join(sentences)}."))
    lines += ["", wrapped(result.table.caption)]
    if result.only_a or result.only_b:
        lines.append(f"\nonly in {a}: {result.only_a} runs; only in {b}: {result.only_b} runs")
    present({"overall": result.overall, "html": result.page} | facts, *lines, str(result.page))


@app.command("audit-paper")
def audit_paper(
    data_root: DataRoot = None,
    output: Annotated[Optional[Path], typer.Option("-o", "--output", help="Markdown file.")] = None,
    as_json: AsJson = False,
) -> None:
    """Hold the numbers that the paper prints against arithmetic, and against a static camera."""
    from dynslam_bench.geometry import read_tum
    from dynslam_bench.reports.audit import audit_paper as audit
    from dynslam_bench.reports.model.published import claimed_results
    from dynslam_bench.sequences.catalogue import entry_of

    # the ground truths that are on this machine, for the static camera's error
    truth = {}
    for name in sorted(set(claimed_results()["sequence"])):
        entry = entry_of(name)
        folder = None if entry is None else entry.find(find_data_root(data_root))
        if folder is not None and (folder / "groundtruth.txt").is_file():
            truth[name] = read_tum(folder / "groundtruth.txt")
    findings = audit(truth)
    lines = []
    for findings_table in (findings.summary(), findings.details()):
        lines += [
            findings_table.title,
            report_table(findings_table),
            "",
            wrapped(findings_table.caption),
            "",
        ]
    if output is not None:
        write_atomic(output, findings.to_markdown())
        lines = [str(output)]
    present(findings.findings, *lines)


def published(
    sequence: Annotated[
        str,
        typer.Argument(
            help="Id or published folder name.",
            autocompletion=names_of("cli.reports:published_sequences"),
        ),
    ],
    protocol: Annotated[
        Optional[str],
        typer.Option(
            "--protocol",
            help="Only what is known to be scored alike; see `protocols list`.",
            autocompletion=names_of("evaluation.protocol:PROTOCOLS"),
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show the published errors of a sequence: whose, how measured, and their spread."""
    from dynslam_bench.evaluation import get_protocol
    from dynslam_bench.reports.model.published import published_for, spans
    from dynslam_bench.reports.tables.published import published_table, span_table
    from dynslam_bench.sequences.catalogue import entry_of

    entry = entry_of(sequence)
    name = sequence if entry is None else entry.id
    if name not in published_sequences():
        raise ReportError(
            f"no published number of '{name}' was read", did_you_mean(name, published_sequences())
        )
    numbers = published_for([name], None if protocol is None else get_protocol(protocol))
    errors = published_table(numbers)
    if errors is None:
        raise ReportError(
            f"no published number of '{name}' is known to be scored as {protocol}",
            "leave --protocol out",
        )
    differing = spans(numbers)
    facts = {"spans": differing.to_dict("records"), "numbers": numbers.to_dict("records")}
    lines = []
    span = span_table(differing)
    if span is not None:
        lines += [f"{span.title}, on {name}:", report_table(span.without("sequence")), ""]
    lines += [f"{errors.title} of {name}:", report_table(errors.without("sequence")), ""]
    lines.append(wrapped(errors.caption))
    present(facts, *lines)


def published_sequences() -> list[str]:
    """The sequences of which published numbers were read."""
    from dynslam_bench.reports.model.published import published as numbers

    return sorted(set(numbers()["sequence"]))
