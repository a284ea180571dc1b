"""A repository with a small tracker in C++, or in Python where there is no compiler, and a commit for each version."""

import shutil
import subprocess
import sys
from pathlib import Path

COMPILER = shutil.which("g++") or shutil.which("c++")
CPP = r"""
#include <cstdio>
#include <cstdlib>
#include <cstring>
// It knows how the toy camera moves, up to noise of so many metres.
static const double NOISE_M = @NOISE@;
static const char* LOST_IN = "@LOST@";
static char line[1 << 16];
static long number(const char* key) {
    const char* at = strstr(line, key);
    return at ? atol(at + strlen(key)) : 0;
}
int main() {
    bool lost = false;
    while (fgets(line, sizeof line, stdin)) {
        if (strstr(line, "\"reset\"")) {
            srand(unsigned(number("\"seed\": ")) + 1);
            lost = *LOST_IN && strstr(line, LOST_IN);
            puts("{\"ok\": true}");
        } else if (strstr(line, "\"track\"")) {
            const long index = number("\"index\": ");
            const double x = 0.01 * index + NOISE_M * (rand() / double(RAND_MAX) - 0.5);
            if (lost)
                printf("{\"index\": %ld, \"state\": \"lost\", \"T_world_cam\": null}\n", index);
            else
                printf("{\"index\": %ld, \"state\": \"ok\", \"T_world_cam\": "
                       "[1,0,0,%.9f,0,1,0,0,0,0,1,0,0,0,0,1]}\n", index, x);
        } else {
            break;
        }
        fflush(stdout);
    }
}
"""
PYTHON = r"""
import json, random, sys
NOISE_M, LOST_IN = @NOISE@, "@LOST@"
lost = False
for line in sys.stdin:
    request = json.loads(line)
    if request["op"] == "reset":
        random.seed(request["seed"])
        lost = bool(LOST_IN) and LOST_IN in line
        answer = {"ok": True}
    elif request["op"] == "track":
        index = request["index"]
        x = 0.01 * index + NOISE_M * (random.random() - 0.5)
        pose = [1, 0, 0, x, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
        answer = {"index": index, "state": "lost" if lost else "ok", "T_world_cam": None if lost else pose}
    else:
        break
    print(json.dumps(answer), flush=True)
"""
SOURCE = "slam.cpp" if COMPILER else "slam.py"
TRACKER = "subprocess:./build/slam" if COMPILER else f"subprocess:{sys.executable} build/slam.py"
BUILD = (
    f"mkdir -p build && {COMPILER} -o build/slam slam.cpp"
    if COMPILER
    else "mkdir -p build && cp slam.py build"
)


def git(folder: Path, *arguments: str) -> str:
    """What git writes, as a user with a name."""
    identity = ["-c", "user.name=test", "-c", "user.email=test@example.org"]
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def write_version(folder: Path, noise_m: float, lost_in: str = "") -> None:
    """Write the tracker's source.

    Args:
        folder: The repository.
        noise_m: Its noise.
        lost_in: Text of the request `reset` by which a sequence is known that it loses.
    """
    source = CPP if COMPILER else PYTHON
    (folder / SOURCE).write_text(source.replace("@NOISE@", str(noise_m)).replace("@LOST@", lost_in))


def make_repository(folder: Path, noise_m: float = 0.01) -> Path:
    """A repository with one commit."""
    folder.mkdir(parents=True)
    git(folder, "init", "-q", "-b", "main")
    (folder / ".gitignore").write_text("build/\nresults/\n")
    write_version(folder, noise_m)
    commit(folder, "first")
    return folder


def commit(folder: Path, message: str) -> str:
    """Commit everything; returns the hash."""
    git(folder, "add", "-A")
    git(folder, "commit", "-q", "-m", message)
    return git(folder, "rev-parse", "HEAD")
