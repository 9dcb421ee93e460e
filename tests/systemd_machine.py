"""A machine for tests: a real systemd as PID 1 of fresh namespaces, on an overlay of this system's own files.

What is installed, written or killed in it leaves no trace outside. It has no network but its own loopback, none of the
host's units run, and its journal lies in memory.
"""

from __future__ import annotations

import os
import select
import shutil
import subprocess
import sysconfig
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

ROOT = Path(__file__).resolve().parent.parent
SYSTEMD = Path("/lib/systemd/systemd")
LIMIT_S = 240.0
PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"

_BOOT = r"""
set -e
place=$1 cgroup=$2 packages=$3 checkout=$4
echo 0 > "$cgroup/cgroup.procs" # now, so that the namespace below begins here
exec unshare --mount --pid --fork --kill-child --cgroup --uts --ipc --net --propagation private sh -c '
set -e
place=$1 packages=$2 checkout=$3
mount -t tmpfs tmpfs "$place"
mkdir "$place/upper" "$place/work" "$place/root"
root=$place/root
mount -t overlay overlay -o "lowerdir=/,upperdir=$place/upper,workdir=$place/work" "$root"
mount -t proc proc "$root/proc"
mount --bind "$root/proc/sys" "$root/proc/sys"
mount -o remount,bind,ro "$root/proc/sys"
mount --rbind /dev "$root/dev"
mount --make-rprivate "$root/dev"
mount -t tmpfs tmpfs "$root/dev/shm"
mount -t sysfs sysfs "$root/sys"
mount -t cgroup2 cgroup2 "$root/sys/fs/cgroup"
for dir in run tmp var/log var/tmp; do mount -t tmpfs tmpfs "$root/$dir"; done
chmod 1777 "$root/tmp" "$root/var/tmp" "$root/dev/shm"
mkdir -p "$root/srv/packages" "$root/srv/birdslam"
mount --bind "$packages" "$root/srv/packages"
mount --bind "$checkout" "$root/srv/birdslam"
for dir in srv/packages srv/birdslam; do mount -o remount,bind,ro "$root/$dir"; done
rm -rf "$root"/lib/systemd/system/*.wants "$root"/etc/systemd/system/* "$root"/lib/systemd/system-generators/*
rm -rf "$root/opt/birdslam" "$root/etc/birdslam" "$root/var/lib/birdslam"
mkdir -p "$root/lib/systemd/system/sockets.target.wants" "$root/etc/systemd/journald.conf.d"
printf "[Journal]\nStorage=volatile\nReadKMsg=no\nForwardToSyslog=no\n" > "$root/etc/systemd/journald.conf.d/test.conf"
cd "$root/etc/systemd/system"
printf "[Unit]\nWants=systemd-journald.service\nAfter=systemd-journald.service\n" > test.target
echo 0123456789abcdef0123456789abcdef > "$root/etc/machine-id"
mkdir -p "$root/.old"
cd "$root"
pivot_root . .old
umount -l /.old
ip link set lo up 2>/dev/null || true
exec env -i PATH="$PATH" container=test /lib/systemd/systemd --system --unit=test.target --log-target=journal
' boot "$place" "$packages" "$checkout"
"""


def why_not() -> str:
    """Returns why this computer can't run such a machine; empty if it can."""
    if os.geteuid() != 0:
        return "a systemd of its own needs root"
    if not SYSTEMD.exists():
        return "systemd is not installed"
    for tool in ("unshare", "nsenter", "pivot_root", "setpriv", "runuser", "openssl"):
        if shutil.which(tool, path=PATH) is None:
            return f"{tool} is not installed"
    if "overlay" not in Path("/proc/filesystems").read_text():
        return "the kernel has no overlay file system"
    if _cgroup2() is None:
        return "there is no cgroup2 file system"
    python = Path("/usr/bin/python3")
    if not python.exists():
        return "there is no /usr/bin/python3"
    version = "import sys, ensurepip; print(sys.version_info[:2])"
    found = subprocess.run([str(python), "-c", version], capture_output=True, text=True, check=False).stdout.strip()
    if found != str(tuple(map(int, sysconfig.get_python_version().split(".")))):
        return f"/usr/bin/python3, with venv, must be of this Python's version to share its packages; it is {found}"
    tried = subprocess.run(
        ["unshare", "--mount", "--pid", "--fork", "--cgroup", "--uts", "--ipc", "--net", "true"],
        capture_output=True,
        text=True,
        check=False,
    )
    return f"no namespaces: {tried.stderr.strip()}" if tried.returncode else ""


def _cgroup2() -> Path | None:
    for line in Path("/proc/mounts").read_text().splitlines():
        _, place, kind, options, *_ = line.split()
        if kind == "cgroup2" and "rw" in options.split(","):
            return Path(place)
    return None


class Machine:
    """A context manager, booted when entered. `/srv/birdslam` is the checkout, `/srv/packages` has this Python's."""

    def __init__(self, place: Path) -> None:
        self._place = place
        cgroup2 = _cgroup2()
        self._cgroup = cgroup2 / f"birdslam-test-{os.getpid()}"
        self._process: subprocess.Popen[bytes] | None = None
        self._pid1 = 0

    def __enter__(self) -> Self:
        self._cgroup.mkdir()
        packages = sysconfig.get_path("purelib")
        self._log = (self._place.parent / f"{self._place.name}.log").open("wb")
        self._process = subprocess.Popen(
            [
                "setpriv",
                "--pdeathsig",
                "KILL",
                "sh",
                "-c",
                _BOOT,
                "boot",
                str(self._place),
                str(self._cgroup),
                packages,
                str(ROOT),
            ],
            env={"PATH": PATH},
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            self.until(self._booted, "systemd is up")
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def _booted(self) -> bool:
        if self._process.poll() is not None:
            raise AssertionError(f"the machine did not boot: {Path(self._log.name).read_text()}")
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text().split()
        if not children:
            return False
        self._pid1 = int(children[0])
        if os.readlink(f"/proc/{self._pid1}/exe") != os.path.realpath(SYSTEMD):
            return False
        return self("systemctl", "is-active", "test.target", check=False) == "active"

    def __call__(self, *command: str, check: bool = True, user: str = "", env: Mapping[str, str] | None = None) -> str:
        """Runs a command in the machine; gives its standard output. Without `check` its failure is no error."""
        as_user = ("runuser", "-u", user, "--") if user else ()
        done = subprocess.run(
            ["nsenter", "-t", str(self._pid1), "-a", *as_user, *command],
            env={"PATH": PATH, **(env or {})},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
            check=False,
            start_new_session=True,  # no signal of it reaches the tests' own process group
        )
        assert not check or done.returncode == 0, f"{command}: {done.returncode}\n{done.stdout}\n{done.stderr}"
        return done.stdout.strip()

    def write(self, path: str, text: str) -> None:
        """A file in the machine."""
        self("sh", "-c", 'mkdir -p "$(dirname "$1")"; printf %s "$2" > "$1"', "write", path, text)

    def copy(self, source: Path, target: str) -> None:
        """Copies a file or a folder of the host into the machine."""
        packed = subprocess.run(
            ["tar", "-C", str(source.parent), "-c", source.name], capture_output=True, check=True, timeout=LIMIT_S
        ).stdout
        command = f"mkdir -p /srv/.in && tar -C /srv/.in -x && rm -rf {target} && mv /srv/.in/{source.name} {target}"
        subprocess.run(
            ["nsenter", "-t", str(self._pid1), "-a", "sh", "-c", command],
            env={"PATH": PATH},
            input=packed,
            check=True,
            timeout=LIMIT_S,
        )
        self("chmod", "-R", "a+rX", target)

    def show(self, unit: str, key: str) -> str:
        """A property of a unit."""
        return self("systemctl", "show", "--property", key, "--value", unit)

    def pids(self, unit: str) -> dict[str, int]:
        """Process id by command line, in the machine's own numbers."""
        group = self.show(unit, "ControlGroup")
        text = self(
            "sh",
            "-c",
            'for p in $(cat "/sys/fs/cgroup$1/cgroup.procs"); do echo "$p $(tr "\\0" " " < "/proc/$p/cmdline")"; done',
            "pids",
            group,
            check=False,
        )
        return {line.split(" ", 1)[1]: int(line.split(" ", 1)[0]) for line in text.splitlines() if " " in line}

    def journal(self, *arguments: str) -> str:
        """Returns the output of journalctl."""
        return self("journalctl", "--no-pager", "--output=cat", *arguments)

    def until(self, condition: object, what: str, limit_s: float = LIMIT_S) -> None:
        """Waits until `condition()` holds, or fails saying `what` did not."""
        end_s = time.monotonic() + limit_s
        assert callable(condition)
        while not condition():
            assert time.monotonic() < end_s, f"never: {what}"
            select.select([], [], [], 0.05)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process is not None:
            self._process.kill()  # --kill-child: PID 1 goes with it, and all of its namespace
            self._process.wait()
            self._log.close()
        self.until(self._empty, "the machine's processes are gone")
        for group in sorted(self._cgroup.rglob("*"), reverse=True):
            if group.is_dir():
                group.rmdir()
        self._cgroup.rmdir()

    def _empty(self) -> bool:
        return "populated 0" in (self._cgroup / "cgroup.events").read_text()
