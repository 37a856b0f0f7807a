"""Which part of a campaign's tests one task of a job array runs."""

from __future__ import annotations

import re
from dataclasses import dataclass

from harness.errors import HarnessError


@dataclass(frozen=True)
class Part:
    """The ``number``-th, from 1 on, ``of`` so many equal slices.

    Raises
    ------
    HarnessError
        There is no such one.
    """

    number: int
    of: int

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.of:
            raise _no_part(f"{self.number}/{self.of}")

    @classmethod
    def parse(cls, text: str) -> Part:
        """Read ``3/64``."""
        found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text, re.ASCII)
        if found is None:
            raise _no_part(text)
        return cls(int(found[1]), int(found[2]))

    def bounds(self, n_shards: int) -> tuple[int, int]:
        """The first of its shards, and the first of the next part's."""
        return n_shards * (self.number - 1) // self.of, n_shards * self.number // self.of


def _no_part(text: str) -> HarnessError:
    return HarnessError(
        "--part",
        found=text,
        expected="K/N with K from 1 to N: the K-th of N parts",
        mend="Write e.g. --part 3/64; add 1 to the index of a job array that begins at 0.",
    )
