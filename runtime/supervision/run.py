"""A whole run: the checks before it, the processes, and the results after it.

Exit status: 0 at the end of the source and after SIGTERM, 130 after Ctrl-C; in each case the frames in flight are
processed and the results written. 1 if a node failed permanently, 2 for invalid input; the reason is one line on
standard error.
"""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import msgspec

from birdslam.loops.gnss.earth import EarthError
from birdslam.loops.gnss.files import GnssError
from birdslam.loops.map_file import MapError
from birdslam.outputs.drive_files import Recorder, ResultsError, claim_directory
from birdslam.outputs.plain_words import LengthsBy
from birdslam.outputs.report.page import REPORT
from birdslam.perception import KeptFindings, ModelError, load_network
from birdslam.perception.pointnet import load_pointnet
from birdslam.runtime.configuration import Configuration, ConfigurationError, complete
from birdslam.runtime.environment import INTERRUPTED_STATUS
from birdslam.runtime.nodes.sources import RecordedSource, open_source
from birdslam.runtime.process import realtime
from birdslam.runtime.process.child import give_back_memory
from birdslam.runtime.recording.recording import RecordingError
from birdslam.runtime.supervision.demo_report import DemoReport
from birdslam.runtime.supervision.drive_report import can_report, write_report
from birdslam.runtime.supervision.final_results import GNSS_UNUSED, FinalResults, check_results
from birdslam.runtime.supervision.live import LiveLine
from birdslam.runtime.supervision.logbook import Logbook, Results
from birdslam.runtime.supervision.map_station import map_summary
from birdslam.runtime.supervision.query_server import QueryServer
from birdslam.runtime.supervision.recording_files import RecordingFiles, choose_file
from birdslam.runtime.supervision.report import summarise, table
from birdslam.runtime.supervision.supervisor import Supervisor
from birdslam.runtime.topology import NODES
from birdslam.runtime.transport.bus import Bus
from birdslam.runtime.transport.presence import (
    VehicleLock,
    findings_path,
    own_runtime_dir,
    runtime_dir_of,
    socket_path,
)
from birdslam.sources.recording import DatasetError

ANY_VEHICLE = Configuration().vehicle  # the default name
WITHOUT_MODELS = "no networks: odometry only, without vehicles and lanes"
USER_ERRORS = MapError, GnssError, EarthError, ConfigurationError  # of a map or GNSS fixes, after the drive
DRIVE_MIB = 32.0, 8.0  # reserved for objects (the atlas has up to two epochs of 13 MiB) and for tables


def run(
    configuration: Configuration,
    lengths_by: LengthsBy | None = None,
    film_track: Path | None = None,
    kept: KeptFindings | None = None,
) -> int:
    """Runs a drive; returns the exit status. Raises errors of the user before anything is started.

    `lengths_by`: the source of the metric scale, for the verdict at the end, if a first pass calibrated the camera.
    `film_track`: GNSS fixes found inside the film. At rate "max", without a vehicle name or a runtime directory, the
    run has a private bus, and its networks do not run where a first pass has `kept` their findings.
    """
    alone = configuration.lossless and configuration.vehicle == ANY_VEHICLE and configuration.runtime_dir is None
    with own_runtime_dir(configuration.vehicle) if alone else nullcontext() as directory:
        if directory is not None:
            if kept is not None:
                kept.write(findings_path(directory))
            runtime = msgspec.structs.replace(configuration.runtime, runtime_dir=str(directory))
            configuration = msgspec.structs.replace(configuration, runtime=runtime)
        return _run(configuration, lengths_by, film_track)


def _run(configuration: Configuration, lengths_by: LengthsBy | None, film_track: Path | None) -> int:
    realtime.use_one_heap()  # before the networks are loaded, which starts threads
    configuration, models, frames = check(configuration)
    give_back_memory()  # of the networks
    output = Path(configuration.output)
    realtime.reserve(*DRIVE_MIB)
    live = LiveLine(sys.stdout)
    demo = DemoReport.of(configuration)
    final = FinalResults(configuration, demo, film_track)
    with ExitStack() as until_written:
        with ExitStack() as stack:
            stack.enter_context(VehicleLock(configuration.vehicle, configuration.runtime_dir))
            claim_directory(output / "logs")
            if not models:
                live.say(WITHOUT_MODELS)
            assert configuration.camera is not None
            recorder = Recorder(output, configuration.camera)
            recorded = final.recorded(until_written)
            files = RecordingFiles(Path(recorded.recording.file), models) if recorded.recording.file else None
            listeners = [demo, final.map]
            logbook = _logbook(configuration, recorder, [each for each in listeners if each is not None], stack)
            supervisor = Supervisor(recorded, logbook, live, files, frames)
            supervisor.run(output / "logs")
        live.clear()
        summary = summarise(configuration, supervisor.nodes, logbook, models, supervisor.ended)
        if files is not None and supervisor.recorder is not None:
            figures = files.figures(supervisor.recorder)
            if configuration.recording.file:
                summary["recording"] = figures
            elif figures["dropped"]:
                live.say(f"the recorder lost {figures['dropped']} messages: the final results lack them")
        if supervisor.map is not None:
            summary |= map_summary(supervisor.map, output / "logs")
        if demo is not None and (found := demo.grade()) is not None:
            summary["truth"] = msgspec.to_builtins(found)
        try:
            if logbook.recorded:
                summary |= final.write(files.paths if files is not None else ())
            if GNSS_UNUSED in summary:
                live.say(f"the GNSS track inside the film is not used: {summary[GNSS_UNUSED]}")
        except (ResultsError, DatasetError, RecordingError, *USER_ERRORS, OSError) as error:
            supervisor.fail(f"final results can't be written: {error}", 1)
        except KeyboardInterrupt:
            supervisor.fail("the final results were interrupted", INTERRUPTED_STATUS)
    sentences: list[str] = []
    try:
        sentences = recorder.finish(summary, lengths_by)
    except OSError as error:
        supervisor.fail(f"results can't be written: {error}", 1)
    if logbook.unwritten is not None:
        supervisor.fail(f"results are incomplete: {logbook.unwritten}", 1)
    if reported := bool(sentences) and not configuration.live and can_report():
        try:
            write_report(output, output / REPORT)
        except (ResultsError, RecordingError) as error:
            supervisor.fail(f"the report can't be written: {error}", 1)
            reported = False
    live.say(table(summary, output))
    if reported:
        live.say(f"{'report':24}{output / REPORT}")
    if sentences:
        live.say("\n".join(("", *sentences)))
    if supervisor.failure:
        print(f"birdslam: {supervisor.failure}", file=sys.stderr)
    return supervisor.exit_status


def _logbook(
    configuration: Configuration, recorder: Recorder, listeners: Sequence[Results], stack: ExitStack
) -> Logbook:
    """Connects the supervisor to the bus: it receives the results and answers queries about them."""
    bus = stack.enter_context(
        Bus(
            configuration.vehicle,
            "supervisor",
            hub=True,
            runtime_dir=configuration.runtime_dir,
            lossless=configuration.lossless,
        )
    )
    every = [QueryServer(configuration, bus), *listeners]
    logbook = Logbook(bus, recorder, tolerant=configuration.restarts, listeners=every)
    stack.callback(logbook.close)
    bus.declare_alive()
    return logbook


def check(configuration: Configuration) -> tuple[Configuration, dict[str, Any], int | None]:
    """Checks the configuration before a process is started, and fills in the source's camera.

    Returns also the descriptions of the networks, and the number of frames of the source if it is known. Raises
    ConfigurationError, SourceError, DatasetError, ModelError or ResultsError.
    """
    check_runtime_dir(configuration.vehicle, configuration.runtime_dir)
    source = open_source(configuration)
    configuration = complete(configuration, source.camera, source.rate_hz)
    frames: int | None = None
    source.close()  # capture opens it again
    if isinstance(source, RecordedSource) and not configuration.source.loop:
        frames = min(len(source.recording), configuration.source.frames or len(source.recording)) or None
    check_results(configuration, source)
    recording = configuration.recording
    if recording.file:
        file = choose_file(recording, configuration.vehicle)
        configuration = msgspec.structs.replace(configuration, recording=msgspec.structs.replace(recording, file=file))
    return configuration, _described(configuration), frames


def _described(configuration: Configuration) -> dict[str, Any]:
    """Returns the description of each network with its requested provider. Raises ModelError for an unusable one.

    A child process loads them, so that the supervisor does not keep their memory.
    """
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_describe, args=(configuration, sender), daemon=True)
    process.start()
    sender.close()
    try:
        found: dict[str, Any] | ModelError = receiver.recv()
    except EOFError:
        process.join()
        raise ModelError(f"the process that loads the networks ended with status {process.exitcode}") from None
    process.join()
    if isinstance(found, ModelError):
        raise found
    return found


def _describe(configuration: Configuration, sender: Connection) -> None:
    models, asked = configuration.models, configuration.perceive.provider
    try:
        # Loaded on the CPU; the provider in perceive is in its log and in PROVIDER_MISSING
        out = {
            role: load_network(role, msgspec.structs.replace(spec, provider="cpu")).describe()
            | {"provider": spec.provider or asked}
            for role, spec in models.in_use().items()
        }
        if models.pointnet is not None:
            out["pointnet"] = load_pointnet(models.pointnet).describe()
        sender.send(out)
    except ModelError as error:
        sender.send(error)


def check_runtime_dir(vehicle: str, runtime_dir: Path | None) -> None:
    """Raises ConfigurationError if the sockets can't be created there."""
    try:
        for name in (*NODES, "supervisor"):
            socket_path(runtime_dir_of(vehicle, runtime_dir), name)
    except (ValueError, OSError) as error:
        raise ConfigurationError(f"vehicle {vehicle!r}, runtime directory: {error}") from error
