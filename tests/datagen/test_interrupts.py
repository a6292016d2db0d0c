import signal

import pytest

from datagen.interrupts import interrupts_held


def test_an_interrupt_waits_for_the_end_of_the_block_and_is_not_lost_to_who_catches_all():
    done = []

    def work():
        try:
            signal.raise_signal(signal.SIGINT)
            done.append("went on")
        except BaseException:
            done.append("swallowed")

    with pytest.raises(KeyboardInterrupt), interrupts_held():
        work()
    assert done == ["went on"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with interrupts_held():
        pass


def test_who_ignores_interrupts_goes_on_to():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with interrupts_held():
            signal.raise_signal(signal.SIGINT)
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
