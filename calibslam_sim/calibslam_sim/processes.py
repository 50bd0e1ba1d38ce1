"""Several processes that live and die together."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType

POLL = 0.1  # [s]
GRACE = 15.0  # [s] to end after SIGINT, and again after SIGTERM
LINES_OF_LOG = 15


class ProcessFailed(Exception):
    """A process ended that should not have, or not well; the text holds the end of its log."""


class ProcessGroup:
    """Python modules as processes, each with a log file; a context manager that ends them all.

    Args:
        logs: folder for the logs.
        environment: variables that the processes see beside those of this one.
    """

    def __init__(self, logs: Path, environment: Mapping[str, str]) -> None:
        self._logs = logs
        self._environment = {**os.environ, **environment, "PYTHONUNBUFFERED": "1"}
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._may_end: set[str] = set()
        logs.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> ProcessGroup:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def start(self, name: str, module: str, arguments: Sequence[str], may_end: bool = False) -> None:
        """Start `python -m module`; its log is called by `name`. One that `may_end` does so with 0 at any time."""
        if may_end:
            self._may_end.add(name)
        with open(self._logs / f"{name}.log", "wb") as log:
            self._running[name] = subprocess.Popen(
                [sys.executable, "-m", module, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=self._environment,
                start_new_session=True,  # Ctrl-C reaches only this process, which ends the others in order
            )

    def is_running(self, name: str) -> bool:
        """Whether a process goes on; one that ended with 0 is done with.

        Raises:
            ProcessFailed: it, or one of the others, ended otherwise than asked for.
        """
        for other, process in self._running.items():
            if process.poll() or (process.returncode == 0 and other not in (name, *self._may_end)):
                raise self._failure(other)
        return self._running[name].returncode is None

    def wait(self, name: str, timeout: float) -> None:
        """Until a process has ended with 0, while the others run.

        Raises:
            ProcessFailed: as `is_running`, and if it does not end within `timeout` [s].
        """
        end = time.monotonic() + timeout
        while self.is_running(name):
            if time.monotonic() > end:
                raise self._failure(name, f"has not ended within {timeout:.0f} s")
            time.sleep(POLL)
        del self._running[name]

    def stop(self, names: Sequence[str] | None = None) -> None:
        """End some or all: SIGINT first, as for every node, SIGTERM and SIGKILL for those that do not end.

        Raises:
            ProcessFailed: named ones did not end with 0. (For all, it is about getting rid of them.)
        """
        ending = {name: self._running.pop(name) for name in list(names or self._running)}
        for order, grace in ((signal.SIGINT, GRACE), (signal.SIGTERM, GRACE), (signal.SIGKILL, GRACE)):
            for process in ending.values():
                if process.poll() is None:
                    process.send_signal(order)
            end = time.monotonic() + grace
            while time.monotonic() < end and any(p.poll() is None for p in ending.values()):
                time.sleep(POLL)
        for name, process in ending.items():
            if names is not None and process.returncode != 0:
                raise self._failure(name, f"ended with {process.returncode}")

    def _failure(self, name: str, what: str = "") -> ProcessFailed:
        process = self._running.get(name)
        if not what and process is not None:
            what = f"ended with {process.returncode}"
        log = self._logs / f"{name}.log"
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()[-LINES_OF_LOG:]
        tail = "\n".join(f"  | {line}" for line in lines) or "  | (nothing)"
        return ProcessFailed(f"{name} {what}; the end of its log ({log}):\n{tail}")
