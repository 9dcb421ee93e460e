"""User errors. Each is printed as one line on standard error, with exit status 2."""

from birdslam.calibration.calibration import CalibrationError
from birdslam.loops.gnss.earth import EarthError
from birdslam.loops.gnss.files import GnssError
from birdslam.loops.map_file import MapError
from birdslam.loops.merging import MergeError
from birdslam.outputs.drive_files import ResultsError
from birdslam.perception import ModelError
from birdslam.ros.bag import BagError
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.models.download import DownloadError
from birdslam.runtime.nodes.sources import SourceError
from birdslam.runtime.recording.recording import RecordingError
from birdslam.runtime.transport.bus import BusError
from birdslam.runtime.transport.presence import VehicleBusy
from birdslam.sources.recording import DatasetError

USER_ERRORS = (
    BagError,
    BusError,
    CalibrationError,
    ConfigurationError,
    DatasetError,
    DownloadError,
    EarthError,
    GnssError,
    MapError,
    MergeError,
    ModelError,
    RecordingError,
    ResultsError,
    SourceError,
    VehicleBusy,
)
