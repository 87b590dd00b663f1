"""Batches side by side give what they give one after the other."""

import threading

import pytest
import torch

from torchrefrac.parallel import side_by_side

CPU = torch.device("cpu")


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_results_come_in_the_order_of_the_items(two_threads):
    assert side_by_side(lambda item: item * item, range(20), CPU) == [i * i for i in range(20)]


def test_every_worker_has_one_thread_of_its_own_and_the_caller_keeps_its_two(two_threads):
    meeting = threading.Barrier(2, timeout=10.0)

    def work(_):
        meeting.wait()  # breaks unless two are at it together
        return torch.get_num_threads()

    assert side_by_side(work, range(2), CPU) == [1, 1]
    assert torch.get_num_threads() == 2


def test_what_goes_wrong_in_a_worker_reaches_the_caller(two_threads):
    def work(item):
        raise ValueError(f"item {item}")

    with pytest.raises(ValueError, match="item 0"):
        side_by_side(work, range(4), CPU)
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize("items", [(), (3,)])
def test_nothing_is_shared_out_where_there_is_nothing_to_share(two_threads, items):
    here = threading.get_ident()

    assert side_by_side(lambda item: threading.get_ident(), items, CPU) == [here] * len(items)
