"""The pool runs everything or says what went wrong, and lets go at once."""

import threading
import time
from concurrent.futures import CancelledError
from functools import partial

import pytest

from solidgrain.runtime.workers import Workers


def test_every_task_runs_once():
    done = []
    Workers(3).run([partial(done.append, k) for k in range(100)])
    assert sorted(done) == list(range(100))
    Workers(3).run([])


def test_no_more_threads_than_asked_for_run_at_a_time():
    workers, running, most = Workers(2), set(), []

    def task() -> None:
        running.add(threading.get_ident())
        most.append(len(running))
        time.sleep(0.005)
        running.discard(threading.get_ident())

    callers = [threading.Thread(target=workers.run, args=([task] * 20,)) for _ in range(3)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert max(most) == 2


def test_the_first_error_stops_what_has_not_begun():
    done = []

    def fail() -> None:
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        Workers(1).run([fail, *[partial(done.append, k) for k in range(1000)]])
    assert not done


def test_whoever_waits_is_let_go_by_a_cancel_from_another_thread():
    workers, found = Workers(1), []

    def wait() -> None:
        try:
            workers.run([partial(time.sleep, 0.05)] * 200)
        except CancelledError as error:
            found.append(error)

    waiting = threading.Thread(target=wait)
    waiting.start()
    time.sleep(0.1)
    workers.cancel()
    waiting.join(2)
    assert found
    with pytest.raises(CancelledError):
        workers.run([lambda: None])


def test_a_cancel_is_for_those_who_share_the_threads_alone():
    workers, done = Workers(2), []
    workers.share().cancel()
    workers.run([partial(done.append, 1)])
    assert done == [1]
