"""Reference pages that are made of the code: its docstrings, settings, command line, trackers and protocols.

python .ci/site/generated.py      # write those of docs/reference/ again, and the JSON Schemas
"""

from __future__ import annotations

import inspect
import itertools
import json
import re
import textwrap
from pathlib import Path

from dynslam_bench.contracts import TrackerSpec
from dynslam_bench.core.settings import Settings, flatten, settings_table
from dynslam_bench.envs import STATS_LAYOUT
from dynslam_bench.evaluation import PROTOCOLS
from dynslam_bench.gate import GateResult
from dynslam_bench.reports.model.board import Board
from dynslam_bench.reports.model.published import KINDS, lines_of, records
from dynslam_bench.runs import RunRecord, load_frames
from dynslam_bench.runs.rows import runs_frame
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.tuning.storage import trials_frame

PACKAGES = {
    "api": ("Public interface", ["api"]),
    "contracts": ("Contracts, settings, errors", ["contracts", "core.settings", "core.errors"]),
    "sequences": (
        "Sequences and geometry",
        [
            "sequences",
            "sequences.synthetic",
            "geometry.camera",
            "geometry.trajectory",
            "geometry.se3",
        ],
    ),
    "evaluation": ("Evaluation", ["evaluation"]),
    "trackers": (
        "Trackers",
        ["trackers", "trackers.systems.composition", "trackers.adapters.serve", "slam.pipeline"],
    ),
    "environments": ("Environments", ["envs"]),
    "runs": ("Runs and suites", ["runs", "suites"]),
    "reports": ("Reports", ["reports"]),
    "tuning": ("Studies", ["tuning"]),
    "gate": (
        "The gate",
        ["gate", "gate.checking", "gate.config", "gate.result", "evaluation.gate"],
    ),
    "rounds": ("Sealed rounds", ["rounds", "rounds.files", "sequences.synthetic.sealed"]),
    "testing": ("Checks for plug-ins", ["testing"]),
}
"""Pages, with their titles and the modules on them."""

HEADER = ("sequence", "m", "system", "input", "alignment", "protocol", "hardware", "source", "read")
"""Columns of a table of published errors."""

MADE = "<!-- Made by python .ci/site/generated.py -->\n\n"
"""First line of a page that the repository holds; it is not edited by hand."""

JSON_SCHEMA = "https://json-schema.org/draft/2020-12/schema"
"""The dialect that pydantic writes."""

MANY = 6
"""More trackers than this that share a group of settings are counted, not named."""


def reference_pages() -> dict[str, str]:
    """Markdown of the pages that the repository holds, by their path below ``docs/``."""
    pages = {
        "settings": settings(),
        "commands": commands(),
        "systems": systems(),
        "protocols": protocols(),
    }
    pages |= {"columns": columns(), "published": published()}
    return {f"reference/{name}.md": MADE + text.strip() + "\n" for name, text in pages.items()}


def schemas() -> dict[str, str]:
    """JSON Schemas that are installed with the package, by their path below the checkout."""
    schema = GateResult.model_json_schema(mode="serialization")
    text = json.dumps({"$schema": JSON_SCHEMA} | schema, indent=1) + "\n"
    return {"dynslam_bench/gate/gate.schema.json": text}


def docstring_pages() -> dict[str, str]:
    """Markdown of the pages of docstrings, which only the site shows, by their path on it.

    The search ranks them behind the guides, whose words they repeat.
    """
    pages = {}
    behind = "---\nsearch:\n  boost: 0.01\n---\n\n"
    for name, (title, modules) in PACKAGES.items():
        sections = [f"## {module}\n\n::: dynslam_bench.{module}\n\n" for module in modules]
        pages[f"reference/python/{name}.md"] = f"{behind}# {title}\n\n" + "".join(sections)
    return pages


def settings() -> str:
    """Every group of settings that some tracker has, once, with the defaults in which trackers differ."""
    groups: dict[tuple[str, type[Settings]], dict[str, Settings]] = {}
    for found in TRACKERS.all():
        root = found.spec.settings()
        for name, value in root:
            if isinstance(value, Settings):
                groups.setdefault((name, type(value)), {})[found.spec.id] = value
    text = [
        "# Settings\n\nEvery group of settings that a built-in tracker has. On the command line a setting is "
        "`--set GROUP.NAME=VALUE`, in a file `GROUP.NAME = VALUE`; a study draws those that have a range, an agent "
        "changes those that are *online*. What a tracker has: [Systems](systems.md), or "
        "`dynslam-bench trackers info ID`.\n"
    ]
    last = ""
    for (name, cls), held in sorted(
        groups.items(), key=lambda group: (group[0][0], -len(group[1]), group[0][1].__name__)
    ):
        text += [f"## {name}\n"] if name != last else []
        last = name
        text.append(
            f"### {cls.__name__} {{ #{anchor(name, cls)} }}\n\n{(cls.__doc__ or '').strip()}\n"
        )
        text.append(f"{_held_by(sorted(held))}\n\n{settings_table(cls)}")
        text += _other_defaults(cls, held)
    return "\n".join(text)


def _other_defaults(cls: type[Settings], held: dict[str, Settings]) -> list[str]:
    usual = flatten(cls())
    lines = [
        f"- `{tracker}`: "
        + ", ".join(
            f"`{name}` is `{value}`"
            for name, value in flatten(group).items()
            if usual[name] != value
        )
        for tracker, group in sorted(held.items())
        if flatten(group) != usual
    ]
    return ["Other defaults:\n\n" + "\n".join(lines) + "\n"] if lines else []


def slug(tracker: str) -> str:
    """The anchor of a tracker; ids of variants hold characters that no anchor may have."""
    return tracker.translate(str.maketrans("?=&", "---"))


def anchor(name: str, cls: type[Settings]) -> str:
    """Where a group's table stands on the page of settings."""
    return f"{name}-{cls.__name__.lower()}"


def systems() -> str:
    """Every built-in tracker: what it is, whose it is, what was assumed, which settings it has."""
    specs = [found.spec for found in TRACKERS.all()]
    rows = [
        f"| [`{s.id}`](#{slug(s.id)}) | {s.label} | {s.provenance} | {'yes' if s.ranked else 'no'} | {s.summary} |"
        for s in specs
    ]
    table = "\n".join(
        [
            "| id | label | provenance | ranked | what it does |",
            "| --- | --- | --- | --- | --- |",
            *rows,
        ]
    )
    intro = "Every built-in tracker. [What the provenance means](../explanation/baselines.md)"
    return f"# Systems\n\n{intro}\n\n{table}\n\n" + "\n".join(_system(spec) for spec in specs)


def _system(spec: TrackerSpec) -> str:
    root = spec.settings()
    groups = [
        f"[{name}](settings.md#{anchor(name, type(value))})"
        for name, value in root
        if isinstance(value, Settings)
    ]
    alone = [f"`{name}`" for name, value in root if not isinstance(value, Settings)]
    facts = {
        "Source": spec.citation,
        "Licence": spec.license,
        "Needs": ", ".join(f"`{hint}`" for hint in spec.requires.values()),
        "Settings": ", ".join([*groups, *alone]),
        "Presets": ", ".join(f"`{preset}`" for preset in spec.presets),
        "Assumed": "; ".join(spec.assumptions),
        "Remarks": spec.remarks,
    }
    lines = "\n".join(f"- **{name}.** {value}" for name, value in facts.items() if value)
    return f"## {spec.label} {{ #{slug(spec.id)} }}\n\n`{spec.id}`: {spec.summary}.\n\n{lines}\n"


def protocols() -> str:
    """Every named protocol with all of its fields."""
    text = [
        "# Protocols\n\nEvery named protocol with its fields. [Why numbers differ](../explanation/protocols.md)\n"
    ]
    for name, protocol in PROTOCOLS.items():
        values = protocol.model_dump(mode="json")
        lines = "\n".join(
            f"| `{field}` | `{value}` |" for field, value in values.items() if value not in ("", [])
        )
        text.append(
            f"## {name}\n\n{protocol.describe()}\n\n| field | value |\n| --- | --- |\n{lines}\n"
        )
    return "\n".join(text)


def columns() -> str:
    """The columns of every frame that the package makes, and the fields of a run's record."""
    frames = {
        "Runs": ("RunStore.frame()", inspect.getdoc(runs_frame)),
        "Frames of a run": ("load_frames(run)", inspect.getdoc(load_frames)),
        "Rows of a report": ("load_board(results).frame()", inspect.getdoc(Board.frame)),
        "Trials of a study": ("Study.open(folder).frame()", inspect.getdoc(trials_frame)),
    }
    text = [
        "# Columns\n\nColumns, units and types of every pandas frame, and the fields of `run.json`.\n"
    ]
    for title, (call, docstring) in frames.items():
        text.append(f"## {title}\n\n`{call}`\n\n{_section(docstring or '', 'Returns')}\n")
    text.append(
        "## The observation `stats`\n\nEntries lie in [0, 1], those of the motion in [-1, 1].\n"
    )
    text.append(
        "What a tracker does not report is 0.\n\n| index | name | meaning |\n| --- | --- | --- |"
    )
    text += [
        f"| {index} | `{name}` | {meaning} |" for index, (name, meaning) in enumerate(STATS_LAYOUT)
    ]
    text.append("\n## The record of a run\n\n`run.json`\n\n| field | meaning |\n| --- | --- |")
    for entry in re.split(r"\n(?=\w+: )", _section(inspect.getdoc(RunRecord) or "", "Attributes")):
        name, _, meaning = entry.partition(": ")
        text.append(f"| `{name}` | {' '.join(meaning.split())} |")
    return "\n".join(text) + "\n"


def published() -> str:
    """The lowest published errors by sequence, a table a kind."""
    text = [
        "# Published errors\n\nThe lowest absolute trajectory errors found in print, by sequence: RMSE in metres.\n"
    ]
    text.append("[How to read them](../how-to/published.md#read-the-numbers)\n")
    frame = records()
    for kind, title in KINDS.items():
        text.append(
            f"## {title[0].upper()}{title[1:]}\n\n| {' | '.join(HEADER)} |\n|{' --- |' * len(HEADER)}"
        )
        for r in lines_of(frame[frame["kind"] == kind]):
            protocol = f"`{r.protocol}`" if r.protocol else "-"
            cells = (r.system, r.input, r.alignment, protocol, r.hardware, r.source, r.how)
            text.append(f"| `{r.sequence}` | {r.value:g} | {' | '.join(cells)} |")
        text.append("")
    return "\n".join(text)


def _section(docstring: str, name: str) -> str:
    """A section of a Google-style docstring, without its indentation."""
    lines = docstring.partition(f"\n{name}:\n")[2].split("\n")
    body = list(itertools.takewhile(lambda line: not line or line.startswith(" "), lines))
    return textwrap.dedent("\n".join(body)).strip()


def commands() -> str:
    """The whole command line, as its help says it."""
    import typer.cli
    import typer.main

    from dynslam_bench.cli.app import app

    command = typer.main.get_command(app)
    with command.make_context("dynslam-bench", [], resilient_parsing=True) as context:
        return typer.cli.get_docs_for_click(
            obj=command, ctx=context, name="dynslam-bench", title="Commands"
        )


def _held_by(trackers: list[str]) -> str:
    if len(trackers) > MANY:
        return f"{len(trackers)} [systems](systems.md) have it."
    return (
        "Systems that have it: "
        + ", ".join(f"[`{name}`](systems.md#{slug(name)})" for name in trackers)
        + "."
    )


if __name__ == "__main__":
    checkout = Path(__file__).resolve().parents[2]
    pages = {f"docs/{page}": text for page, text in reference_pages().items()}
    for file, text in (pages | schemas()).items():
        (checkout / file).write_text(text, encoding="utf-8")
