"""Exceptions of the package, all derived from `SlpiError`."""


class SlpiError(Exception):
    """Base class: the data or a document do not allow the request; the message states cause, location and remedy."""

    exit_code = 1


class UsageError(SlpiError):
    """The call is invalid: an unknown option value, axis or kind."""

    exit_code = 2


class RecordError(SlpiError):
    """A record cannot be read or lacks required data."""


class ModelError(SlpiError):
    """A model document cannot be read, has an unsupported version or belongs to another stage."""


class IdentificationError(SlpiError):
    """A model cannot be identified from the given record."""


class UnreachableError(SlpiError):
    """A desired displacement lies far outside the identified displacement range."""
