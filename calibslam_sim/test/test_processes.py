"""Processes that live and die together."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from calibslam_sim.processes import ProcessFailed, ProcessGroup

PATIENCE = 120.0  # [s] for what takes a second on an idle machine
SLEEP = ["-n", "1", "-r", "1", "import os, time; print(os.getpid(), flush=True); time.sleep(300)"]


def started(log: Path) -> int:
    """Process id that a sleeper has written."""
    end = time.monotonic() + PATIENCE
    while not log.exists() or not log.read_text().strip():
        assert time.monotonic() < end
        time.sleep(0.05)
    return int(log.read_text().split()[0])


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_all_end_with_the_group(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), ProcessGroup(tmp_path, {}) as processes:
        processes.start("a", "timeit", SLEEP)
        processes.start("b", "timeit", SLEEP)
        pids = [started(tmp_path / "a.log"), started(tmp_path / "b.log")]
        assert all(is_alive(pid) for pid in pids)
        raise KeyboardInterrupt
    assert not any(is_alive(pid) for pid in pids)


def test_one_that_dies_is_reported_with_its_log(tmp_path: Path) -> None:
    with ProcessGroup(tmp_path, {}) as processes:
        processes.start("sleeper", "timeit", SLEEP)
        processes.start("victim", "json.tool", [str(tmp_path / "nowhere.json")])
        with pytest.raises(ProcessFailed, match=r"victim ended with [12](.|\n)*nowhere\.json"):
            processes.wait("sleeper", PATIENCE)


def test_one_that_ends_well_is_done_with(tmp_path: Path) -> None:
    with ProcessGroup(tmp_path, {"WORD": "hello"}) as processes:
        processes.start("sleeper", "timeit", SLEEP)
        processes.start("quick", "timeit", ["-n", "1", "-r", "1", "import os; print(os.environ['WORD'])"])
        processes.wait("quick", PATIENCE)
        assert processes.is_running("sleeper")
    assert "hello" in (tmp_path / "quick.log").read_text()


def test_one_that_does_not_end_is_reported(tmp_path: Path) -> None:
    with ProcessGroup(tmp_path, {}) as processes:
        processes.start("sleeper", "timeit", SLEEP)
        with pytest.raises(ProcessFailed, match="sleeper has not ended within 0 s"):
            processes.wait("sleeper", 0.3)
