"""The package's exceptions: one root, so that a caller can catch everything we raise on purpose."""


class SlpiError(Exception):
    """The data or a document do not allow what was asked; the message says what, where and what to do."""

    exit_code = 1


class UsageError(SlpiError):
    """The call itself is wrong: an unknown option value, axis or kind."""

    exit_code = 2


class RecordError(SlpiError):
    """A recording cannot be read or does not hold what is needed."""


class ModelError(SlpiError):
    """A model document cannot be read, has the wrong version or does not fit the stage."""


class IdentificationError(SlpiError):
    """A model cannot be identified from the given record."""


class UnreachableError(SlpiError):
    """A desired displacement lies far outside what the model was identified on."""
