import threading
from functools import partial

import pytest

from harness.processes import made_ahead, side_by_side


@pytest.mark.parametrize(
    "work",
    [
        *(partial(side_by_side, worthwhile=worthwhile) for worthwhile in (True, False)),
        *(partial(made_ahead, n_threads=n_threads) for n_threads in (None, 1, 3)),
    ],
)
def test_results_come_in_the_order_of_the_items_and_errors_where_they_are_raised(work):
    assert list(work(lambda i: i * i, range(100))) == [i * i for i in range(100)]
    assert list(work(str, [])) == []
    with pytest.raises(ZeroDivisionError):
        list(work(lambda i: 1 // i, [1, 0, 1]))


def test_the_next_item_is_made_while_the_present_one_is_in_use():
    second_made = threading.Event()

    def make(i):
        if i == 2:
            second_made.set()
        return i

    for item in made_ahead(make, [1, 2], 1):
        assert item == 2 or second_made.wait(10)
