"""What a release uploads, the same bytes for whoever has the commit: python .ci/dist.py DIR (`make dist`).

Wheel and source distribution of the committed tree, built twice and compared; what they need, as CycloneDX, of an
environment with the wheel alone; the SHA-256 of each. Raises where anything is not committed, the bytes differ, or the
version's tag is another commit.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import os
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def call(*command: str | Path, cwd: Path = ROOT, **environment: str) -> str:
    """A command's output. Raises with what it says where it fails."""
    done = subprocess.run(
        command, cwd=cwd, env={**os.environ, **environment}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))} ended with {done.returncode}:\n{done.stdout}")
    return done.stdout


def build(folder: Path, epoch: str) -> dict[str, bytes]:
    """File -> bytes of wheel and source distribution, of the tree of HEAD, whose times are those of its commit."""
    tree = folder / "tree"
    tree.mkdir(parents=True)
    archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, stdout=subprocess.PIPE, check=True).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as opened:
        opened.extractall(tree, filter="tar")
    call(
        sys.executable, "-m", "build", "--no-isolation", "--outdir", folder / "built", tree,
        cwd=folder, SOURCE_DATE_EPOCH=epoch, PYTHONHASHSEED="0",
    )  # fmt: skip
    made = {path.name: path.read_bytes() for path in sorted((folder / "built").iterdir())}
    return {name: normalised(data, int(epoch)) if name.endswith(".tar.gz") else data for name, data in made.items()}


def normalised(data: bytes, epoch: int) -> bytes:
    """A tar.gz with the commit's time, no owner and a fixed order: what is written while it is built has times too."""
    out = io.BytesIO()
    with tarfile.open(fileobj=io.BytesIO(data)) as old, tarfile.open(fileobj=out, mode="w") as new:
        for member in sorted(old.getmembers(), key=lambda one: one.name):
            member.mtime, member.uid, member.gid, member.uname, member.gname = epoch, 0, 0, "", ""
            member.pax_headers = {}
            new.addfile(member, old.extractfile(member) if member.isreg() else None)
    return gzip.compress(out.getvalue(), mtime=0)


def bill_of_materials(wheel: Path, folder: Path) -> bytes:
    """CycloneDX of an environment with the wheel and what it asks for, and nothing else."""
    place = folder / "environment"
    venv.create(place, with_pip=True)
    python = place / "bin" / "python"
    call(python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", wheel)
    call(python, "-m", "pip", "uninstall", "--quiet", "--yes", "pip", "setuptools")
    out = folder / "bom.json"
    call(
        Path(sys.executable).parent / "cyclonedx-py", "environment", python, "--output-reproducible",
        "--output-format", "JSON", "--output-file", out,
    )  # fmt: skip
    return out.read_bytes()


def release(version: str) -> str:
    """What is built, for a person: a version is its tag. Raises where that is another commit's."""
    tag = f"v{version}"
    if tag in call("git", "tag", "--points-at", "HEAD").split():
        return f"the release {tag}"
    if call("git", "tag", "--list", tag).strip():
        raise SystemExit(f"{tag} is another commit: raise `version` in pyproject.toml, or check out the tag")
    return f"no release: this commit has no tag {tag}"


def main(target: Path) -> None:
    """Writes it all into a folder."""
    if call("git", "status", "--porcelain"):
        raise SystemExit("what is not committed is in no release: commit it, or stash it")
    what = release(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"])
    epoch = call("git", "log", "-1", "--format=%ct").strip()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        first, second = (build(place / which, epoch) for which in ("first", "second"))
        if first != second:
            different = [name for name in first if first[name] != second.get(name)]
            raise SystemExit(f"not the same bytes twice: {', '.join(different)}")
        target.mkdir(parents=True, exist_ok=True)
        for path in target.iterdir():
            path.unlink()
        for file, data in first.items():
            (target / file).write_bytes(data)
        (wheel,) = target.glob("*.whl")
        version = wheel.name.split("-")[1]
        (target / f"birdslam-{version}.cdx.json").write_bytes(bill_of_materials(wheel.resolve(), place))
    lines = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}" for path in sorted(target.iterdir())]
    (target / "SHA256SUMS").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))
    print(what)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
