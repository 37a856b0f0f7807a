import threading

import pytest

from harness.processes import made_ahead, side_by_side


@pytest.mark.parametrize("worthwhile", [True, False])
def test_results_come_in_the_order_of_the_items(worthwhile):
    assert side_by_side(lambda i: i * i, range(100), worthwhile=worthwhile) == [i * i for i in range(100)]
    with pytest.raises(ZeroDivisionError):
        side_by_side(lambda i: 1 // i, [1, 0, 1], worthwhile=worthwhile)


@pytest.mark.parametrize("n_threads", [None, 1, 3])
def test_what_is_made_ahead_comes_in_the_order_of_the_items(n_threads):
    assert list(made_ahead(lambda i: i * i, range(20), n_threads)) == [i * i for i in range(20)]
    assert list(made_ahead(str, [], n_threads)) == []
    ahead = made_ahead(lambda i: 1 // i, [1, 0, 1], n_threads)
    assert next(ahead) == 1
    with pytest.raises(ZeroDivisionError):
        next(ahead)


def test_the_next_item_is_made_while_the_present_one_is_in_use():
    second_made = threading.Event()

    def make(i):
        if i == 2:
            second_made.set()
        return i

    for item in made_ahead(make, [1, 2], 1):
        assert item == 2 or second_made.wait(10)
