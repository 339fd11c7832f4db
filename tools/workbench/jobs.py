"""Background work of the workbench: one job at a time in a thread, with progress, cancellation and a result."""

import logging
import secrets
from collections.abc import Callable
from threading import Lock, Thread
from typing import Any, Final

from socast.core.errors import SocastError

MOST_KEPT: Final = 16
"""Number of jobs whose results are kept; the oldest is forgotten when another begins."""
_log = logging.getLogger("socast.workbench")


class CancelledError(SocastError):
    """Report that a person cancelled a job."""


class Report:
    """Receive the progress of a job, and end the job if it was cancelled."""

    def __init__(self, job: "Job") -> None:
        self._job = job

    def __call__(self, share: float | None = None, words: str = "") -> None:
        """Set the progress; call this function often.

        Parameters
        ----------
        share : float, optional
            Part of the work that is done, None where unknown. [1]
        """
        if self._job.is_cancelled:
            raise CancelledError("cancelled")
        self._job.share, self._job.words = share, words


Work = Callable[[Report], Any]
"""A function that does the work of a job and returns its result as a JSON record."""


class Job:
    """Hold the progress and the result of a job.

    Parameters
    ----------
    name : str
        What the job does, for a person.
    """

    def __init__(self, name: str) -> None:
        self.name, self.number = name, secrets.token_hex(8)
        self.status, self.words, self.error = "running", "", ""
        self.share: float | None = None
        self.result: Any = None
        self.is_cancelled = False

    def describe(self) -> dict[str, Any]:
        """Return the job as a JSON record; the result is present once the job is done."""
        record = {
            "job": self.number,
            "name": self.name,
            "status": self.status,
            "share": self.share,
            "words": self.words,
        }
        if self.status == "done":
            record["result"] = self.result
        if self.error:
            record["error"] = self.error
        return record


class Jobs:
    """Run one job at a time."""

    def __init__(self) -> None:
        self._jobs: dict[str, Job] = {}
        self._lock = Lock()

    def start(self, name: str, work: Work) -> dict[str, Any]:
        """Start a job, and return its record."""
        with self._lock:
            if busy := next((job for job in self._jobs.values() if job.status == "running"), None):
                raise SocastError(f"another job runs: {busy.name}; wait until it ends, or cancel it")
            job = Job(name)
            self._jobs[job.number] = job
            while len(self._jobs) > MOST_KEPT:
                del self._jobs[next(iter(self._jobs))]
        Thread(target=_run, args=(job, work), name="job", daemon=True).start()
        return job.describe()

    def describe(self, number: str) -> dict[str, Any]:
        """Return the record of a job."""
        return self._find(number).describe()

    def find_running(self) -> dict[str, Any] | None:
        """Return the record of the job that runs, None where none does."""
        return next((job.describe() for job in list(self._jobs.values()) if job.status == "running"), None)

    def cancel(self, number: str) -> dict[str, Any]:
        """Cancel a job at its next report of progress, and return its record."""
        job = self._find(number)
        job.is_cancelled = True
        return job.describe()

    def end(self) -> None:
        """Cancel what runs."""
        for job in self._jobs.values():
            job.is_cancelled = True

    def _find(self, number: str) -> Job:
        """Return a job by its identity."""
        if (job := self._jobs.get(number)) is None:
            raise SocastError(f"no job has the identity {number[:40]!r}: start the work again")
        return job


def _run(job: Job, work: Work) -> None:
    """Do the work of a job, and keep its result or its error."""
    try:
        job.result = work(Report(job))
        job.status = "done"
    except CancelledError:
        job.status = "cancelled"
    except SocastError as error:
        job.error, job.status = " ".join(str(error).split()), "failed"
    except Exception:  # noqa: BLE001 - a defect must not leave a job that never ends
        _log.exception("job %s failed", job.name)
        job.error, job.status = f"{job.name} failed by a defect; see the log of `socast serve`", "failed"
