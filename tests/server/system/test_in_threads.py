"""Work in Python's threads: in order, side by side where there are many items, and errors come through."""

import threading

import pytest

from trompe_server.system.threads import WORTH, in_threads


@pytest.mark.parametrize("count", [0, 1, WORTH - 1, WORTH, 100])
def test_results_come_in_the_order_of_the_items(count: int) -> None:
    assert in_threads(lambda a, b: a - b, range(count), iter(range(0, 2 * count, 2))) == [-k for k in range(count)]


@pytest.mark.parametrize(("count", "others"), [(WORTH - 1, False), (WORTH, True)])
def test_few_items_are_not_worth_a_thread(count: int, others: bool) -> None:
    used = set(in_threads(lambda _: threading.get_ident(), range(count)))
    assert (threading.get_ident() not in used) is others


@pytest.mark.parametrize("setting", ["3", "3,2"])
def test_as_many_threads_as_torch_has(monkeypatch: pytest.MonkeyPatch, setting: str) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", setting)
    together = threading.Barrier(3, timeout=30)
    assert len(in_threads(lambda _: together.wait(), range(9))) == 9


@pytest.mark.parametrize("count", [1, 2 * WORTH])
def test_an_error_comes_through(count: int) -> None:
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda k: 1 // k, range(count))
