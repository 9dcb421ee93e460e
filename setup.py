"""Maps folders to packages: runtime/ is birdslam.runtime, perf/ is birdslam.perf. All else is in pyproject.toml."""

from pathlib import Path

from setuptools import find_packages, setup

FOLDERS = {
    "birdslam": "birdslam",
    "birdslam.runtime": "runtime",
    "birdslam.perf": "perf",
    "birdslam.deploy": "deploy",  # data of `birdslam deploy`
    "birdslam.configs": "configs",
}
DEVELOPMENT = ("world", "world.*")  # renders and trains: in the checkout, not in the wheel

present = {package: folder for package, folder in FOLDERS.items() if Path(folder).is_dir()}
setup(
    package_dir=present,
    packages=[
        *present,
        *(
            f"{package}.{name}"
            for package, folder in present.items()
            for name in find_packages(folder, exclude=DEVELOPMENT)
        ),
    ],
)
