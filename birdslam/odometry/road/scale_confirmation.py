"""Whether the metric scale is known: what the road's alignments in a row have told of the length, and which failed."""

from __future__ import annotations

from birdslam.odometry.scale_config import RoadScaleConfig

TOLD = 0.5  # of an alignment's information about the length (kalman_filter.py): with more it counts as told
_COMPARISONS = 5  # time constant of the mean of what they tell
_ANOTHER_LOG = 0.3  # of the factor on the length by an alignment: a larger one begins the row again
_MAX_AGAINST = 10.0  # alignments that agreed on the length before, which as many must outweigh
_REMEMBERED, _FOUND = 20, 2  # rejected alignments, and how many of them must have found the same length
_SAME_LOG = 0.2  # of two lengths that are the same


class ScaleConfirmation:
    """State: the rows of alignments that agree and of those that are rejected. Reader: `RoadScale`."""

    def __init__(self, config: RoadScaleConfig) -> None:
        self.config = config
        self._reported = 0.0  # by alignments in a row, each 0 to 1
        self._against = 0.0  # told of another length by those in a row before
        self._rejected = 0.0  # in a row, each by its new share of the path: those of one view err together
        self.rejections = 0  # their number
        self._found: list[float | None] = []  # logs of the length that they found by a search, None: none
        self._mean, self._comparisons = 0.0, 0  # mean information of comparisons about the length, and their number

    @property
    def started(self) -> bool:
        """Whether an alignment has told a length since it was last unknown."""
        return self._reported >= TOLD

    @property
    def known(self) -> bool:
        """Whether enough have."""
        return self._reported > self.config.confirmations - TOLD

    @property
    def outweighed(self) -> bool:
        """Whether more have agreed on another length just before.

        Where the motion's direction is wrong no right length correlates, and a false one may for a while.
        """
        return self._reported < self._against

    @property
    def contradicted(self) -> bool:
        """Whether the last alignment was rejected, or did not tell enough to end a row of those."""
        return self._rejected > 0.0

    @property
    def doubted(self) -> bool:
        """Whether so many were rejected that the length is searched for."""
        return self._rejected >= self.config.doubt_after

    @property
    def violated(self) -> bool:
        """Whether so many were rejected that the ground is doubtful."""
        return self._rejected >= self.config.violated_after

    def forget(self) -> None:
        """The length is unknown."""
        self._reported = self._against = 0.0
        self._found = []

    def reject(self, new: float, found_log: float | None = None) -> None:
        """An alignment was rejected, of which this share of the path is new; `found_log` by a search."""
        self._rejected += new
        self.rejections += 1
        self._found = [*self._found[1 - _REMEMBERED :], found_log]

    def found_before(self, log_length: float) -> bool:
        """Whether rejected alignments had found this length in the present unit: one may by chance."""
        agree = [log for log in self._found if log is not None and abs(log - log_length) < _SAME_LOG]
        return len(agree) >= _FOUND

    def may_be(self, log_length: float) -> bool:
        """Whether a search may have found this length in the present unit.

        One search in many finds any by chance: a known length gives way to another one that was found before.
        """
        return not self.known or abs(log_length) < _SAME_LOG or self.found_before(log_length)

    def mean_information(self, information: float) -> float:
        """The mean of what comparisons tell with this one: by chance a single one may look like information."""
        self._mean += (information - self._mean) / min(self._comparisons + 1, _COMPARISONS)
        self._comparisons += 1
        return self._mean

    def agree(self, tells: float) -> None:
        """An alignment agrees and tells so much of the length, 0 to 1: it ends a row of rejections by as much."""
        self._rejected *= 1.0 - tells
        self._found = []  # the unit changes
        if tells >= TOLD:
            self.rejections = 0

    def confirm(self, tells: float, log_factor: float) -> None:
        """It has changed the length by this factor."""
        if abs(log_factor) > _ANOTHER_LOG:
            self._against, self._reported = min(self._reported, _MAX_AGAINST), 0.0
        self._reported += tells
