"""The context manager base of buses, rings and locks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self


class Closing(ABC):
    """A context manager that returns itself and calls `close` on exit."""

    @abstractmethod
    def close(self) -> None:
        """Releases its resources."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failure: object) -> None:
        self.close()
