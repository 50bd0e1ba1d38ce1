"""How commands end: without a word where nobody reads their output, with one line where a file is in the way."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Sequence

import pytest

from calibslam_msgs_py.command import ArgumentParser, command

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


@pytest.mark.parametrize(
    ("error", "words", "told"),
    [
        (OSError(errno.EACCES, "Permission denied", "a/b"), ["--out", "c"], "a/b: Permission denied; choose another"),
        (OSError(errno.ENOSPC, "No space left on device"), ["--out", "c"], "c: No space left on device; make room"),
        (OSError(errno.ENOSPC, "No space left on device"), ["x", "--out=c"], "c: No space left on device; make room"),
        (OSError(errno.EIO, "Input/output error"), ["x"], "Input/output error"),
        (OSError("nobody answers"), [], "nobody answers"),
    ],
)
def test_a_file_in_the_way_is_said(
    error: OSError, words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    @command
    def main(argv: Sequence[str] | None = None) -> int:
        raise error

    assert main(words) == 1
    assert capsys.readouterr().err.startswith(f"test_command: {told}")


def test_a_wrong_option_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    parser = ArgumentParser(prog="work")
    for n in range(40):
        parser.add_argument(f"--option-{n}")
    with pytest.raises(SystemExit) as ended:
        parser.parse_args(["--optoin-3", "x"])
    assert ended.value.code == 2
    assert capsys.readouterr().err == "work: error: unrecognized arguments: --optoin-3 x (--help tells all options)\n"


def test_an_interrupted_command_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    @command
    def main() -> int:
        raise KeyboardInterrupt

    assert main() == 130
    assert capsys.readouterr().err == "test_command: interrupted\n"


def test_a_program_tells_its_name_and_its_own_arguments(tmp_path: os.PathLike[str]) -> None:
    program = os.path.join(tmp_path, "render.py")
    with open(program, "w") as file:
        file.write(PROGRAM.format(lines=3).replace("print(n)", "raise OSError(28, 'No space left on device')"))
    done = subprocess.run([sys.executable, program, "--out", "x"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (
        1,
        "render: x: No space left on device; make room, or choose another path\n",
    )


def test_options_are_not_abbreviated(capsys: pytest.CaptureFixture[str]) -> None:
    parser = ArgumentParser(prog="experiment")
    parser.add_argument("--quick", action="store_true")
    assert parser.parse_args(["--quick"]).quick
    with pytest.raises(SystemExit):
        parser.parse_args(["--qui"])
    assert "unrecognized arguments: --qui" in capsys.readouterr().err
