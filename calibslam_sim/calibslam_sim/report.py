"""`report RUN...`: runs on one HTML page, with figures to turn and zoom; it needs no network and no other file.

Truth, odometry, boxes and images come from the recording that each run names in its metrics.json.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from calibslam_msgs_py.command import ArgumentParser, command
from calibslam_sim.run_report.loading import ReportError, load_runs
from calibslam_sim.run_report.page import missing, page

MEGABYTE = 1e6


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Command line of `report`; returns the exit code."""
    parser = ArgumentParser(prog="report", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="folders that slam_bag wrote")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="page to write (default: report.html in the first RUN)"
    )
    parser.add_argument("--recording", type=Path, metavar="BAG", help="of all runs (default: what each run names)")
    parser.add_argument("--calibrator", metavar="FILE", help="for boxes without covariance (default: as in each run)")
    arguments = parser.parse_args(argv)
    out = arguments.out or arguments.runs[0] / "report.html"
    try:
        runs = load_runs(arguments.runs, arguments.recording, arguments.calibrator)
        text = page(runs)
        out.write_text(text, encoding="utf-8")
    except ReportError as error:
        print(f"report: {error}", file=sys.stderr)
        return 1
    for run in runs:
        if run.recorded is None:
            print(f"report: warning: {run.name}: {missing(run)}", file=sys.stderr)
    print(f"{out}: {len(arguments.runs)} run{'s' if len(arguments.runs) > 1 else ''}, {len(text) / MEGABYTE:.1f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
