"""`[perceive.schedule]`: which head of perceive runs when."""

from __future__ import annotations

from typing import Annotated

import msgspec

from birdslam.perception import ModelSpec

PositiveInt = Annotated[int, msgspec.Meta(ge=1)]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]


class Turn(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a head of perceive runs: on every so-manieth frame, or so often a second at the source's frame rate."""

    every: PositiveInt | None = None  # on one frame in so many
    hz: Positive | None = None  # so often a second; not beside `every`

    def __post_init__(self) -> None:
        if self.every is not None and self.hz is not None:
            raise ValueError("every and hz say the same: one of them")

    def at(self, rate_hz: float) -> Turn:
        """In frames of a source of that rate."""
        if self.hz is None:
            return self
        return msgspec.structs.replace(self, every=max(1, round(rate_hz / self.hz)), hz=None)


class NetworkTurn(Turn, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Of a network of images. What is None is its manifest's to say."""

    awaited: bool | None = None  # False: no frame waits for it, not even up to its deadline


class ScheduleConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which head runs when. A head that is late is skipped and its last result carried, with its age and a status."""

    detector: NetworkTurn = NetworkTurn()
    segmenter: NetworkTurn = NetworkTurn()
    depth: NetworkTurn = NetworkTurn()
    multitask: NetworkTurn = NetworkTurn()
    lanes: Turn = Turn(hz=5.0)  # made out of many frames, their completion with it; on a thread that nobody awaits

    def of(self, role: str, spec: ModelSpec) -> ModelSpec:
        """The network of a role as this schedule has it run; `at` comes before."""
        turn: NetworkTurn = getattr(self, role)
        said = {key: value for key in ("every", "awaited") if (value := getattr(turn, key)) is not None}
        return msgspec.structs.replace(spec, **said)

    def at(self, rate_hz: float) -> ScheduleConfig:
        """In frames of a source of that rate."""
        return ScheduleConfig(**{head: getattr(self, head).at(rate_hz) for head in self.__struct_fields__})
