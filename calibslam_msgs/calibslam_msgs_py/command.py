"""How programs end that write to a pipe."""

from __future__ import annotations

import functools
import os
import signal
import sys
from collections.abc import Callable
from typing import ParamSpec

Arguments = ParamSpec("Arguments")


def command(main: Callable[Arguments, int]) -> Callable[Arguments, int]:
    """A `main` that ends without a word when nobody reads its output any more, as with `| head`.

    Its exit code is then that of a program ended by SIGPIPE: 141.
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
        return code

    return run
