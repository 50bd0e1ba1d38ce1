"""How programs read their command line, and how they end: also where nobody reads their output or a disk is full."""

from __future__ import annotations

import argparse
import errno
import functools
import os
import signal
import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn, ParamSpec

Arguments = ParamSpec("Arguments")

INTERRUPTED = 128 + signal.SIGINT  # exit code

# What to do about errors of the file system.
MAKE_ROOM = "make room, or choose another path"
ADVICE = {
    errno.ENOSPC: MAKE_ROOM,
    errno.EDQUOT: MAKE_ROOM,
    errno.EFBIG: MAKE_ROOM,
    errno.EACCES: "choose another path, or permit it",
    errno.EPERM: "choose another path, or permit it",
    errno.EROFS: "choose another path",
    errno.ENOTDIR: "choose another path",
    errno.EISDIR: "choose another path",
    errno.EEXIST: "choose another path",
    errno.ENAMETOOLONG: "choose another path",
    errno.ENOENT: "is the path right?",
}


class ArgumentParser(argparse.ArgumentParser):
    """argparse's, without abbreviations: `--qui` would do half of what `--quick` does, which is looked for by name."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        """Ends with exit code 2 and one line: the usage of a command with forty options would push it out of sight."""
        self.exit(2, f"{self.prog}: error: {message} (--help tells all options)\n")


def command(main: Callable[Arguments, int]) -> Callable[Arguments, int]:
    """A `main` that ends without a word when nobody reads its output any more, as with `| head`, and with one line
    at Ctrl-C and where a file can be neither read nor written.

    Its exit code is then that of a program ended by SIGPIPE, 141, by SIGINT, 130, or 1.
    """

    @functools.wraps(main)
    def run(*arguments: Arguments.args, **options: Arguments.kwargs) -> int:
        try:
            code = main(*arguments, **options)
            sys.stdout.flush()
        except BrokenPipeError:
            # Python writes what is left when it ends, and would complain then.
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, sys.stdout.fileno())
            os.close(nowhere)
            return 128 + signal.SIGPIPE
        except KeyboardInterrupt:
            print(f"{_name(main)}: interrupted", file=sys.stderr)
            return INTERRUPTED
        except OSError as error:
            given = next((words for words in arguments if isinstance(words, Sequence)), sys.argv[1:])
            print(f"{_name(main)}: {_told(error, [str(word) for word in given])}", file=sys.stderr)
            return 1
        return code

    return run


def _name(main: Callable[..., int]) -> str:
    """As a user calls it: that of the module."""
    module = main.__module__.rpartition(".")[2]
    return Path(sys.argv[0]).stem if module == "__main__" else module


def _told(error: OSError, words: Sequence[str]) -> str:
    """Path, reason and next step of an error, given the words of the command line."""
    if error.errno is None:
        return str(error)
    path = error.filename
    if path is None:
        # A failed write does not say of which file; what is written is --out.
        spread = [part for word in words for part in (word.split("=", 1) if word.startswith("--out=") else [word])]
        path = next((value for option, value in pairwise(spread) if option == "--out"), None)
    advice = ADVICE.get(error.errno)
    return "".join([f"{path}: " if path is not None else "", str(error.strerror), f"; {advice}" if advice else ""])
