"""Installation: Python versions of the package, the Containerfile, the browser of the tests."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

from birdslam.runtime.cli.commands import parse
from tests import containerfile

ROOT = Path(__file__).resolve().parent.parent
PYTHONS = ("3.11", "3.12", "3.13")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_package_states_its_python_versions() -> None:
    told = re.findall(r"Python :: (3\.\d+)", " ".join(PROJECT["classifiers"]))
    assert tuple(told) == PYTHONS
    assert PROJECT["requires-python"] == f">={PYTHONS[0]}"


def test_containerfile_is_valid() -> None:
    steps = containerfile.instructions()
    names = [step.name for step in steps]
    assert set(names) <= set(containerfile.KNOWN)
    assert names[0] == "FROM"
    stages = [step.words[2] for step in steps if step.name == "FROM" and len(step.words) == 3]
    for step in steps:
        if step.name == "FROM":
            assert re.fullmatch(r"python:3\.11-slim", step.words[0])  # a short name: no registry's host
        if step.name == "COPY":
            flags, (*sources, _) = [
                [w for w in step.words if w.startswith("--") == is_flag] for is_flag in (True, False)
            ]
            assert all(flag.removeprefix("--from=") in stages for flag in flags)
            assert flags or all((ROOT / source).exists() for source in sources)
    last = {step.name: step for step in steps}
    assert "useradd" in " ".join(step.text for step in steps if step.name == "RUN")
    assert last["USER"].words == ["birdslam"]
    smoke = [step for step in steps if step.name == "RUN" and "--source demo" in step.text]
    assert len(smoke) == 1
    assert steps.index(last["USER"]) < steps.index(smoke[0])  # not as root
    commands = [shlex.split(smoke[0].text.partition("&&")[0]), last["ENTRYPOINT"].words + last["CMD"].words]
    commands.append(containerfile.Instruction("CMD", last["HEALTHCHECK"].text.partition("CMD ")[2]).words)
    assert [parse(words[1:]).command for words in commands] == ["run", "run", "top"]
    assert {words[0] for words in commands} == {"birdslam"}


@pytest.mark.parametrize(
    ("user", "apt_status", "says"),
    [
        (1000, 0, "no Chromium: tests of pages in a browser skip"),
        (0, 0, ""),
        (0, 100, "no Chromium: tests of pages in a browser skip"),  # as where there is no network
    ],
)
def test_only_root_installs_a_browser(tmp_path: Path, user: int, apt_status: int, says: str) -> None:
    """On a machine without one; whatever comes of it, the tests run."""
    make, shell = shutil.which("make"), shutil.which("sh")
    assert make is not None
    assert shell is not None
    asked = tmp_path / "asked"
    for name, line in (("id", f"echo {user}"), ("apt-get", f'echo "$*" >> {asked}; exit {apt_status}')):
        (tmp_path / name).write_text(f"#!{shell}\n{line}\n")
        (tmp_path / name).chmod(0o755)
    done = subprocess.run(
        [make, "-C", ROOT, "--silent", "browser", f"SHELL={shell}"],
        env={"PATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(says)
    assert bool(done.stdout) == bool(says)
    assert asked.exists() == (user == 0)
    if user == apt_status == 0:
        assert asked.read_text().splitlines()[-1].endswith("chromium")


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.timeout(1200)
def test_the_containerfile_can_be_carried_out(tmp_path: Path) -> None:
    reason = containerfile.why_not()
    if reason:
        pytest.skip(reason)
    said = containerfile.carry_out(
        tmp_path, "id -un; command -v birdslam; birdslam --version; ls -A /data /run/birdslam"
    )
    assert "ended" not in said or "end of source" in said
    assert f"birdslam\n/opt/birdslam/bin/birdslam\nbirdslam {PROJECT['version']}\n" in said
    assert not Path("/opt/birdslam/bin").exists() or "/opt/birdslam" not in str(tmp_path)
