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
from dynslam_bench.envs.slam_env import resolve_device
from dynslam_bench.runs.own_code import package_code
from dynslam_bench.segmentation.networks.checkpoints import CHECKPOINTS, cached_checkpoint
from dynslam_bench.sequences.catalogue import entry_of

_FIELDS_OF_KIND = (
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
"""Fields of a `RunSpec` that decide whether a host can make it: runs that are equal in these are of one kind."""
_COUNT_SLOTS_EVERY_S = 5.0
"""Seconds between two looks at the workers that there are."""


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
        # runs at a time of each host, and when they are counted again
        self._slots = Counter[str]()
        self._next_count = float("-inf")
        # by kind of run the hosts that cannot make it, with reasons
        self._refused: dict[str, dict[str, RunError]] = defaultdict(dict)
        # hosts that do not know this package
        self._strangers: set[str] = set()

    def describe(
        self, sequences: Sequence[str], data_root: str | None = None
    ) -> list[dict[str, object]]:
        """Describe each worker as a row of a table; one that does not know this package gets no runs.

        Args:
            sequences: Ids or folders that runs will need.
            data_root: Folder of the recorded sequences.
        """
        here = _facts(sequences, data_root)
        workers = self._workers()
        answers = self._client.run(_facts, sequences, data_root, on_error="ignore")
        self._strangers = {_host(address) for address in workers.keys() - answers.keys()}
        unknown = {"code": "", "packages": set(), "device": "", "lacking": set()}
        rows: list[dict[str, object]] = []
        for address, worker in workers.items():
            facts = answers.get(address, unknown)
            rows.append(
                {
                    "worker": address,
                    "code": _compare_code(facts["code"], here["code"]),
                    "other packages": [
                        " ".join(pair) for pair in sorted(facts["packages"] - here["packages"])
                    ],
                    "device": facts["device"],
                    "runs at a time": worker["nthreads"],
                    "memory (GB)": (worker["memory_limit"] or 0) / 1e9,
                    "lacks": sorted(facts["lacking"] - here["lacking"]),
                }
            )
        return rows

    def _workers(self) -> dict[str, dict[str, Any]]:
        """The scheduler's information on each worker, by its address."""
        return self._client.scheduler_info(n_workers=-1)["workers"]  # type: ignore[no-any-return]

    def submit(self, make: Callable[..., bytes], spec: str, *arguments: str) -> Future[bytes]:  # type: ignore[override]
        """Have a run made, as `run_packed` does."""
        now = time.monotonic()
        if now > self._next_count:
            self._next_count = now + _COUNT_SLOTS_EVERY_S
            self._slots = Counter()
            for address, worker in self._workers().items():
                self._slots[_host(address)] += worker["nthreads"]
        fields = json.loads(spec)
        kind = json.dumps([fields[name] for name in _FIELDS_OF_KIND])
        outcome = Future[bytes]()
        self._send(outcome, kind, set(), make, spec, *arguments)
        return outcome

    def _send(self, outcome: Future[bytes], kind: str, refusers: set[str], *call: Any) -> None:
        """Send a run to hosts that have refused none of its kind.

        Args:
            outcome: Gets the run, or why it was not made.
            kind: The kind of the run.
            refusers: Hosts that have refused this run.
            *call: The function that makes it, and its arguments.
        """
        refused = self._refused[kind]
        able = sorted(self._slots.keys() - refused.keys() - self._strangers)
        if refused and not able:
            outcome.set_exception(next(iter(refused.values())))
            return
        at_a_time = max(self._slots.values(), default=1)
        # without a reason to choose, the scheduler does
        choice = {"workers": able} if refused or self._strangers else {}
        sent = self._executor.submit(_answer, at_a_time, *call, **choice)
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
        """Take the answer to a run that was sent, see `_send`; one that a host has refused is sent to others."""
        error = CancelledError() if sent.cancelled() else sent.exception()
        if error is not None:
            died = RunError(
                f"every worker that was given the run died: {error}", "see the workers' logs"
            )
            outcome.set_exception(died if type(error).__name__ == "KilledWorker" else error)
            return
        answer = sent.result()
        if isinstance(answer, bytes):
            outcome.set_result(answer)
            return
        host, refusal = answer
        if host in refusers:
            outcome.set_exception(refusal)
            return
        self._refused[kind][host] = refusal
        self._send(outcome, kind, refusers | {host}, *call)

    def shutdown(self, *_: object, **__: object) -> None:
        """Leave the scheduler."""
        self._client.close()


def _compare_code(code: str, here: str) -> str:
    """The code of a worker in words, by its digest and that of this machine."""
    if code == here:
        return "the same"
    return "other" if code else "none"


def _host(address: str) -> str:
    """The host of a worker's address."""
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
    """Description of this machine: code, packages and device, and which sequences and networks it lacks."""
    lacking = {name for name in sequences if not _is_here(name, data_root)}
    for checkpoint in CHECKPOINTS.values():
        if not cached_checkpoint(checkpoint):
            lacking.add(f"network {checkpoint.id}")
    return {
        "code": package_code(),
        "packages": set(versions().items()),
        "device": resolve_device(),
        "lacking": lacking,
    }


def _is_here(name: str, data_root: str | None) -> bool:
    """Whether a sequence lies on this machine; its content is looked at when a run begins."""
    if entry := entry_of(name):
        return entry.find(find_data_root(data_root)) is not None
    return name.startswith("synthetic/") or Path(name).is_dir()
