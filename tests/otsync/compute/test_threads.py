"""BLAS on one thread within, where matrices are small, and as before behind."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from threadpoolctl import threadpool_limits

from otsync.compute.threads import _blas, blas_for


def blas_threads() -> set[int]:
    """Of numpy's and scipy's libraries: a test before this one may have loaded torch's."""
    return {library.get_num_threads() for library in _blas()}


@pytest.fixture
def two():
    with threadpool_limits(2, "blas"):
        if blas_threads() != {2}:
            pytest.skip("BLAS without threads")
        yield


def test_what_was_set_comes_back_with_the_last_one_inside(two):
    with blas_for(200):
        with blas_for(200):
            assert blas_threads() == {1}
        assert blas_threads() == {1}
    assert blas_threads() == {2}


def test_an_error_brings_it_back_too(two):
    with pytest.raises(KeyError), blas_for(200):
        raise KeyError
    assert blas_threads() == {2}


def test_large_matrices_keep_their_threads(two):
    with blas_for(5000):
        assert blas_threads() == {2}


@pytest.mark.parametrize("order", ["begins and ends last", "begins first"])
def test_threads_that_overlap_leave_nothing_behind(two, order):
    entered, leave = threading.Event(), threading.Event()

    def other():
        with blas_for(200):
            entered.set()
            leave.wait(10)

    helper = threading.Thread(target=other)
    if order == "begins first":
        helper.start()
        assert entered.wait(10)
        with blas_for(200):
            assert blas_threads() == {1}
        leave.set()
        helper.join()
    else:
        with blas_for(200):
            helper.start()
            assert entered.wait(10)
            assert blas_threads() == {1}
        leave.set()
        helper.join()
    assert blas_threads() == {2}
    with blas_for(200):
        assert blas_threads() == {1}
    assert blas_threads() == {2}


def test_a_pool_leaves_nothing_behind(two):
    def work(_: int) -> None:
        with blas_for(200):
            time.sleep(0.001)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(40)))
    assert blas_threads() == {2}
