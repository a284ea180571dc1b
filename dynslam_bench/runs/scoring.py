"""Scores runs in a process that has imported no plug-in.

A plug-in may patch numpy when it is imported. A process that has imported one to run it would score
all trackers with the patched functions.
"""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from dynslam_bench.core import InfrastructureError, TemporaryFolder
from dynslam_bench.core.errors import hidden_folders, hide_folder_in_messages
from dynslam_bench.evaluation import Protocol
from dynslam_bench.runs.process.fork_server import Child
from dynslam_bench.runs.process.jobs import make_job
from dynslam_bench.runs.process.supervisor import supervise
from dynslam_bench.runs.record import MetricRecord
from dynslam_bench.runs.spec import Limits
from dynslam_bench.runs.store import RunStore

_WORK = f"{__name__}:score_job"


def score_apart(
    store: RunStore, run_id: str, protocol: Protocol, *, again: bool = False
) -> MetricRecord:
    """The metrics of a stored run under a protocol, computed in a process of its own; see `RunStore.score`.

    Raises:
        InfrastructureError: The process could not do it.
        DynslamError: The run cannot be read.
    """
    with closing(TemporaryFolder()) as folder:
        job = make_job(
            _WORK,
            folder.path,
            spec={"threads": 1},
            store=str(store.root),
            source=str(store.source),
            hidden=[str(hidden) for hidden in hidden_folders()],
            run_id=run_id,
            protocol=protocol.model_dump(mode="json"),
            again=again,
        )
        verdict = supervise(Child(), job, Limits(), located=False)
    if "metrics" not in verdict.final:
        raise InfrastructureError(
            f"run {run_id} cannot be scored: {verdict.reason}", "the same command scores it again"
        )
    return MetricRecord.parse(verdict.final["metrics"], f"the score of run {run_id}")


def score_job(
    job: dict[str, Any], send: Callable[[dict[str, Any]], None], stopping: Callable[[], bool]
) -> dict[str, Any]:
    """In the child: score a run of a store, which keeps the metrics."""
    store = RunStore(job["store"])
    store.source = Path(job["source"])  # what messages call it
    for folder in job["hidden"]:  # an archive or a bank may be unpacked there
        hide_folder_in_messages(Path(folder))
    record = store.read_whole(job["run_id"])
    metrics = store.score(record, Protocol.model_validate(job["protocol"]), again=job["again"])
    return {"type": "done", "metrics": metrics.to_line()}
