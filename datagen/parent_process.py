"""Ending with the program that started this one, however that ends."""

import _thread
import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable

import psutil

GRACE_SECONDS = 10.0
EXIT_INTERRUPTED = 130
STANDARD_INPUT = 0
LOOK_SECONDS = 0.2
"""How often a process looks whether its parent lives."""


def end_with_input() -> None:
    """Interrupt this process, as Ctrl-C does, when its standard input ends, which it does with its parent too.

    What cannot be interrupted within ``GRACE_SECONDS``, such as a kernel that is being compiled, is cut off: files are
    whole or absent at any moment, and processes that this one started see the end of their own input.

    The input is kept from those processes: they find theirs empty. On Windows a process that shared a pipe with a
    thread which waits for it would wait as well, before its first line runs.

    Call it in the main thread.
    """
    # A shell that starts a program in the background has it ignore interrupts, and so does all that the program starts.
    signal.signal(signal.SIGINT, signal.default_int_handler)
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


def end_with_parent(in_order: Callable[[], None]) -> None:
    """End this process soon after its parent's death, whatever it is at; ``in_order`` is called before, in a thread.

    For a main thread that does not read its input for long, as while it renders a frame. A thread that read it instead
    would hold up, on Windows, what only looks at it, as libraries do when they are loaded.
    """
    parent = psutil.Process().parent()
    if parent is not None:
        threading.Thread(target=_end_after, args=(parent, in_order), name="end with parent", daemon=True).start()


def _end_after(parent: psutil.Process, in_order: Callable[[], None]) -> None:
    # On Windows the number of a dead parent stays, elsewhere a dead parent may be a zombie, which psutil calls running.
    while os.getppid() == parent.pid and parent.is_running():
        time.sleep(LOOK_SECONDS)
    try:
        in_order()
    finally:
        os._exit(EXIT_INTERRUPTED)
