"""Confirmation of the metric scale by consecutive alignments of the road, and its rejection."""

from __future__ import annotations

from birdslam.odometry.scale_config import RoadScaleConfig

MIN_INFORMATIVE_RATIO = 0.5  # of an alignment's information about the length (`RoadFilter.information`)
_MEAN_COUNT = 5  # time constant of the mean information
_MIN_CHANGE_LOG = 0.3  # a larger factor on the length restarts the count
_MAX_OPPOSING_COUNT = 10.0  # maximum number of alignments for another length, which must be outweighed
_MAX_REJECTED_COUNT, _MIN_FOUND_COUNT = 20, 2  # rejected alignments, and how many of them must find the same length
_LENGTH_TOLERANCE_LOG = 0.2  # between two equal lengths


class ScaleConfirmation:
    """State: sums over consecutive alignments, accepted and rejected ones. Reader: `RoadScale`."""

    def __init__(self, config: RoadScaleConfig) -> None:
        self.config = config
        self._informative = 0.0  # sum over consecutive alignments, each 0 to 1
        self._opposing = 0.0  # the same sum for the length before
        self._rejected = 0.0  # consecutive ones, each by the new fraction of its path
        self.uninformative = 0  # consecutive alignments, rejected or without information about the length
        self._found: list[float | None] = []  # log length of a search in each; None if it found none
        self._mean, self._comparisons = 0.0, 0  # running mean of the information, and its number of samples

    @property
    def is_initialised(self) -> bool:
        """Whether an informative alignment was accepted since the last reset."""
        return self._informative >= MIN_INFORMATIVE_RATIO

    @property
    def is_known(self) -> bool:
        """Whether enough alignments were accepted to confirm the length."""
        return self._informative > self.config.confirmations - MIN_INFORMATIVE_RATIO

    @property
    def is_outweighed(self) -> bool:
        """Whether more alignments agreed on the previous length: a wrong direction yields false ones."""
        return self._informative < self._opposing

    @property
    def is_contradicted(self) -> bool:
        """Whether alignments were rejected since the last informative one."""
        return self._rejected > 0.0

    @property
    def is_doubted(self) -> bool:
        """Whether enough alignments were rejected to start a search for the length."""
        return self._rejected >= self.config.doubt_after

    @property
    def is_violated(self) -> bool:
        """Whether enough alignments were rejected to report GROUND_VIOLATED."""
        return self._rejected >= self.config.violated_after

    def reset(self) -> None:
        """Resets the length to unknown."""
        self._informative = self._opposing = 0.0
        self._found = []

    def reject(self, new: float, found_log: float | None = None) -> None:
        """Adds a rejected alignment; `new` is the new fraction of its path, `found_log` the log length of a search."""
        self._rejected += new
        self.uninformative += 1
        self._found = [*self._found[1 - _MAX_REJECTED_COUNT :], found_log]

    def was_found_before(self, log_length: float) -> bool:
        """Whether several rejected alignments found this length in the current scale."""
        matches = [log for log in self._found if log is not None and abs(log - log_length) < _LENGTH_TOLERANCE_LOG]
        return len(matches) >= _MIN_FOUND_COUNT

    def is_plausible(self, log_length: float) -> bool:
        """Whether to accept a length that a search found: while a length is known, only one that was found before."""
        return not self.is_known or abs(log_length) < _LENGTH_TOLERANCE_LOG or self.was_found_before(log_length)

    def update_mean_information(self, information: float) -> float:
        """Adds an alignment's information and returns the running mean, which averages random peaks."""
        self._mean += (information - self._mean) / min(self._comparisons + 1, _MEAN_COUNT)
        self._comparisons += 1
        return self._mean

    def add_accepted(self, information: float) -> None:
        """Adds an accepted alignment, which reduces the rejections by its information (0 to 1)."""
        self._rejected *= 1.0 - information
        self._found = []  # the scale changes
        self.uninformative = 0 if information >= MIN_INFORMATIVE_RATIO else self.uninformative + 1

    def confirm(self, information: float, log_factor: float) -> None:
        """Adds the information of an accepted alignment that changed the log length by `log_factor`."""
        if abs(log_factor) > _MIN_CHANGE_LOG:
            self._opposing, self._informative = min(self._informative, _MAX_OPPOSING_COUNT), 0.0
        self._informative += information
