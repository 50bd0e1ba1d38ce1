"""A command whose output nobody reads any more ends without a word."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import sys
from calibslam_msgs_py.command import command

@command
def main() -> int:
    for n in range({lines}):
        print(n)
    return 7

sys.exit(main())
"""


@pytest.mark.parametrize("lines", [1, 100_000], ids=["written at the end", "written meanwhile"])
def test_output_that_nobody_reads(lines: int) -> None:
    command = [sys.executable, "-c", PROGRAM.format(lines=lines)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


def test_otherwise_nothing_changes() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM.format(lines=3)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (7, "0\n1\n2\n", "")
