"""`python -m perf NAME ...` runs one benchmark, `python -m perf` lists them: modules with a `label` and one `run`."""

from __future__ import annotations

import importlib
import os
import pkgutil
import sys

from birdslam import perf
from birdslam.runtime.environment import ENVIRONMENT, INTERRUPTED_STATUS, USER_ERROR_STATUS


def benchmark_modules() -> dict[str, str]:
    """Module name -> full name of all modules of the suite; benchmarks are those with a `label`."""
    return {
        module.name: f"{perf.__name__}.{folder.name}.{module.name}"
        for folder in pkgutil.iter_modules(perf.__path__)
        if folder.ispkg
        for module in pkgutil.iter_modules([os.path.join(perf.__path__[0], folder.name)])
    }


def main(arguments: list[str]) -> int:
    os.environ.update(ENVIRONMENT)  # before numpy is imported: the same threads and kernels as the nodes
    from birdslam.perf.errors import PerfError  # after the environment is set
    from birdslam.runtime.cli.errors import USER_ERRORS

    names = benchmark_modules()
    wanted = arguments[:1] if arguments and arguments[0] in names else names  # import only the named benchmark
    modules = []
    for name in wanted:
        try:
            modules.append(importlib.import_module(names[name]))
        except ModuleNotFoundError as error:  # the renderer is not part of the wheel
            print(f"perf {name}: needs a checkout with the extra `dev`: {error.name} is missing", file=sys.stderr)
            if arguments:
                return USER_ERROR_STATUS
    benchmarks = {module.__name__.rpartition(".")[2]: module for module in modules if hasattr(module, "label")}
    if arguments and arguments[0] in benchmarks:
        try:
            status: int | None = benchmarks[arguments[0]].run(arguments[1:])
        except (PerfError, *USER_ERRORS) as error:
            print(f"perf {arguments[0]}: {error}", file=sys.stderr)
            return USER_ERROR_STATUS
        except KeyboardInterrupt:
            return INTERRUPTED_STATUS
        return status or 0
    for name, module in benchmarks.items():
        print(f"{name:16} {module.label}")
    if arguments:
        print(f"perf: {arguments[0]!r} is not a benchmark; `python -m perf` lists them", file=sys.stderr)
    return USER_ERROR_STATUS if arguments else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
