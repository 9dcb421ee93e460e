"""Which wheels there are of what the package needs: `make wheels` writes docs/wheels.csv. It needs a package index.

pip resolves everything at once, with the extras that users install, for each architecture and Python, as if it ran
there, and takes wheels alone: what has none ends the command with pip's words.
`tests/test_installs.py` holds the table to pyproject.toml.
"""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "docs" / "wheels.csv"
EXTRAS = ("view", "models", "ray", "ros")  # `dev` is for developers, `train` is torch
ARCHITECTURES, PYTHONS = ("x86_64", "aarch64"), ("3.11", "3.12", "3.13")
GLIBC = 28  # 2.28, of 2018: wheels for it or an older one
COMBINATIONS = [f"{architecture} {python}" for architecture in ARCHITECTURES for python in PYTHONS]
LIMIT_S = 600.0


def normalised(name: str) -> str:
    """A package's name as indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def requirements() -> dict[str, list[str]]:
    """Requirement -> which parts of the package ask for it: "" for all, else an extra."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    asked: dict[str, list[str]] = {requirement: [""] for requirement in project["dependencies"]}
    for extra in (*EXTRAS, "train"):
        for requirement in project["optional-dependencies"][extra]:
            asked.setdefault(requirement, []).append(extra)
    return asked


def glibc(tag: str) -> str:
    """The oldest glibc that a wheel's platform tag allows, "2.17"; "any" for one without machine code."""
    named = tag.replace("manylinux2014", "manylinux_2_17").replace("manylinux2010", "manylinux_2_12")
    minors = [int(minor) for minor in re.findall(r"manylinux_2_(\d+)", named)]
    return f"2.{min(minors)}" if minors else tag


def resolve(architecture: str, python: str, wanted: list[str], *options: str) -> list[dict[str, Any]]:
    """What pip would install there, with metadata. Raises SystemExit with what pip says."""
    platforms = [f"manylinux_2_{minor}_{architecture}" for minor in range(GLIBC, 16, -1)]
    platforms.append(f"manylinux2014_{architecture}")
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.json")
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--dry-run"]
        command += ["--ignore-installed", "--target", folder, "--only-binary=:all:", "--implementation", "cp"]
        command += ["--python-version", python, "--report", str(report)]
        command += [part for platform in platforms for part in ("--platform", platform)]
        done = subprocess.run(
            [*command, *options, *wanted], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=LIMIT_S
        )
        if done.returncode:
            raise SystemExit(f"{architecture} {python}: {done.stdout}")
        found: list[dict[str, Any]] = json.loads(report.read_text())["install"]
    return found


def table() -> list[dict[str, str]]:
    """A row a package: its version and the glibc that its wheel needs; "" where nothing asks for it."""
    asked = requirements()
    needed = {normalised(re.split(r"[<>=!~ ]", one)[0]): " ".join(who).strip() for one, who in asked.items()}
    common = [one for one, who in asked.items() if who != ["train"]]
    rows: dict[str, dict[str, str]] = {}
    for combination in COMBINATIONS:
        print(combination, file=sys.stderr)
        architecture, python = combination.split()
        training = [one for one, who in asked.items() if who == ["train"]]  # torch alone: a gigabyte of its own needs
        found = resolve(architecture, python, common) + resolve(architecture, python, training, "--no-deps")
        for item in found:
            name = normalised(item["metadata"]["name"])
            tag = item["download_info"]["url"].removesuffix(".whl").rpartition("-")[2]
            first = {"package": name, "asked by": needed.get(name, "-"), **dict.fromkeys(COMBINATIONS, "")}
            row = rows.setdefault(name, first)
            row[combination] = f"{item['metadata']['version']} {glibc(tag)}"
    return sorted(rows.values(), key=lambda row: (row["asked by"] == "-", row["package"]))


def main() -> None:
    rows = table()
    with TABLE.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, ["package", "asked by", *COMBINATIONS], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    print(f"{len(rows)} packages in {TABLE.relative_to(ROOT)}, each with its wheels")


if __name__ == "__main__":
    main()
