"""What the distribution holds: every package, and nothing that is none."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def project() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_every_package_is_listed(project: dict) -> None:
    """A package that is forgotten is missing from the wheel, and nothing says so."""
    homes = {"": "dynslam_bench", ".envs": "envs", ".tuning": "tuning", ".reports": "reports"}
    found = {
        "dynslam_bench"
        + prefix
        + "".join(f".{part}" for part in init.parent.relative_to(ROOT / home).parts)
        for prefix, home in homes.items()
        for init in (ROOT / home).rglob("__init__.py")
    }
    assert set(project["tool"]["setuptools"]["packages"]) == found


def test_the_recipe_names_what_the_package_needs(project: dict) -> None:
    recipe = (ROOT / "packaging" / "conda" / "recipe.yaml").read_text()
    other = {"opencv-python-headless": "py-opencv", "torch": "pytorch"}
    needed = [
        line.partition(";")[0].replace(" ", "").partition(">=")
        for line in project["project"]["dependencies"]
    ]
    assert len(needed) > 10
    wanted = [f"- {other.get(name, name)} >={number}" for name, _, number in needed]
    assert [line for line in wanted if f"    {line}\n" not in recipe] == []


def test_every_page_of_the_documentation_is_in_the_navigation() -> None:
    """The site's strict build refuses a page that is not; this says so without the site's packages."""
    settings = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    left_out = ("lab", "paper", "example")
    pages = [
        page.relative_to(ROOT / "docs").as_posix()
        for page in (ROOT / "docs").rglob("*.md")
        if page.relative_to(ROOT / "docs").parts[0] not in left_out
    ]
    assert len(pages) > 30
    assert [
        page for page in pages if not re.search(rf"[:-] {re.escape(page)}$", settings, re.M)
    ] == []


# The hosted workflows, as far as they can be read here: steps are shell, and name files that exist.


WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
A_FILE = re.compile(r"(?<![\w./-])(?:tests|\.ci)/[\w./-]+")


@pytest.mark.slow
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
