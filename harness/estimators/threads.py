"""Both cores for one pass: strata side by side, and the next block read while the present one is being used.

What is done, and in which order within a stratum, is the same as without threads, so every bit is.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import islice
from typing import TypeVar

from threadpoolctl import ThreadpoolController

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


@cache
def _shared() -> tuple[ThreadPoolExecutor, ThreadpoolController]:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="estimators"), ThreadpoolController()


def side_by_side(
    function: Callable[[_Item], _Result], items: Sequence[_Item], *, worthwhile: bool = True
) -> list[_Result]:
    """Results, in order, of a function that lets go of the interpreter lock, for items independent of each other.

    Without threads where that is not ``worthwhile``: handing over a trifle costs more than doing it.
    """
    threads, libraries = _shared()
    with libraries.limit(limits=1, user_api="blas"):  # BLAS's own threads would wait for each other in busy loops
        return list(threads.map(function, items)) if worthwhile else [function(item) for item in items]


def read_ahead(items: Iterator[_Item]) -> Iterator[_Item]:
    """The same items, the next one being made in a thread while the present one is in use."""
    with ThreadPoolExecutor(1, thread_name_prefix="read-ahead") as thread:
        coming = thread.submit(list, islice(items, 1))
        while following := coming.result():
            coming = thread.submit(list, islice(items, 1))
            yield following[0]
