"""Ordered parallel map."""

import pytest
import scipy.linalg  # noqa: F401  (its BLAS is loaded before threads are counted)
from threadpoolctl import threadpool_info, threadpool_limits

from stillmap.core.parallel import limit_blas_threads, map_ordered, work_beside


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_outcomes_keep_the_order_of_the_items(threads):
    assert list(map_ordered(lambda i: i * i, range(100), threads)) == [i * i for i in range(100)]
    assert list(map_ordered(str, [], threads)) == []


@pytest.mark.parametrize("threads", [1, 2])
def test_errors_of_work_beside_are_raised_where_it_is_asked_for(threads):
    with work_beside(lambda: 1 // 0, threads) as done, pytest.raises(ZeroDivisionError):
        done()


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_items_are_asked_for_when_they_are_due(threads):
    asked = []

    def items():
        for i in range(100):
            asked.append(i)
            yield i

    outcomes = map_ordered(lambda i: i, items(), threads)
    assert next(outcomes) == 0
    assert len(asked) <= threads + 1


def blas_threads():
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


def test_linear_algebra_is_done_by_one_thread_meanwhile():
    with threadpool_limits(2, "blas"):
        if blas_threads() != {2}:
            pytest.skip("this BLAS has one thread only")
        with limit_blas_threads():
            assert blas_threads() == {1}
        assert blas_threads() == {2}
