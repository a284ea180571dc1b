"""The workers of a Dask scheduler: what each of them has, and runs on those that can make them."""

import json
import logging
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Executor, Future
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from dynslam_bench.core import RunError, find_data_root, translate_errors
from dynslam_bench.core.fingerprint import versions
from dynslam_bench.core.version import install_hint
from dynslam_bench.envs import resolve_device
from dynslam_bench.runs.own_code import package_code
from dynslam_bench.segmentation.networks.checkpoints import COCO, cached_checkpoint
from dynslam_bench.sequences.catalogue import entry_of

_KIND = (
    "tracker",
    "settings",
    "sequence",
    "data_root",
    "camera",
    "device",
    "frames",
    "offset",
    "stride",
)
"""What decides whether a host can make a run."""
_LOOK_EVERY_S = 5.0


class DaskWorkers(Executor):
    """Hands runs to the workers of a Dask scheduler; one that a host refuses goes to others.

    Args:
        address: The scheduler's.

    Raises:
        RunError: ``distributed`` is not installed, or the scheduler does not answer.
    """

    def __init__(self, address: str) -> None:
        with translate_errors(
            RunError,
            "a scheduler needs the package distributed",
            install_hint("cluster"),
            of=ImportError,
        ):
            from distributed import Client
        # a lost scheduler is logged with tracebacks
        for name in ("distributed", "distributed.client"):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        hint = "for example tcp://host:8786"
        with translate_errors(
            RunError, f"no Dask scheduler answers at {address}", hint, of=(OSError, ValueError)
        ):
            self._client = Client(address, timeout="10s")
        self._executor = self._client.get_executor(pure=False)
        self._slots, self._look_again = Counter[str](), float("-inf")
        self._refused: dict[str, dict[str, RunError]] = defaultdict(dict)
        self._strangers: set[str] = set()

    def describe(
        self, sequences: Sequence[str], data_root: str | None = None
    ) -> list[dict[str, object]]:
        """What each worker has, as rows of a table; one that does not know this package gets no runs.

        Args:
            sequences: Ids or folders that runs will need.
            data_root: Folder of the recorded sequences.
        """
        own = _facts(sequences, data_root)
        workers = self._workers()
        answers = self._client.run(_facts, sequences, data_root, on_error="ignore")
        self._strangers = {_host(address) for address in workers.keys() - answers.keys()}
        unknown = {"code": "", "packages": set(), "device": "", "lacking": set()}
        return [
            {
                "worker": address,
                "code": "the same"
                if facts["code"] == own["code"]
                else "other"
                if facts["code"]
                else "none",
                "other packages": [
                    " ".join(pair) for pair in sorted(facts["packages"] - own["packages"])
                ],
                "device": facts["device"],
                "runs at a time": worker["nthreads"],
                "memory (GB)": (worker["memory_limit"] or 0) / 1e9,
                "lacks": sorted(facts["lacking"] - own["lacking"]),
            }
            for address, worker in workers.items()
            for facts in [answers.get(address, unknown)]
        ]

    def _workers(self) -> dict[str, dict[str, Any]]:
        return self._client.scheduler_info(n_workers=-1)["workers"]  # type: ignore[no-any-return]

    def submit(self, make: Callable[..., bytes], spec: str, *arguments: str) -> Future[bytes]:  # type: ignore[override]
        """Have a run made, as `run_packed` does."""
        if time.monotonic() > self._look_again:
            self._look_again, self._slots = time.monotonic() + _LOOK_EVERY_S, Counter()
            for address, worker in self._workers().items():
                self._slots[_host(address)] += worker["nthreads"]
        named = json.loads(spec)
        outcome = Future[bytes]()
        self._send(
            outcome, json.dumps([named[name] for name in _KIND]), set(), make, spec, *arguments
        )
        return outcome

    def _send(self, outcome: Future[bytes], kind: str, refusers: set[str], *call: Any) -> None:
        """Send a run, which `refusers` have refused, to hosts that have refused none of its kind."""
        refused = self._refused[kind]
        able = sorted(self._slots.keys() - refused.keys() - self._strangers)
        if refused and not able:
            outcome.set_exception(next(iter(refused.values())))
            return
        at_a_time = max(self._slots.values(), default=1)
        sent = self._executor.submit(
            _answer, at_a_time, *call, **({"workers": able} if refused or self._strangers else {})
        )
        outcome.add_done_callback(lambda outcome: sent.cancel() if outcome.cancelled() else None)
        sent.add_done_callback(partial(self._take, outcome, kind, refusers, call))

    def _take(
        self,
        outcome: Future[bytes],
        kind: str,
        refusers: set[str],
        call: tuple[Any, ...],
        sent: Future[Any],
    ) -> None:
        if error := CancelledError() if sent.cancelled() else sent.exception():
            died = RunError(
                f"every worker that was given the run died: {error}", "see the workers' logs"
            )
            outcome.set_exception(died if type(error).__name__ == "KilledWorker" else error)
        elif isinstance(answer := sent.result(), bytes):
            outcome.set_result(answer)
        elif answer[0] in refusers:
            outcome.set_exception(answer[1])
        else:
            self._refused[kind][answer[0]] = answer[1]
            self._send(outcome, kind, refusers | {answer[0]}, *call)

    def shutdown(self, *_: object, **__: object) -> None:
        """Leave the scheduler."""
        self._client.close()


def _host(address: str) -> str:
    return urlsplit(address).hostname or ""


def _answer(
    at_a_time: int, make: Callable[..., bytes], *arguments: str
) -> bytes | tuple[str, RunError]:
    """On a worker: the run, or which host refuses it and why."""
    from distributed import get_worker

    try:
        return make(*arguments, at_a_time=at_a_time)
    except RunError as error:
        return _host(get_worker().address), error


def _facts(sequences: Sequence[str], data_root: str | None) -> dict[str, Any]:
    """What this machine has."""
    lacking = {name for name in sequences if not _is_here(name, data_root)}
    return {
        "code": package_code(),
        "packages": set(versions().items()),
        "device": resolve_device(),
        "lacking": lacking | (set() if cached_checkpoint(COCO) else {f"network {COCO.id}"}),
    }


def _is_here(name: str, data_root: str | None) -> bool:
    """Whether a sequence lies on this machine; its content is looked at when a run begins."""
    if entry := entry_of(name):
        return entry.find(find_data_root(data_root)) is not None
    return name.startswith("synthetic/") or Path(name).is_dir()
