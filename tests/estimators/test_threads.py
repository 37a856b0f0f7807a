import threading

import pytest

from harness.estimators.threads import read_ahead, side_by_side


@pytest.mark.parametrize("worthwhile", [True, False])
def test_results_come_in_the_order_of_the_items(worthwhile):
    assert side_by_side(lambda i: i * i, range(100), worthwhile=worthwhile) == [i * i for i in range(100)]


@pytest.mark.parametrize("worthwhile", [True, False])
def test_an_error_of_one_item_is_raised(worthwhile):
    with pytest.raises(ZeroDivisionError):
        side_by_side(lambda i: 1 // i, [1, 0, 1], worthwhile=worthwhile)


def test_items_read_ahead_are_the_same_items():
    assert list(read_ahead(iter([None, 1, (), 2]))) == [None, 1, (), 2]
    assert list(read_ahead(iter([]))) == []


def test_the_next_item_is_made_while_the_present_one_is_in_use():
    second_made = threading.Event()

    def items():
        yield 1
        second_made.set()
        yield 2

    for item in read_ahead(items()):
        assert item == 2 or second_made.wait(10)


def test_an_error_while_reading_is_raised_where_the_items_are_used():
    def items():
        yield 1
        raise OSError("disk")

    ahead = read_ahead(items())
    assert next(ahead) == 1
    with pytest.raises(OSError, match="disk"):
        next(ahead)
