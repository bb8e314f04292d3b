import time

from stillmap.core.profiling import StageTimer


def busy(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


def test_calls_of_a_stage_add_up_and_sleep_takes_no_processor_time():
    stages = StageTimer()
    for _ in range(2):
        with stages.measure("work"):
            busy(0.05)
    with stages.measure("sleep"):
        time.sleep(0.1)
    measured = stages.to_dict()
    assert list(measured) == ["work", "sleep"]
    assert measured["work"]["cpu_seconds"] >= 0.1
    assert measured["work"]["seconds"] >= 0.09  # clocks differ
    assert measured["sleep"]["seconds"] >= 0.1
    assert measured["sleep"]["cpu_seconds"] < 0.09
