"""Ending with the program that started this one, however that ends."""

import _thread
import contextlib
import os
import signal
import threading
import time

GRACE_SECONDS = 10.0
EXIT_INTERRUPTED = 130
STANDARD_INPUT = 0


def end_with_input() -> None:
    """Interrupt this process, as Ctrl-C does, when its standard input ends, which it does with its parent too.

    What cannot be interrupted within ``GRACE_SECONDS``, such as a kernel that is being compiled, is cut off: files are
    whole or absent at any moment, and processes that this one started see the end of their own input.

    The input is kept from those processes: they find theirs empty. On Windows a process that shared a pipe with a
    thread which waits for it would wait as well, before its first line runs.
    """
    watched = None
    with contextlib.suppress(OSError):  # there is no input: it has ended
        watched = os.dup(STANDARD_INPUT)  # which is not inherited
        with open(os.devnull, "rb") as nothing:
            os.dup2(nothing.fileno(), STANDARD_INPUT)
    threading.Thread(target=_wait_for_end, args=(watched,), name="end with input", daemon=True).start()


def _wait_for_end(watched: int | None) -> None:
    # Past Python's own buffer, whose lock a thread must not hold while the interpreter ends.
    with contextlib.suppress(OSError):
        while watched is not None and os.read(watched, 4096):
            pass
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, signal.SIGINT)  # to that very thread, or it would go on waiting for a lock
    else:
        _thread.interrupt_main()
    time.sleep(GRACE_SECONDS)
    os._exit(EXIT_INTERRUPTED)
