"""`birdslam completion SHELL`: prints the shell code that completes commands, options and files (argcomplete)."""

from __future__ import annotations

import argparse

from birdslam.runtime.configuration import ConfigurationError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the argument `shell`."""
    parser.add_argument(
        "shell", choices=("bash", "zsh", "fish"), help='in its start file: eval "$(birdslam completion bash)"'
    )


def run(options: argparse.Namespace) -> int:
    """Prints the completion code."""
    try:
        from argcomplete.shell_integration import shellcode
    except ImportError:
        raise ConfigurationError("completion needs argcomplete: pip install birdslam[completion]") from None
    print(shellcode(["birdslam"], True, options.shell))
    return 0
