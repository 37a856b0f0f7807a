"""All cores for one pass: strata side by side, and the next blocks read while the present one is being used.

What is done, and in which order within a stratum, is the same as without threads, so every bit is.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
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


def made_ahead(
    make: Callable[[_Item], _Result], items: Iterable[_Item], n_threads: int | None = None
) -> Iterator[_Result]:
    """What is made of each item, in order; the next ones are being made in threads while the present one is in use.

    ``n_threads`` (as many as there are cores by default) of them at a time: one where ``make`` is not to be called by
    two threads at once.
    """
    n_threads = n_threads or os.cpu_count() or 1
    with ThreadPoolExecutor(n_threads, thread_name_prefix="made-ahead") as threads:
        coming: deque[Future[_Result]] = deque()
        for item in items:
            coming.append(threads.submit(make, item))
            if len(coming) > n_threads:
                yield coming.popleft().result()
        while coming:
            yield coming.popleft().result()
