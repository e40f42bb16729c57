"""Memory that is used again."""

import threading

from orthonav.core.register.window import thread_memory


def test_the_same_memory_comes_back():
    first = thread_memory("one", 100)
    first[:] = 7
    assert (thread_memory("one", 60) == 7).all() and thread_memory("one", 60).size == 60
    assert thread_memory("two", 100) is not first


def test_names_and_threads_share_nothing():
    mine = thread_memory("shared", 10)
    mine[:] = 1
    thread_memory("other", 10)[:] = 2

    def theirs():
        thread_memory("shared", 10)[:] = 3

    thread = threading.Thread(target=theirs)
    thread.start()
    thread.join()
    assert (mine == 1).all()


def test_more_is_made_when_more_is_asked():
    thread_memory("grows", 4)
    assert thread_memory("grows", 4000).size == 4000
