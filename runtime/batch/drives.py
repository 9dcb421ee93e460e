"""Finds the drives of a batch from paths, URIs, URLs and lists of them; assigns names and settings."""

from __future__ import annotations

import hashlib
import itertools
import re
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec

from birdslam.runtime.batch.fetch import is_url
from birdslam.runtime.configuration import ConfigurationError, dump, load, parse_setting
from birdslam.runtime.schemes import MCAP, all_schemes
from birdslam.sources.schemes import KITTI, ROSBAG, by_suffix, scheme_at, scheme_of

LISTS = (".txt", ".list")


class Found(msgspec.Struct, frozen=True):
    """A drive with its own settings from a list."""

    uri: str
    settings: dict[str, Any] = {}


class Task(msgspec.Struct, frozen=True, kw_only=True):
    """A drive with all its settings, for a worker."""

    name: str  # of its folder of results
    uri: str
    settings: dict[str, Any]  # of the sweep and of the drive
    configuration: dict[str, Any]  # without the source's URI
    identity: str  # hash of everything that determines its results


def find_drives(arguments: Sequence[str]) -> list[Found]:
    """Returns the drives of a command line. Raises ConfigurationError for an unreadable list, or without a drive."""
    found = [drive for argument in arguments for drive in _drives(argument)]
    twice = [drive for drive, count in Counter((d.uri, str(d.settings)) for d in found).items() if count > 1]
    if twice:
        raise ConfigurationError(f"{twice[0][0]}: is named twice")
    if not found:
        raise ConfigurationError("no drives")
    return found


def _drives(argument: str, base: Path | None = None) -> Iterator[Found]:
    scheme, (_, colon, address) = scheme_of(argument, all_schemes()), argument.partition(":")
    if scheme is not None and scheme.live and colon:
        raise ConfigurationError(f"{argument}: is a live camera; a batch needs recordings")
    if scheme is not None and (colon or argument in scheme.written):
        if scheme.address == "path" and address and not is_url(address):
            address = str(((base or Path()) / Path(address).expanduser()).absolute())
        yield Found(f"{scheme.name}:{address}" if address else scheme.name)
        return
    if is_url(argument):
        yield Found(_uri_of_url(argument))
        return
    path = ((base or Path()) / Path(argument).expanduser()).absolute()
    if path.suffix.lower() in LISTS and path.is_file():
        yield from _listed(path)
        return
    uri = _uri(path)
    if uri is None and path.is_dir():
        inside = [found for child in sorted(path.iterdir()) if (found := _uri(child)) is not None]
        if inside:
            yield from map(Found, inside)
            return
    yield Found(uri or f"{KITTI.name}:{path}")  # opening it raises the error


def _listed(path: Path) -> Iterator[Found]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: can't be read: {getattr(error, 'strerror', None) or 'not UTF-8'}") from None
    for number, line in enumerate(lines, start=1):
        try:
            words = shlex.split(line, comments=True)
            settings = dict(parse_setting(word) for word in words[1:])
        except (ValueError, ConfigurationError) as error:
            raise ConfigurationError(f"{path}: line {number}: {error}") from None
        for key in ("camera", "source.speed"):  # paths in a list are relative to it
            if isinstance(settings.get(key), str):
                settings[key] = str(path.parent / Path(settings[key]).expanduser())
        for drive in _drives(words[0], path.parent) if words else ():
            yield Found(drive.uri, {**drive.settings, **settings})


def _uri(path: Path) -> str | None:
    """Returns the URI of the source at a path; None if there is none."""
    scheme = scheme_at(path, all_schemes())
    return None if scheme is None else f"{scheme.name}:{path}"


def _uri_of_url(url: str) -> str:
    """Returns the URI of the source at a URL, by its file name. Raises ConfigurationError for an unknown suffix."""
    scheme = by_suffix(Path(url), all_schemes())
    if scheme is None:
        raise ConfigurationError(f"{url}: unknown suffix; name the kind: {ROSBAG.name}:{url} or {MCAP.name}:{url}")
    return f"{scheme.name}:{url}"


def sweep(texts: Sequence[str]) -> list[dict[str, Any]]:
    """Returns every combination of the values of KEY=V1,V2 settings. Raises ConfigurationError."""
    axes = []
    for text in texts:
        key, equals, values = text.partition("=")
        if not equals or not key.strip() or not all(value.strip() for value in values.split(",")):
            raise ConfigurationError(f"--sweep {text}: expected KEY=V1,V2")
        axes.append([parse_setting(f"{key}={value.strip()}", "--sweep") for value in values.split(",")])
    return [dict(settings) for settings in itertools.product(*axes)]


def tasks(
    drives: Sequence[Found], settings: Sequence[Mapping[str, Any]], config: Path | None, overrides: Mapping[str, Any],
    models: Sequence[str],
) -> list[Task]:  # fmt: skip
    """Combines each drive with each of the settings. Raises ConfigurationError.

    Drives of the same settings share one configuration, without the source's URI, to save memory.
    """
    made: list[Task] = []
    known: dict[bytes, tuple[dict[str, Any], bytes]] = {}
    for drive, name in zip(drives, _names(drives), strict=True):
        for swept in settings:
            own = {**drive.settings, **swept}
            key = msgspec.json.encode(own, order="deterministic")
            if key not in known:
                given = {**overrides, **own, "source.uri": "", "source.rate": "max"}
                configuration = load(config, given, models)
                if configuration.source.loop:
                    raise ConfigurationError("source.loop: a batch takes each drive once")
                tree = dump(configuration)
                tree.pop("output")
                _anchor(tree)
                known[key] = tree, msgspec.json.encode((version("birdslam"), tree), order="deterministic")
            tree, encoded = known[key]
            at = "".join(f"@{setting}={value}" for setting, value in swept.items())
            made.append(
                Task(
                    name=re.sub(r"[^\w.@=+-]", "_", name + at),
                    uri=drive.uri,
                    settings={**drive.settings, **swept},
                    configuration=tree,
                    identity=hashlib.sha256(encoded + drive.uri.encode()).hexdigest(),
                )
            )
    return made


def _anchor(tree: dict[str, Any]) -> None:
    """Makes paths absolute, since a worker may run in another folder."""
    if tree["source"]["speed"]:
        tree["source"]["speed"] = str(Path(tree["source"]["speed"]).expanduser().absolute())
    for spec in tree["models"].values():
        for key in ("path", "manifest") if isinstance(spec, dict) else ():
            if Path(spec[key]).is_file():
                spec[key] = str(Path(spec[key]).absolute())


def _names(drives: Sequence[Found]) -> list[str]:
    """Returns the name of each drive's file or folder; equal names get a part of the URI's hash."""
    plain = [Path(drive.uri.partition(":")[2] or drive.uri).stem for drive in drives]
    counts = Counter(plain)
    return [
        name if counts[name] == 1 else f"{name}-{hashlib.sha256(str(drive).encode()).hexdigest()[:8]}"
        for name, drive in zip(plain, drives, strict=True)
    ]
