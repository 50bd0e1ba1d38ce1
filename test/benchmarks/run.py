"""The back end against its targets: one table, and the same as JSON.

    ./calibslam shell -c 'python test/benchmarks/run.py [--data DIR] [--out FILE.json] [--quick] [--only PART ...]'

Real recordings are folders in TUM format (fr3_office, fr1_desk) in the data folder; those that are missing are left
out, which the table says. Everything runs in one process, one thread. Times depend on the machine and on what else it
does: load is noted in the JSON. --quick shows that it runs, and proves nothing.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import recorded_runs
import simulated_rows
from benchmark_table import AnyRow, Row, as_json, as_text
from threadpoolctl import threadpool_limits

from calibslam_sim.tum_folder import TumError

PROJECT = Path(__file__).resolve().parents[2]
DATA = PROJECT.parent / "shared" / "data" / "tum"


def parts(data: Path, scratch: Path, quick: bool) -> dict[str, Callable[[], list[AnyRow]]]:
    """What is measured, by name. What is timed comes first, in a fresh process."""
    office, desk = data / recorded_runs.OFFICE, data / recorded_runs.DESK
    repetitions, keyframes, seeds, outlier_seeds = (1, 100, 4, 3) if quick else (3, simulated_rows.LONG, 50, 30)
    duration, outlier_duration = (10.0, 10.0) if quick else (20.0, 60.0)
    return {
        "fr3_office": lambda: recorded_runs.office_rows(office, scratch, repetitions),
        "solver": lambda: recorded_runs.solver_rows(office, scratch),
        "long": lambda: simulated_rows.long_run_rows(keyframes),
        "fr1_desk": lambda: recorded_runs.desk_rows(desk, scratch),
        "honesty": lambda: simulated_rows.honesty_rows(seeds, duration),
        **{
            f"outliers_{association}": lambda a=association: simulated_rows.outlier_rows(
                outlier_seeds, outlier_duration, a
            )
            for association in simulated_rows.ASSOCIATIONS
        },
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, metavar="DIR", help="folder of recordings in TUM format")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the table as JSON")
    parser.add_argument("--quick", action="store_true", help="few seeds, short runs: whether it runs")
    parser.add_argument("--only", nargs="+", choices=list(parts(DATA, DATA, True)), metavar="PART", help="%(choices)s")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.ERROR)
    rows: list[AnyRow] = []
    seconds: dict[str, float] = {}
    load = os.getloadavg()[0]
    with threadpool_limits(1), tempfile.TemporaryDirectory() as scratch:
        for name, measure in parts(arguments.data, Path(scratch), arguments.quick).items():
            if arguments.only and name not in arguments.only:
                continue
            print(f"{name} ...", file=sys.stderr, flush=True)
            began = time.monotonic()
            try:
                rows += measure()
            except TumError as error:
                rows.append(Row(name, None, note=f"left out: {error}"))
            seconds[name] = round(time.monotonic() - began, 1)
            if arguments.out:
                arguments.out.write_text(json.dumps(report(rows, seconds, load, arguments.quick), indent=1) + "\n")
    print(as_text(rows))
    return 0


def report(rows: list[AnyRow], seconds: dict[str, float], load: float, quick: bool) -> dict[str, object]:
    """The table with what one needs to know to compare it with another."""
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=PROJECT, capture_output=True, text=True, check=False
    )
    return {
        "rows": as_json(rows),
        "quick": quick,
        "seconds": seconds,
        "commit": commit.stdout.strip(),
        "python": platform.python_version(),
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "load_at_start": load,
    }


if __name__ == "__main__":
    sys.exit(main())
