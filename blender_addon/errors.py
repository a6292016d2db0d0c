"""The one error that users of the extension are meant to read."""


class ReconstructionError(ValueError):
    """A reconstruction folder that cannot be used.

    The message names the file, the value found there and what to do about it. Operators report it; the command line
    prints it alone.
    """
