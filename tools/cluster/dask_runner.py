"""Run tasks by Dask: on processes of this machine, or on the workers of a scheduler.

Tasks pass on their results in files. A worker that is killed therefore costs the tasks that it was running: Dask starts
them on another worker, and whatever other tasks have written stays.

The processes of Dask exchange pickled objects, and whoever reaches a scheduler can run code. The processes of a local
cluster therefore listen on loopback only, under TLS with certificates that exist in their memory only, and without
dashboard. A scheduler elsewhere is reached by TLS only.
"""

import logging
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from socast.core.errors import SettingsError
from socast.tools.cluster.runner import TaskRecord, run_task

INSTALL: Final = 'pip install "socast[cluster]"'
LOCAL: Final = "local"
LOOPBACK: Final = ("127.0.0.1", "localhost", "[::1]")
CONNECT_S: Final = 60.0
"""Longest time to reach a scheduler, and to start workers on a loaded machine. [s]"""
CERTIFICATES: Final = {
    "ca_file": "DASK_DISTRIBUTED__COMM__TLS__CA_FILE",
    "cert": "DASK_DISTRIBUTED__COMM__TLS__CLIENT__CERT",
    "key": "DASK_DISTRIBUTED__COMM__TLS__CLIENT__KEY",
}
"""What a client needs for TLS -> environment variable from which Dask takes its file."""
KEPT_BYTES: Final = 1 << 28
"""Free memory that a worker keeps for its next arrays. With Dask's own 64 kB, the system clears new memory for every
array, and making tables takes about a fifth more processor time. [B]"""
_PACKAGES: Final = ("numpy", "numba", "pandas", "pyarrow", "msgspec", "distributed")
_GB: Final = 10**9
_CONFIG: Final = {
    "distributed.comm.timeouts.connect": f"{CONNECT_S:.0f}s",
    "distributed.admin.tick.limit": "1h",
    "distributed.worker.profile.enabled": False,
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": KEPT_BYTES,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": KEPT_BYTES // 4,
    **{f"distributed.{node}.http.routes": [] for node in ("scheduler", "worker", "nanny")},
}


@dataclass(frozen=True)
class ClusterPlace:
    """Say where tasks run.

    Parameters
    ----------
    address : str
        Address of a scheduler; empty for processes of this machine.
    worker_memory : float
        Memory at which Dask restarts one of them. [GB]
    report : Path, optional
        File that says at the end what ran where.
    """

    address: str
    workers: int
    worker_memory: float
    report: Path | None = None


def parse_place(text: str, worker_memory: float) -> ClusterPlace:
    """Return where tasks run, from the command line.

    Units: worker_memory [GB].

    Examples
    --------
    >>> parse_place("local:2", 2.0)
    ClusterPlace(address='', workers=2, worker_memory=2.0, report=None)
    """
    if text == LOCAL:
        return ClusterPlace("", os.cpu_count() or 1, worker_memory)
    kind, _, rest = text.partition(":")
    if kind == LOCAL:
        if not (rest.isdecimal() and 1 <= int(rest) <= 1024):
            raise SettingsError(f"--cluster is '{text}'; give local:N with 1 to 1,024 processes, such as local:2")
        return ClusterPlace("", int(rest), worker_memory)
    scheme, separator, host = text.partition("://")
    if not separator or scheme not in {"tcp", "tls"} or not host.rpartition(":")[2].isdecimal():
        raise SettingsError(
            f"--cluster is '{text}'; give local, local:N, or the address of a scheduler such as tls://host:8786"
        )
    if scheme == "tcp" and host.rpartition(":")[0] not in LOOPBACK:
        raise SettingsError(
            f"--cluster {text} is not encrypted, and whoever reaches a scheduler can run code; start it with TLS and "
            "give tls://..., or reach it through a tunnel that ends on 127.0.0.1"
        )
    return ClusterPlace(text, 0, worker_memory)


class DaskRunner:
    """Run tasks by the client of a Dask cluster.

    Parameters
    ----------
    scratch : Path
        Folder in which tasks note that they have begun.
    on_end : callable, optional
        Function that receives the record of each task when its result is taken.
    """

    def __init__(self, client: Any, scratch: Path, on_end: Callable[[TaskRecord], None] | None = None) -> None:
        self._client, self._scratch, self._on_end = client, scratch, on_end
        self.records: list[TaskRecord] = []
        self.workers = len(client.scheduler_info(n_workers=-1)["workers"])

    def run(self, stage: str, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]) -> Iterator[Any]:
        """Yield the result of each task, in their order."""
        from distributed import CancelledError, KilledWorker, as_completed  # noqa: PLC0415 - an optional package

        pending = {
            self._client.submit(
                _run_on_worker, stage, number, function, arguments, self._scratch, pure=False, priority=-number
            )
            for number, arguments in enumerate(tasks)
        }
        ended: dict[int, Any] = {}
        first = 0
        try:
            # a result that stayed on a worker would be lost with it
            for future in as_completed(list(pending), loop=self._client.loop):  # type: ignore[no-untyped-call]
                record, ended_result = future.result()
                pending.discard(future)
                ended[record.number] = ended_result
                self.records.append(record)
                if self._on_end:
                    self._on_end(record)
                while first in ended:
                    yield ended.pop(first)
                    first += 1
        except KilledWorker as error:
            raise SettingsError(
                f"a task of the stage '{stage}' ended every worker that ran it; if it needs more memory, give each "
                "worker more by --worker-memory"
            ) from error
        except (CancelledError, OSError) as error:
            raise SettingsError(
                f"the scheduler was lost in the stage '{stage}': {error}; run the command again"
            ) from error
        finally:
            self._client.cancel(list(pending))

    def count_repeats(self) -> dict[str, int]:
        """Return how often a task was begun once more, because its worker was lost, by stage."""
        begun = Counter(path.name.split("-")[1] for path in self._scratch.glob("begun-*"))
        ended = Counter(record.stage for record in self.records)
        return {stage: begun[stage] - ended[stage] for stage in begun if begun[stage] > ended[stage]}


def _run_on_worker(
    stage: str, number: int, function: Callable[..., Any], arguments: tuple[Any, ...], scratch: Path
) -> tuple[TaskRecord, Any]:
    """Note that a task begins, and run it."""
    from distributed import get_worker  # noqa: PLC0415 - an optional package

    (scratch / f"begun-{stage}-{number}-{os.getpid()}-{time.time_ns()}").touch()
    return run_task(stage, number, str(get_worker().name), function, arguments)


@contextmanager
def open_runner(
    place: ClusterPlace, scratch: Path, on_end: Callable[[TaskRecord], None] | None = None
) -> Iterator[DaskRunner]:
    """Start or reach workers, and yield a runner of their tasks."""
    try:
        import distributed  # noqa: PLC0415 - an optional package
    except ImportError as error:
        raise SettingsError(f"--cluster needs Dask; install it with {INSTALL}") from error
    for name in ("distributed", "distributed.nanny", "distributed.scheduler", "distributed.worker"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with ExitStack() as ending:
        try:
            client = _connect(distributed, place, scratch, ending)
        except (OSError, TimeoutError, ValueError) as error:
            where = place.address or "workers on this machine"
            reason = " ".join(str(error).split()) or type(error).__name__
            raise SettingsError(f"--cluster: {where} cannot be reached: {reason}; is it running?") from error
        _check_workers(client, scratch)
        yield DaskRunner(client, scratch, on_end)


def check_certificates(files: Mapping[str, str | None], address: str) -> None:
    """Refuse to join a scheduler under TLS without certificates.

    Parameters
    ----------
    files : mapping of str to str
        Authority (`ca_file`), certificate (`cert`) and private key (`key`) of the client, as files or in PEM.
    """
    if missing := [variable for part, variable in CERTIFICATES.items() if not files.get(part)]:
        raise SettingsError(
            f"--cluster {address} needs certificates: export {', '.join(missing)} with the names of PEM files; "
            "the guide on clusters shows it"
        )
    for part, variable in CERTIFICATES.items():
        file = str(files[part])
        if "\n" not in file and not Path(file).is_file():
            raise SettingsError(f"--cluster {address}: {variable} is {file}, which is no file; name an existing one")


def _connect(distributed: Any, place: ClusterPlace, scratch: Path, ending: ExitStack) -> Any:
    """Return a client of a scheduler, which this function starts on this machine if none is named."""
    import dask  # noqa: PLC0415 - an optional package

    ending.enter_context(dask.config.set(_CONFIG))
    if place.address:
        if place.address.startswith("tls://"):
            check_certificates(distributed.Security().get_tls_config_for_role("client"), place.address)
        Console(stderr=True).print(
            f"connecting to {place.address}, for at most {CONNECT_S:.0f} s",
            markup=False,
            highlight=False,
            soft_wrap=True,
        )
        return ending.enter_context(distributed.Client(place.address, timeout=CONNECT_S, set_as_default=False))
    cluster = distributed.LocalCluster(
        n_workers=place.workers,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        protocol="tls://",
        security=distributed.Security.temporary(),
        dashboard_address=None,
        scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # an HTTP server always listens; it has no pages
        worker_dashboard_address=None,
        memory_limit=round(place.worker_memory * _GB),
        local_directory=str(scratch),
        silence_logs=logging.CRITICAL,
    )
    ending.enter_context(cluster)
    return ending.enter_context(distributed.Client(cluster, timeout=CONNECT_S, set_as_default=False))


def _check_workers(client: Any, scratch: Path) -> None:
    """Refuse workers that cannot give the results of this machine."""
    mark = scratch / "mark"
    mark.touch()
    found: dict[str, tuple[dict[str, str], bool]] = client.run(_describe_worker, mark)
    if not found:
        raise SettingsError("--cluster: the scheduler has no workers; start some with `dask worker`")
    own, _ = _describe_worker(mark)
    for worker, (versions, sees) in found.items():
        if versions != own:
            name = next(name for name in own if versions.get(name) != own[name])
            raise SettingsError(
                f"--cluster: worker {worker} has {name} {versions.get(name)}, and this machine has {own[name]}; "
                "install the same versions, or results would differ"
            )
        if not sees:
            raise SettingsError(
                f"--cluster: worker {worker} does not see {scratch}; recordings and --out must be on a file system "
                "that all workers share, under the same path"
            )


def _describe_worker(mark: Path) -> tuple[dict[str, str], bool]:
    """Return the versions of packages in this process, and whether it sees a file."""
    versions = {"socast": "not installed"}
    for name in ("socast", *_PACKAGES):
        with suppress(ModuleNotFoundError):
            versions[name] = version(name)
    return versions, mark.exists()
