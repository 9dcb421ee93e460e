"""The files of deploy/: units, scripts, and the service under a real systemd in its own namespaces."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import zipfile
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import pytest

from birdslam.runtime.cli.main import main
from tests.systemd_machine import ROOT, Machine, why_not
from tests.test_pipeline import drive

pytestmark = pytest.mark.processes

__all__ = ["drive"]  # a fixture

DEPLOY = ROOT / "deploy"
UNITS = tuple(f"birdslam{name}.service" for name in ("", "-gate", "-uplink", "-router", "-ros"))
EXPOSURE_AT_MOST = 2.0
SYSTEMD_ANALYZE, SHELLCHECK = shutil.which("systemd-analyze"), shutil.which("shellcheck")
UNIT_TEXT = (DEPLOY / "birdslam.service").read_text()
NODES = ("capture", "perceive", "optimize")


@pytest.mark.skipif(SYSTEMD_ANALYZE is None, reason="systemd-analyze is not installed")
@pytest.mark.parametrize("unit", [*UNITS, "birdslam.service+network.conf"])
def test_the_sandbox_is_tight(unit: str, tmp_path: Path) -> None:
    base, _, drop_in = unit.partition("+")
    text = (DEPLOY / base).read_text()
    if drop_in:
        text = text.replace("[Install]", (DEPLOY / drop_in).read_text() + "\n[Install]")
    (tmp_path / base).write_text(text)
    report = subprocess.run(
        ["systemd-analyze", "security", "--offline=yes", "--no-pager", str(tmp_path / base)],
        capture_output=True,
        text=True,
        check=False,
    )
    level = re.search(r"Overall exposure level for \S+: ([0-9.]+)", report.stdout)
    assert level is not None, report.stderr
    assert float(level[1]) <= EXPOSURE_AT_MOST, report.stdout


@pytest.mark.skipif(SYSTEMD_ANALYZE is None, reason="systemd-analyze is not installed")
@pytest.mark.parametrize("unit", UNITS)
def test_systemd_knows_every_key(unit: str) -> None:
    report = subprocess.run(
        ["systemd-analyze", "verify", "--recursive-errors=no", "--man=no", str(DEPLOY / unit)],
        capture_output=True,
        text=True,
        check=False,
    )
    wrong = [line for line in report.stderr.splitlines() if "/opt/birdslam/" not in line and unit in line]
    assert not wrong, report.stderr


def test_cameras_are_the_only_devices_and_limits_are_set() -> None:
    lines = (DEPLOY / "birdslam.service").read_text().splitlines()
    keys = dict(line.split("=", 1) for line in lines if "=" in line and not line.startswith("#"))
    assert [line for line in lines if line.startswith("DeviceAllow=")] == ["DeviceAllow=char-video4linux rw"]
    assert (keys["DevicePolicy"], keys["Type"], keys["Restart"]) == ("closed", "notify", "on-failure")
    assert {"MemoryMax", "CPUQuota", "TasksMax", "LimitRTPRIO", "WatchdogSec", "StartLimitBurst"} <= keys.keys()
    assert int(keys["LimitRTPRIO"]) > 0
    assert keys["RestrictRealtime"] == "no"


@pytest.mark.skipif(SHELLCHECK is None, reason="shellcheck is not installed")
@pytest.mark.parametrize("script", ["install.sh", "certificates.sh"])
def test_the_scripts_are_clean(script: str) -> None:
    report = subprocess.run(["shellcheck", str(DEPLOY / script)], capture_output=True, text=True, check=False)
    assert report.returncode == 0, report.stdout


def wheel(folder: Path) -> Path:
    """The checkout as a wheel without dependencies: they come from the packages that this Python has."""
    path, info = folder / "birdslam-0.1.0-py3-none-any.whl", "birdslam-0.1.0.dist-info"
    with zipfile.ZipFile(path, "w") as archive:
        for folder_of in ("birdslam", "runtime", "deploy", "configs"):
            name = "birdslam" if folder_of == "birdslam" else f"birdslam/{folder_of}"
            for file in sorted((ROOT / folder_of).rglob("*")):
                if file.suffix in {".py", ".toml", ".onnx", ".css", ".js"} or file.parent == DEPLOY:
                    archive.write(file, Path(name) / file.relative_to(ROOT / folder_of))
        archive.writestr("packages.pth", "/srv/packages\n")
        archive.writestr(f"{info}/METADATA", "Metadata-Version: 2.1\nName: birdslam\nVersion: 0.1.0\n")
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{info}/entry_points.txt", "[console_scripts]\nbirdslam = birdslam.runtime.cli.main:main\n")
        archive.writestr(f"{info}/RECORD", "")
    return path


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory, drive: Path) -> Iterator[Machine]:
    """A machine on which install.sh has run, and the service looks at a recording in a loop."""
    reason = why_not()
    if reason:
        pytest.skip(reason)
    folder = tmp_path_factory.mktemp("machine")
    (folder / "m").mkdir()
    with Machine(folder / "m") as machine:
        machine.copy(drive, "/srv/drive")
        machine.copy(wheel(folder), "/srv/birdslam-0.1.0-py3-none-any.whl")
        yield machine


def install(machine: Machine, *arguments: str, script: str = "/srv/birdslam/deploy/install.sh") -> str:
    package = {"BIRDSLAM_PACKAGE": "/srv/birdslam-0.1.0-py3-none-any.whl", "PIP_NO_INDEX": "1"}
    return machine(script, *arguments, env=package)


def test_the_package_contains_its_installer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "service"
    assert main(["deploy", str(target)]) == 0
    assert str(target / "deploy" / "install.sh") in capsys.readouterr().out
    told = {p.relative_to(target).as_posix(): p.read_bytes() for p in target.rglob("*") if p.is_file()}
    own = {f"deploy/{path.name}": path.read_bytes() for path in DEPLOY.iterdir() if path.is_file()}
    vehicle = (ROOT / "configs" / "vehicle.toml").read_bytes()
    assert told == {**own, "configs/vehicle.toml": vehicle, "package": f"birdslam=={version('birdslam')}\n".encode()}
    assert os.access(target / "deploy" / "install.sh", os.X_OK)
    for named in re.findall(r'"\$source/([\w./]+)"', (DEPLOY / "install.sh").read_text()):
        assert (target / named).exists(), named
    assert main(["deploy", str(target)]) == 2
    assert "exists; name a new folder" in capsys.readouterr().err


LOOP = """
[source]
uri = "kitti:/srv/drive"
loop = true
[recording]
file = "/var/lib/birdslam/recordings"
[fleet]
router = "tls/127.0.0.1:7448"
ca = "fleet/ca.pem"
certificate = "fleet/car.vehicle.pem"
key = "fleet/car.vehicle.key"
"""


def estimates(machine: Machine, count: int = 1) -> list[dict]:
    """What a planner of the service's own user gets."""
    lines = machine(
        *("/opt/birdslam/current/bin/birdslam", "listen", "--runtime-dir", "/run/birdslam", "--json"),
        *("--count", str(count), "--timeout", "30"),
        user="birdslam",
    )
    return [json.loads(line) for line in lines.splitlines()]


def node(machine: Machine, name: str) -> int:
    """The process of a node; 0 where there is none."""
    found = [pid for line, pid in machine.pids("birdslam").items() if f" birdslam.runtime.nodes.runner {name} " in line]
    return found[0] if found else 0


PROBE = """
import ctypes, json, mmap, os, pathlib, socket, time

def refused(attempt):
    try:
        return not attempt()
    except OSError:
        return True

libc = ctypes.CDLL(None, use_errno=True)
print(json.dumps({
    "internet": refused(lambda: socket.socket(socket.AF_INET)),
    "packets": refused(lambda: socket.socket(socket.AF_PACKET)),
    "other devices": refused(lambda: open("/dev/loop-control")) and refused(lambda: open("/dev/kmsg")),
    "system files": refused(lambda: open("/etc/birdslam-probe", "w")) and refused(lambda: open("/usr/probe", "w")),
    "homes": refused(lambda: os.listdir("/root")),
    "shared /tmp": not os.path.exists("/tmp/of-others"),
    "namespaces": refused(lambda: libc.unshare(0x10000000) == 0),
    "mounts": refused(lambda: libc.mount(b"none", b"/mnt", b"tmpfs", 0, None) == 0),
    "writable code": refused(lambda: mmap.mmap(-1, 4096, prot=mmap.PROT_WRITE | mmap.PROT_EXEC)),
    "the clock": refused(lambda: time.clock_settime(time.CLOCK_REALTIME, time.time()) is None),
    "other processes": not os.path.exists("/proc/1"),
    "kernel settings": refused(lambda: open("/proc/sys/kernel/printk", "w")),
    "other users": refused(lambda: os.setuid(0) is None),
}))
for path in ("/run/birdslam", "/var/lib/birdslam", "/var/cache/birdslam", "/dev/shm"):
    pathlib.Path(path, "probe").touch()
    pathlib.Path(path, "probe").unlink()
socket.socketpair(socket.AF_UNIX)
"""


def test_the_sandbox_from_inside(machine: Machine) -> None:
    machine("systemd-sysusers", "/srv/birdslam/deploy/birdslam.sysusers")
    unit = re.sub(r"ExecStart=.*?(?<!\\\\)\n", "ExecStart=/usr/bin/python3 /srv/probe.py\n", UNIT_TEXT, flags=re.DOTALL)
    unit = unit.replace("Type=notify", "Type=oneshot").replace("Restart=on-failure", "Restart=no")
    machine.write("/srv/probe.py", PROBE)
    machine.write("/tmp/of-others", "")
    machine.write("/etc/systemd/system/probe.service", unit)
    machine("systemctl", "daemon-reload")
    machine("sh", "-c", "systemctl start probe || { journalctl -u probe --output=cat --no-pager; exit 1; }")
    said = next(line for line in machine.journal("-u", "probe").splitlines() if line.startswith("{"))
    assert {what for what, refused in json.loads(said).items() if not refused} == set()


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_install_start_fail_and_remove(machine: Machine) -> None:
    """One long story, since each step needs the one before it."""
    # Installed: a user, a virtual environment, a configuration; a second run changes nothing.
    install(machine)
    assert machine("stat", "-c", "%U %a", "/opt/birdslam/current/bin/birdslam") == "root 755"
    assert machine("systemctl", "is-enabled", "birdslam") == "enabled"
    assert "video" in machine("id", "-nG", "birdslam").split()
    machine.write("/etc/birdslam/vehicle.toml", LOOP)
    before = machine("readlink", "/opt/birdslam/current")
    assert "vehicle.toml is kept" in install(machine)
    assert machine("cat", "/etc/birdslam/vehicle.toml") == LOOP.strip()
    assert machine("readlink", "/opt/birdslam/current") != before
    assert len(machine("ls", "/opt/birdslam/releases").split()) == 2

    # Each start reports the error in one line; after several starts systemd gives up.
    machine.write("/etc/birdslam/vehicle.toml", "no_such_key = 1\n")
    machine.write("/etc/systemd/system/birdslam.service.d/limit.conf", "[Unit]\nStartLimitBurst=3\n")
    machine("systemctl", "daemon-reload")
    assert machine("sh", "-c", "systemctl start birdslam 2>/dev/null || echo failed") == "failed"
    assert "birdslam: /etc/birdslam/vehicle.toml: no_such_key: no such key" in machine.journal("-u", "birdslam")
    machine.until(lambda: machine("systemctl", "is-failed", "birdslam", check=False) == "failed", "it is given up")
    machine("rm", "/etc/systemd/system/birdslam.service.d/limit.conf")
    machine("systemctl", "daemon-reload")
    machine("systemctl", "reset-failed", "birdslam")
    machine.write("/etc/birdslam/vehicle.toml", LOOP)

    # systemctl start returns after the supervisor's READY; a planner then gets estimates.
    machine("systemctl", "start", "birdslam")
    assert machine("systemctl", "is-active", "birdslam") == "active"
    assert len(estimates(machine, 3)) == 3
    main = int(machine.show("birdslam", "MainPID"))
    status = machine("cat", f"/proc/{main}/status")
    assert machine("stat", "-c", "%U", f"/proc/{main}") == "birdslam"
    assert re.search(r"^CapEff:\s+0+$", status, re.MULTILINE)
    assert re.search(r"^NoNewPrivs:\s+1$", status, re.MULTILINE)
    assert re.search(r"^Seccomp:\s+2$", status, re.MULTILINE)

    # A node is killed, then another stalls: the supervisor's to mend. systemd sees no restart.
    for name, number in (("optimize", signal.SIGKILL), ("perceive", signal.SIGSTOP)):
        killed = node(machine, name)
        assert killed > 1
        machine("kill", f"-{number}", str(killed))
        machine.until(lambda: node(machine, name) not in (0, killed), f"{name} is back")  # noqa: B023
        assert estimates(machine)
    assert (int(machine.show("birdslam", "MainPID")), machine.show("birdslam", "NRestarts")) == (main, "0")

    # The supervisor stalls: systemd's watchdog ends it and starts it again. Then it is killed outright.
    for restarts, number in enumerate((signal.SIGSTOP, signal.SIGKILL), 1):
        nodes = [node(machine, name) for name in NODES]
        assert 0 not in nodes
        machine("kill", f"-{number}", machine.show("birdslam", "MainPID"))
        machine.until(lambda: machine.show("birdslam", "NRestarts") == str(restarts), "a restart")  # noqa: B023
        machine.until(lambda: machine("systemctl", "is-active", "birdslam", check=False) == "active", "active again")
        assert estimates(machine)
        assert not set(nodes) & {node(machine, name) for name in NODES}
    assert "Watchdog timeout" in machine.journal("-u", "birdslam")

    # Its journal: what a node's end was is a warning of that node.
    warnings = machine.journal("-u", "birdslam", "BIRDSLAM_NODE=optimize", "PRIORITY=4", "SYSLOG_IDENTIFIER=birdslam")
    assert "SIGKILL" in warnings
    assert machine.journal("-u", "birdslam", "BIRDSLAM_EVENT=status", "PRIORITY=6")
    assert "frame" in machine.show("birdslam", "StatusText")

    # The gate: off until there are certificates; then a planner of another user reads through it.
    assert machine("systemctl", "is-active", "birdslam-gate", check=False) == "inactive"
    tls, current = "/etc/birdslam/tls", "/opt/birdslam/current"
    machine(f"{current}/deploy/certificates.sh", tls, "vehicle", "127.0.0.1")
    machine(f"{current}/deploy/certificates.sh", tls, "planner", "planner")
    assert machine("stat", "-c", "%U %G %a", f"{tls}/vehicle.key") == "root birdslam 640"
    machine("systemctl", "enable", "--now", "birdslam-gate")
    machine("sh", "-c", f"install -d -o nobody /srv/p; install -o nobody -m 600 {tls}/ca.pem {tls}/planner.* /srv/p")
    machine("cp", f"{current}/deploy/planner.json5", f"{current}/deploy/listen.py", "/srv/p")
    planner = f"cd /srv/p; timeout 60 {current}/bin/python listen.py planner.json5 | head -n 2"
    heard = machine("sh", "-c", planner, user="nobody").splitlines()
    assert len(heard) == 2
    assert all(line.startswith("frame ") for line in heard)
    for secret in (f"{tls}/vehicle.key", f"{tls}/ca.key", "/run/birdslam/car/lock", "/var/lib/birdslam/drive"):
        assert machine("sh", "-c", f"test -r {secret} || echo refused", user="nobody") == "refused"
    machine("systemctl", "stop", "birdslam-gate")

    # The fleet: its router here too; a listener follows the vehicle.
    fleet, router = "/etc/birdslam/fleet", "/etc/birdslam/router.toml"
    for what in (("router", "127.0.0.1"), ("uplink", "car"), ("planner", "operator")):
        machine(f"{current}/deploy/certificates.sh", fleet, *what)
    machine("sh", "-c", f"chgrp birdslam {fleet}/car.vehicle.key && chmod 640 {fleet}/car.vehicle.key")
    files = [f'{key} = "fleet/router.{end}"\n' for key, end in (("certificate", "pem"), ("key", "key"))]
    lists = 'vehicles = ["car"]\nlisteners = ["operator"]\n'
    machine.write(router, f'[router]\nca = "fleet/ca.pem"\n{"".join(files)}{lists}')
    machine.write("/etc/birdslam/operator.toml", LOOP.replace("car.vehicle", "operator"))
    machine("systemctl", "enable", "--now", "birdslam-router", "birdslam-uplink")
    top = (f"{current}/bin/birdslam", "top", "--once", "--all", "/etc/birdslam/operator.toml")
    machine.until(lambda: "1 vehicles: 1 alive" in machine(*top, check=False), "the vehicle is followed")
    machine("systemctl", "stop", "birdslam-router", "birdslam-uplink")
    assert {machine.show(f"birdslam-{unit}", "Result") for unit in ("router", "uplink")} == {"success"}

    # An upgrade that fails changes nothing; one that succeeds restarts the service, on the configuration that was.
    main = machine.show("birdslam", "MainPID")
    before = machine("readlink", "/opt/birdslam/current")
    machine(
        "/srv/birdslam/deploy/install.sh", check=False, env={"BIRDSLAM_PACKAGE": "/srv/none.whl", "PIP_NO_INDEX": "1"}
    )
    assert machine("readlink", "/opt/birdslam/current") == before
    assert len(machine("ls", "/opt/birdslam/releases").split()) == 2
    assert machine.show("birdslam", "MainPID") == main
    machine("/opt/birdslam/current/bin/birdslam", "deploy", "/srv/of-wheel")  # this one without a checkout
    install(machine, script="/srv/of-wheel/deploy/install.sh")
    assert machine("readlink", "/opt/birdslam/current") != before
    assert machine.show("birdslam", "MainPID") != main
    assert estimates(machine)

    # Stopped: in order, with its results written and nothing left behind.
    machine("systemctl", "stop", "birdslam")
    assert machine.show("birdslam", "Result") == "success"
    summary = json.loads(machine("cat", "/var/lib/birdslam/drive/summary.json"))
    assert summary["ended"] == "SIGTERM"
    assert machine("find", "/var/cache/birdslam", "-name", "onnxruntime.db") == ""  # its telemetry
    assert summary["frames_processed"] > 0

    # Each start has its recording, also those that were killed; the last one is whole, and replays.
    recordings = machine("find", "/var/lib/birdslam/recordings", "-name", "car-*.mcap").split()
    assert len(recordings) == len(set(recordings)) >= 4
    assert summary["recording"]["complete"]
    assert summary["recording"]["files"] == [max(recordings)]
    for recording in recordings:
        machine("/opt/birdslam/current/bin/birdslam", "replay", recording, user="birdslam")
    assert machine("ls", "-A", "/run/birdslam", "/dev/shm", check=False).split() in ([], ["/dev/shm:"])

    # Removed: the configuration stays, until it is purged.
    install(machine, "uninstall")
    assert machine("ls", "/opt/birdslam", check=False) == ""
    assert machine("cat", "/etc/birdslam/vehicle.toml") == LOOP.strip()
    install(machine, "uninstall", "--purge")
    assert machine("sh", "-c", "ls -d /etc/birdslam /var/lib/birdslam; id birdslam", check=False) == ""
    install(machine, "uninstall", "--purge")


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_node_of_ros_2_starts_and_lives_without_its_router(machine: Machine) -> None:
    install(machine)
    machine.write("/etc/birdslam/vehicle.toml", LOOP)
    machine("systemctl", "restart", "birdslam")
    machine("systemctl", "start", "birdslam-ros")
    assert machine("systemctl", "is-active", "birdslam-ros") == "active"
    machine.until(lambda: "router" in machine.journal("-u", "birdslam-ros"), "it says that it has no router")
    main = machine.show("birdslam-ros", "MainPID")
    assert estimates(machine)
    assert (machine.show("birdslam-ros", "MainPID"), machine.show("birdslam-ros", "NRestarts")) == (main, "0")
    assert machine("stat", "-c", "%U", f"/proc/{main}") == "birdslam"
    machine("systemctl", "stop", "birdslam-ros")
    assert machine.show("birdslam-ros", "Result") == "success"
    machine("systemctl", "stop", "birdslam")
