"""The errors that the command line turns into one sentence and an exit status."""


class InputError(ValueError):
    """A user gave something that cannot work: exit status 2.

    The message is one clear sentence that says what is wrong and where.
    """


class WorkError(RuntimeError):
    """Work cannot go on, by no fault of what it was given: exit status 1.

    A full disk, a killed worker, a lost cluster.  The message is one sentence; what is
    in files by then stays.
    """
