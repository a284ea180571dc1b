"""Make the tables of a page of `docs/results/`: run each section's command and put its output below it.

    python tests/benchmarks/results.py docs/results/flow.md                   # list the sections of
    a page python tests/benchmarks/results.py docs/results/flow.md "Speed"           # run one
    section's command python tests/benchmarks/results.py docs/results/flow.md --all

A section is a heading, what the table shows, a block of commands, a line that begins with
``*Made at``, and the table:

    ## Speed

    Median time of a frame.

    ```bash
    python tests/benchmarks/flow_speed.py
    ```

    *Made at 1a2b3c4d on 2026-11-25; two cores of an AMD EPYC; data: fr1_xyz, fr1_rpy.*

What follows that line, up to the next heading, is replaced by what the commands print. Commit, date
and machine are written again, `data` stays as it is. A new table is a section without the line:
``--data`` says what it is made of.
"""

import datetime
import os
import platform
import re
import subprocess
import sys
from pathlib import Path

from command_line import parser_of

ROOT = Path(__file__).resolve().parents[2]
MADE = re.compile(
    r"^\*Made at (?P<commit>[0-9a-f]{8}\+?) on (?P<date>\d{4}-\d\d-\d\d); (?P<machine>.+?); data: (?P<data>.+?)\.\*$",
    re.MULTILINE,
)
COMMANDS = re.compile(r"^```bash\n(.*?)^```\n", re.DOTALL | re.MULTILINE)


def sections(page: str) -> dict[str, str]:
    """A page's sections by their headings, each with its heading."""
    return {
        part.partition("\n")[0][3:]: part
        for part in re.split(r"^(?=## )", page, flags=re.MULTILINE)[1:]
    }


def made_at() -> str:
    """Revision of the checkout (with ``+`` where files differ from it), date and machine."""
    commit = _run("git rev-parse --short=8 HEAD").strip() + (
        "+" if _run("git status --porcelain -uno") else ""
    )
    model = re.search(r"model name\s*: (.+)", _run("cat /proc/cpuinfo 2>/dev/null || true"))
    machine = model[1] if model else platform.processor() or platform.machine()
    return (
        f"*Made at {commit} on {datetime.date.today()}; {os.cpu_count()} cores of {machine}; data: "
    )


def remade(section: str, data: str = "") -> str:
    """A section with what its commands print now."""
    block = COMMANDS.search(section)
    if block is None:
        raise SystemExit(f"error: '{section.splitlines()[0]}' has no block of commands")
    before = MADE.search(section)
    data = data or (before["data"] if before else "")
    if not data:
        raise SystemExit("error: --data says what a new table is made of")
    made = made_at()
    printed = _run(block[1]).strip()
    if not re.search(r"^\|", printed, re.MULTILINE):
        printed = f"```text\n{printed}\n```"
    return f"{section[: block.end()]}\n{made}{data}.*\n\n{printed}\n\n"


def _run(command: str) -> str:
    return subprocess.run(
        ["bash", "-euc", command],
        cwd=ROOT,
        env=os.environ
        | {
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
        },
        check=True,
        capture_output=True,
        text=True,
    ).stdout


def main() -> None:
    """Run the commands of the chosen sections and rewrite the page."""
    parser = parser_of(__doc__, all=False, data="")
    parser.add_argument("page", type=Path)
    parser.add_argument("sections", nargs="*")
    options = parser.parse_args()
    page = options.page.read_text(encoding="utf-8")
    parts = sections(page)
    for name in parts if options.all else options.sections:
        if name not in parts:
            raise SystemExit(f"error: no section '{name}'; there are: {', '.join(parts)}")
        page = page.replace(parts[name], remade(parts[name], options.data))
    options.page.write_text(page.rstrip("\n") + "\n", encoding="utf-8")
    if not options.all and not options.sections:
        print("\n".join(parts))


if __name__ == "__main__":
    main()
