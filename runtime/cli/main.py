"""The command `birdslam`. What a user can mend is one line on standard error and exit status 2, never a traceback."""

from __future__ import annotations

import os
import sys

from birdslam.runtime.cli.parser import build_parser
from birdslam.runtime.environment import CLOSED_PIPE_STATUS, ENVIRONMENT, INTERRUPTED_STATUS


def main(arguments: list[str] | None = None) -> int:
    """Entry point; gives the exit status."""
    options = build_parser().parse_args(arguments)
    os.environ.update(ENVIRONMENT)
    try:
        from birdslam.runtime.cli import dispatch  # only now: numpy's libraries read the environment when loaded

        return dispatch.execute(options)
    except KeyboardInterrupt:
        return INTERRUPTED_STATUS
    except BrokenPipeError:  # `| head` has seen enough; Python would complain once more when it flushes
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return CLOSED_PIPE_STATUS


if __name__ == "__main__":
    sys.exit(main())
