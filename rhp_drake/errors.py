"""The one error for bad input, which the command line turns into exit status 2."""


class InputError(ValueError):
    """A user gave something that cannot work.

    The message is one clear sentence that says what is wrong and where.
    """
