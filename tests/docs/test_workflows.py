"""The hosted workflows, as far as they can be read here: steps are shell, and name files that exist."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
A_FILE = re.compile(r"(?<![\w./-])(?:tests|\.ci)/[\w./-]+")


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda workflow: workflow.stem)
def test_every_command_is_shell_and_names_files_that_exist(workflow: Path) -> None:
    jobs = yaml.safe_load(workflow.read_text(encoding="utf-8"))["jobs"]
    commands = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    assert commands
    for command in commands:
        plain = re.sub(r"\$\{\{.*?\}\}", "value", command)
        checked = subprocess.run(["bash", "-n", "-c", plain], capture_output=True, text=True)
        assert checked.returncode == 0, checked.stderr
        assert [name for name in A_FILE.findall(plain) if not (ROOT / name).exists()] == []
