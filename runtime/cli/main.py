"""The command `birdslam`. A user error is one line on standard error and exit status 2, without a traceback."""

from __future__ import annotations

import os
import sys

from birdslam.runtime.cli.commands import parse
from birdslam.runtime.environment import CLOSED_PIPE_STATUS, ENVIRONMENT, INTERRUPTED_STATUS, USER_ERROR_STATUS


def main(arguments: list[str] | None = None) -> int:
    """Runs a command and returns the exit status."""
    os.environ.update(ENVIRONMENT)  # numpy reads it on import
    options = parse(sys.argv[1:] if arguments is None else arguments)
    from birdslam.runtime.cli.errors import USER_ERRORS

    try:
        return int(options.call(options))
    except USER_ERRORS as error:
        print(f"birdslam: {' '.join(str(error).split())}", file=sys.stderr)
        return USER_ERROR_STATUS
    except KeyboardInterrupt:
        return INTERRUPTED_STATUS
    except BrokenPipeError:  # `| head`; avoids a second error at the last flush
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return CLOSED_PIPE_STATUS


if __name__ == "__main__":
    sys.exit(main())
