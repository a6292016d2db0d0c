"""The one error that users are meant to read."""


class InputError(ValueError):
    """Input that cannot be used.

    The message names the file, the value found there and what to do about it. Command lines print it alone and
    leave with exit code 2; anything else that escapes is a defect of ours and keeps its traceback.
    """


class WorkerError(RuntimeError):
    """A process that worked for us died or failed for a reason that is not the input's.

    The message names what it was doing and ends with what it printed last. Command lines print it alone and leave with
    exit code 1.
    """
