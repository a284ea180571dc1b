"""Runs functions of plug-ins in forked processes while their reads are recorded, as the fork server does.

Each line of standard input is a job (`Job` in test_runs_reads.py), each line of standard output its
outcome.
"""

import json
import os
import sys
import tempfile
from pathlib import Path

from dynslam_bench.core import DynslamError
from dynslam_bench.core.plugins import ISOLATED_VARIABLE, load_object
from dynslam_bench.core.reads import BaseFolders, ImportPath, digest_of
from dynslam_bench.runs.process.recorder import ReadRecorder


def record(job, answer):
    os.chdir(job["work"])
    os.environ.update(job["environment"] | {ISOLATED_VARIABLE: "1"})
    os.environ["TMPDIR"] = tempfile.tempdir = job["private"]
    sys.path[:0] = job["path"]
    plugin = Path(job["plugin"])
    folder = plugin.parent if plugin.suffix == ".py" else None
    recorder = ReadRecorder(
        BaseFolders(folder, Path(job["work"])),
        private=[Path(job["private"])],
        plugins=job["plugins"],
    )
    recorder.start()
    module = load_object(f"{plugin}:run").__globals__
    module["run"](**job["arguments"])
    if "again" in module:
        before = recorder.count, recorder.snapshot()
        answer({"paused": True})
        sys.stdin.readline()
        module["again"]()
        answer({"grown": [recorder.count > before[0], recorder.snapshot() != before[1]]})
    snapshot = recorder.snapshot()
    reads = recorder.finish()
    forks = list(Path(job["private"]).glob("reads-*"))
    assert forks or reads.programs or snapshot == digest_of(reads), (
        "the snapshot at the end is another than the result"
    )
    answer({"reads": reads.model_dump()})


ImportPath(sys.path).read_all()
for line in sys.stdin:
    received, sent = os.pipe()
    child = os.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        with os.fdopen(sent, "w") as stream:

            def answer(value):
                print(json.dumps(value), file=stream, flush=True)

            try:
                record(json.loads(line), answer)
            except DynslamError as error:
                answer({"fault": str(error)})
            except BaseException:
                import traceback

                answer({"broken": traceback.format_exc()})
        os._exit(0)
    os.close(sent)
    with os.fdopen(received) as stream:
        for text in stream:
            sys.stdout.write(text)
            sys.stdout.flush()
    os.waitpid(child, 0)
