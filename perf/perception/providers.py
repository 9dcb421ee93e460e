"""`python -m perf networks --provider`: what computes the networks on this computer, how fast, and how far off.

    python -m perf networks --provider all [--threads 2] [--models DIR]
    python -m perf networks --provider all --onnxruntime onnxruntime-openvino      # and by another package of it

Another package of onnxruntime takes the place of the installed one: it is fetched by pip into a folder of its own, and
a process that finds it first measures there.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from birdslam.bench.figures import markdown
from birdslam.perception.manifest import SHIPPED_MULTITASK, SHIPPED_NETWORKS
from birdslam.perception.network import ModelSpec
from birdslam.perception.session import onnxruntime_version, providers_here
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.figures import Ledger
from birdslam.perf.reporting.machine import describe
from birdslam.perf.reporting.scorecard import RESULTS
from birdslam.runtime.models.providers import TOLERANCE_REL, compared

WITHIN_S = 3.0  # of a network and provider
SEPARATE = ("avx2", "avx512f", "avx512_vnni", "avx_vnni", "amx_int8")  # of a processor, what decides these figures


def measure(
    asked: str, models: Path, others: dict[str, str], threads: int, output: Path | None, package: str, label: str
) -> None:
    """A row a network and provider: the shipped one, and those of the folder `models` (`others`: role -> file).

    `package` is another of onnxruntime, "": none. Raises PerfError.
    """
    here = providers_here()
    wanted = here if asked == "all" else ("cpu", asked)
    flags = [flag for flag in SEPARATE if flag in processor_flags()]
    print(f"{describe()['cpu']} ({', '.join(flags)}); this onnxruntime has {', '.join(here)}; {threads} threads")
    files = {"multitask": SHIPPED_NETWORKS / SHIPPED_MULTITASK}
    files |= {role: models / name for role, name in others.items() if (models / name).is_file()}
    about = {"providers": list(here), "threads": threads, "flags": flags, "card": _card() if "cuda" in here else ""}
    about["onnxruntime"] = onnxruntime_version()
    with Ledger(output, label, **about) as ledger:
        for role, file in files.items():
            spec = ModelSpec(path=str(file), threads=threads)
            found = compared(role, spec, wanted, within_s=WITHIN_S * len(wanted))
            for provider, one in found.items():
                said = one.problem or f"{one.ms:7.2f} ms a run, off by {one.off_rel:.2%} (RMS)"
                row = {"network": file.name, "provider": provider, "ms": one.ms, "off_rel": one.off_rel}
                ledger.add(f"{file.name} {provider}", said, agrees=one.agrees, **row)
        if package:
            _by_another(package, asked, models, threads, ledger)


def _by_another(package: str, asked: str, models: Path, threads: int, ledger: Ledger) -> None:
    """The same by another package of onnxruntime, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        place, rows = Path(folder) / "packages", Path(folder) / "rows.json"
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
        if subprocess.run([*pip, "--target", str(place), package], check=False).returncode:
            raise PerfError(f"{package}: pip does not install it")
        paths = os.pathsep.join((str(place), *filter(None, [os.environ.get("PYTHONPATH")])))
        command = [sys.executable, "-m", "birdslam.perf", "networks", "--provider", asked, "--threads", str(threads)]
        command += ["--models", str(models), "--output", str(rows)]
        if subprocess.run(command, env=os.environ | {"PYTHONPATH": paths}, check=False).returncode:
            raise PerfError(f"{package}: its process failed")
        for row in json.loads(rows.read_text(encoding="utf-8"))["rows"]:
            name = f"{package}: {row.pop('name')}"
            ledger.add(name, f"{row['ms']:7.2f} ms a run", **row | {"package": package})


def _card() -> str:
    """NVIDIA's name of the first graphics card, "" where its driver tells none."""
    asked = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
    try:
        done = subprocess.run(asked, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return done.stdout.partition("\n")[0].strip()


def processor_flags() -> set[str]:
    """As Linux names them."""
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith(("flags", "Features")):
            return set(line.partition(":")[2].split())
    return set()


def page(text: str) -> str:
    """docs/providers.md of the ledger, and of those that were kept from other computers."""
    ledger: dict[str, Any] = json.loads(text)
    kept = [json.loads(file.read_text(encoding="utf-8")) for file in sorted(RESULTS.glob("providers_*.json"))]
    elsewhere = []
    for other in kept:
        card = other["settings"]["card"]
        elsewhere += [
            f"## {other['machine']['cpu']}{card and f' and {card}'}",
            "",
            f"{_where(other).capitalize()}, by onnxruntime {other['settings']['onnxruntime']} on "
            f"{other['machine']['utc'][:10]}: `python -m perf networks --provider all`.",
            "",
            _table(other),
        ]
    return "\n".join(
        (
            "# What computes the networks, and how fast",
            "",
            "Written by `python -m perf pages --write providers`: the median run of each network by each provider that "
            f"is here, {_where(ledger)} of {ledger['machine']['cpu']}. What is not within "
            'the tolerance `perceive.provider = "auto"` does not take, however fast it is '
            "([networks.md](networks.md#what-computes-them)). `onnxruntime-openvino` has a CPU provider too, of an "
            "older onnxruntime.",
            "",
            _table(ledger),
            *elsewhere,
        )
    )


def _where(ledger: dict[str, Any]) -> str:
    about = ledger["settings"]
    return f"on {about['threads']} threads with {', '.join(about['flags']) or 'none of the instructions that matter'}"


def _table(ledger: dict[str, Any]) -> str:
    rows = []
    for row in ledger["rows"]:
        by = row.get("package", "onnxruntime")
        used = "yes" if row["agrees"] else "no"
        begins = math.isfinite(row["ms"])
        figures = [f"{row['ms']:.1f}", f"{row['off_rel']:.2%}", used] if begins else ["does not begin", "", used]
        rows.append([row["network"], by, row["provider"], *figures])
    head = ["network", "package", "provider", "ms a run", "off the CPU's outputs (RMS)", f"within {TOLERANCE_REL:.0%}"]
    return markdown(head, rows)
