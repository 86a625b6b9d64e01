"""Work in threads of Python and of torch: in order, side by side where that pays, and errors come through."""

import threading
from collections.abc import Iterator, Sequence

import pytest
import torch

from trompe_server.system.threads import WORTH, in_parts, in_threads, side_by_side


@pytest.fixture(params=[1, 2, 5])
def torch_threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


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


# Torch's work in parts


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_parts_and_results_are_the_same_for_any_number_of_threads(torch_threads: int, count: int) -> None:
    parts = [list(part) for part in (range(0, count, 2), range(1, count, 2)) if part]
    assert in_parts(list, range(count)) == parts
    assert in_parts(list, range(count), split=False) == [list(range(count))] * bool(count)
    assert side_by_side(lambda k: k * k, range(count)) == [k * k for k in range(count)]


def test_parts_run_at_once_on_their_share_of_threads(torch_threads: int) -> None:
    together = threading.Barrier(min(torch_threads, 2), timeout=30)

    def of(part: Sequence[int]) -> int:
        together.wait()
        return torch.get_num_threads()

    assert in_parts(of, range(4)) == [max(1, torch_threads // 2)] * 2
    assert torch.get_num_threads() == torch_threads
    found: list[int] = []
    later = threading.Thread(target=lambda: found.append(torch.get_num_threads()))
    later.start()
    later.join()
    assert found == [torch_threads]


def test_parts_of_a_part_run_in_turn(torch_threads: int) -> None:
    assert in_parts(lambda part: in_parts(sum, part), range(8)) == [[0 + 4, 2 + 6], [1 + 5, 3 + 7]]


def test_gradients_are_enabled_in_each_part_and_its_error_comes_through(torch_threads: int) -> None:
    assert side_by_side(lambda _: torch.is_grad_enabled(), range(4)) == [True] * 4
    with pytest.raises(ZeroDivisionError):
        side_by_side(lambda k: 1 // (k - 3), range(4))
