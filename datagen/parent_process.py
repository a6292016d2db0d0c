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
    """
    threading.Thread(target=_wait_for_end, name="end with input", daemon=True).start()


def _wait_for_end() -> None:
    # Past Python's own buffer, whose lock a thread must not hold while the interpreter ends.
    with contextlib.suppress(OSError):
        while os.read(STANDARD_INPUT, 4096):
            pass
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, signal.SIGINT)  # to that very thread, or it would go on waiting for a lock
    else:
        _thread.interrupt_main()
    time.sleep(GRACE_SECONDS)
    os._exit(EXIT_INTERRUPTED)
