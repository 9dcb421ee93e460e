"""deploy/Containerfile without a builder: its instructions, and what they do on an overlay of this system.

A base image of Python is stood for by this system's own files with its /usr/bin/python3; everything else is as a
builder does it: each stage on its own files, COPY from the checkout or from a stage, RUN in it as its user. What is
installed leaves no trace outside. It needs root, and a package index for pip.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

from tests.systemd_machine import PATH, ROOT

FILE = ROOT / "deploy" / "Containerfile"
LIMIT_S = 900.0
KNOWN = ("FROM", "WORKDIR", "COPY", "RUN", "USER", "ENV", "VOLUME", "HEALTHCHECK", "ENTRYPOINT", "CMD")

_STAGE = r"""
mount -t tmpfs tmpfs "$place/$stage"
mkdir "$place/$stage/upper" "$place/$stage/work" "$place/$stage/root"
root=$place/$stage/root
mount -t overlay overlay -o "lowerdir=/,upperdir=$place/$stage/upper,workdir=$place/$stage/work" "$root"
mount -t proc proc "$root/proc"
mount --rbind /dev "$root/dev"
for dir in dev/shm run tmp home root srv opt; do mount -t tmpfs tmpfs "$root/$dir"; done
chmod 1777 "$root/tmp" "$root/dev/shm"
ln -sf /usr/bin/python3 "$root/usr/local/bin/python"
"""


class Instruction(NamedTuple):
    """One line of it."""

    name: str
    text: str

    @property
    def words(self) -> list[str]:
        return json.loads(self.text) if self.text.startswith("[") else shlex.split(self.text)


def instructions() -> list[Instruction]:
    """Those of the file, in order."""
    text = re.sub(r"\\\n", " ", FILE.read_text(encoding="utf-8"))
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return [Instruction(name, rest.strip()) for name, _, rest in (line.partition(" ") for line in lines)]


def why_not() -> str:
    """Why it can't be carried out here; empty where it can."""
    if os.geteuid() != 0:
        return "namespaces and overlays need root"
    for tool in ("unshare", "chroot", "useradd"):
        if shutil.which(tool, path=PATH) is None:
            return f"{tool} is not installed"
    if "overlay" not in Path("/proc/filesystems").read_text():
        return "the kernel has no overlay file system"
    checked = subprocess.run(["/usr/bin/python3", "-c", "import ensurepip"], capture_output=True, check=False)
    return "/usr/bin/python3 with venv is not installed" if checked.returncode else ""


def carry_out(place: Path, after: str = "true") -> str:
    """Runs all of it, then a command as the image's user; returns the output. Raises AssertionError."""
    script, stages = ["set -e", f"place={shlex.quote(str(place))}"], dict[str, int]()
    stage, workdir, user = -1, "/", "root"
    settings: dict[str, str] = {}

    def in_stage(command: str) -> str:
        passed = {name: value for name, value in os.environ.items() if name.startswith("PIP_")}
        environment = {"PATH": PATH, **passed, **settings}
        words = " ".join(shlex.quote(f"{name}={value}") for name, value in environment.items())
        home = 'HOME=$(getent passwd "$(id -un)" | cut -d: -f6)'
        inner = shlex.quote(f"export {home}; cd {workdir} && {command}")
        return f'chroot --userspec={user}:{user} "$root" env -i {words} sh -c {inner}'

    for instruction in instructions():
        name, words = instruction.name, instruction.words
        if name == "FROM":
            stage, workdir, user, settings = stage + 1, "/", "root", {}
            stages |= {words[2]: stage} if len(words) == 3 else {}
            (place / str(stage)).mkdir(parents=True)
            script.append(f"stage={stage}\n{_STAGE}")
        elif name == "WORKDIR":
            workdir = instruction.text
            script.append(f'mkdir -p "$root{workdir}"')
        elif name == "COPY":
            (*sources, target) = [word for word in words if not word.startswith("--")]
            whence = next((word.removeprefix("--from=") for word in words if word.startswith("--from=")), None)
            base = str(ROOT) if whence is None else f"{place}/{stages[whence]}/root"
            full = os.path.join(workdir, target)
            for source in sources:
                what = os.path.join(base, source.lstrip("/"))
                within = f"{what}/." if os.path.isdir(what) or whence else what
                script.append(f'mkdir -p "$root{full}" && cp -R {shlex.quote(within)} "$root{full}"')
        elif name == "RUN":
            script.append(in_stage(instruction.text))
        elif name == "USER":
            user = instruction.text
        elif name == "ENV":
            settings |= dict(word.partition("=")[::2] for word in words)
    script.append(in_stage(after))
    apart = ("unshare", "--mount", "--propagation", "private", "--pid", "--fork", "--kill-child")
    done = subprocess.run(
        [*apart, "sh", "-c", "\n".join(script)],
        env={"PATH": PATH, **{name: value for name, value in os.environ.items() if name.startswith("PIP_")}},
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=LIMIT_S,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-4000:]
    return done.stdout
