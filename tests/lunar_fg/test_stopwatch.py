"""Stage times, one value a frame."""

import time

import numpy as np
import pytest

from lunar_fg.stopwatch import Stopwatch


def test_one_value_a_frame_and_nan_where_a_stage_did_not_run():
    watch = Stopwatch()
    for k in range(5):
        with watch.frame():
            if k in (1, 3):
                with watch.stage("rare"):
                    pass
            with watch.stage("each"):
                pass
    times = watch.milliseconds()
    assert {len(column) for column in times.values()} == {5}
    assert np.isnan(times["rare"]).tolist() == [True, False, True, False, True]
    assert np.isfinite(times["each"]).all()
    assert np.isfinite(times["total"]).all()


def test_calls_of_one_stage_in_one_frame_add_up():
    watch = Stopwatch()
    with watch.frame():
        for _ in range(3):
            with watch.stage("part"):
                time.sleep(0.002)
    times = watch.milliseconds()
    assert len(times["part"]) == 1
    assert times["part"][0] >= 6.0
    assert times["total"][0] >= times["part"][0]


def test_a_frame_that_fails_is_not_counted_and_the_error_goes_on():
    watch = Stopwatch()
    with watch.frame(), watch.stage("good"):
        pass
    with pytest.raises(KeyError), watch.frame(), watch.stage("good"), watch.stage("bad"):
        raise KeyError
    with watch.stage("between"):
        pass
    with watch.frame():
        pass
    times = watch.milliseconds()
    assert set(times) == {"total", "good"}
    assert np.isnan(times["good"]).tolist() == [False, True]
    assert np.isfinite(times["total"]).tolist() == [True, True]


def test_a_stage_that_fails_within_a_frame_that_goes_on_is_not_counted():
    watch = Stopwatch()
    with watch.frame():
        with pytest.raises(KeyError), watch.stage("bad"):
            raise KeyError
        with watch.stage("good"):
            pass
    assert set(watch.milliseconds()) == {"total", "good"}


def test_nothing_timed():
    assert Stopwatch().milliseconds() == {}


def test_what_it_gives_is_not_what_it_keeps():
    watch = Stopwatch()
    with watch.frame():
        pass
    watch.milliseconds()["total"].clear()
    assert len(watch.milliseconds()["total"]) == 1


def test_a_stage_outside_of_any_frame_is_no_crash():
    watch = Stopwatch()
    with watch.stage("set-up"):
        pass
    with watch.frame():
        pass
    assert list(watch.milliseconds()) == ["total"]


def test_any_clock_can_be_read():
    ticks = iter(range(100))
    watch = Stopwatch(lambda: float(next(ticks)))
    with watch.frame(), watch.stage("one"):
        pass
    assert watch.milliseconds() == {"one": [1000.0], "total": [3000.0]}
