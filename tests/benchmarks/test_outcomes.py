"""Jobs in processes of their own: what they return, and what becomes of one that dies."""

import os
from concurrent.futures.process import BrokenProcessPool

import pytest
from common import outcomes


def doubled(job):
    if job == 3:
        raise ValueError("three is one too many")
    if job == 7:
        os._exit(1)
    return 2 * job


def test_each_job_comes_with_its_outcome():
    assert dict(outcomes(doubled, [1, 2, 4, 5], 2)) == {1: 2, 2: 4, 4: 8, 5: 10}


def test_an_error_names_its_job():
    with pytest.raises(RuntimeError, match="3: three is one too many"):
        list(outcomes(doubled, [3], 1))


def test_a_worker_that_dies_is_not_waited_for():
    with pytest.raises(BrokenProcessPool):
        list(outcomes(doubled, [7, 1], 1))
