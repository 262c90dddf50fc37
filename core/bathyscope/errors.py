"""The errors that callers can catch.

::

    BathyscopeError
    ├── ClipError         a video, image folder or frame that cannot be used
    ├── BundleError       a model bundle that is missing, damaged or not of this format
    ├── CheckpointError   a training checkpoint that cannot be read or does not fit
    ├── DatasetError      a data set folder that is not in the expected layout
    ├── TrainingError     a training run that cannot go on
    ├── GeometryError     arrays whose shape or values break a geometric contract
    ├── SettingsError     settings that contradict each other or are out of range
    ├── ResultError       a result file that is damaged or of another format
    └── ServiceError      a depth service that refused or failed; has ``status`` and ``request_id``

A message says what was found, what was needed and, where there is one, the next step.
"""


class BathyscopeError(Exception):
    """Base of every error that Bathyscope raises on purpose."""


class ClipError(BathyscopeError):
    """A video, image folder or frame that cannot be used."""


class BundleError(BathyscopeError):
    """A model bundle that is missing, damaged or of another format."""


class CheckpointError(BathyscopeError):
    """A training checkpoint that cannot be read or does not fit the network."""


class DatasetError(BathyscopeError):
    """A data set folder that is not in the expected layout."""


class TrainingError(BathyscopeError):
    """A training run that cannot go on: numbers that are not finite, collapsing depth, files that cannot be written."""


class GeometryError(BathyscopeError):
    """Arrays whose shape or values break a geometric contract."""


class SettingsError(BathyscopeError):
    """Settings that contradict each other or are out of range."""


class ResultError(BathyscopeError):
    """A result file that is damaged or of another format."""


class ServiceError(BathyscopeError):
    """A depth service that refused a request, failed, or cannot be reached.

    Attributes:
        status: HTTP status, or ``None`` when no answer came.
        request_id: The service's name for the request, for its log; ``None`` when no answer came.
    """

    def __init__(self, message: str, *, status: int | None = None, request_id: str | None = None) -> None:
        super().__init__(message)
        self.status = status
        self.request_id = request_id
