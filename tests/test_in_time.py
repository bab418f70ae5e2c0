import threading

import pytest

from lerobot_latentsafe.runtime.time_limit import in_time


def failing(error):
    raise error


def test_an_answer_is_what_the_call_returned():
    assert in_time(lambda: None, 60.0, "asking") is None and in_time(lambda: 3, 60.0, "asking") == 3


def test_a_late_call_is_not_waited_for():
    late = threading.Event()
    with pytest.raises(TimeoutError, match=r"asking did not end within 0.01 s"):
        in_time(lambda: late.wait(60.0), 0.01, "asking")
    late.set()


@pytest.mark.parametrize(("error", "raised"), [(KeyError("x"), KeyError), (SystemExit(0), RuntimeError)])
def test_what_it_raises_is_raised_and_ends_no_program(error, raised):
    with pytest.raises(raised):
        in_time(lambda: failing(error), 60.0, "asking")
