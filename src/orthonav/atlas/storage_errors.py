"""Errors of file systems as `StorageError` with the cause: unreachable, refused, full, missing."""

import errno
import re
from collections.abc import Iterator
from contextlib import contextmanager

from orthonav.errors import MissingExtraError, OrthonavError, StorageError

_CREDENTIALS = re.compile(
    "Credential|ClientAuthentication|NoAuthToken|ProfileNotFound|RefreshError"
    "|TokenRetrieval|UnauthorizedSSOToken"
)
"""In the names of exceptions of boto, Google and Azure: there are no valid credentials."""
_UNREACHABLE = re.compile(
    "Connect(or|ion)|Timeout|HTTPClientError|SSLError|ServiceRe(quest|sponse)Error|gaierror"
)
"""The same where the storage cannot be reached."""
_REFUSED = {401, 403}
_MAX_TEXT = 300


@contextmanager
def storage_errors(place: str, action: str) -> Iterator[None]:
    """Turn errors raised inside into `StorageError` with the cause.

    `place`: address to show to people, without a password. `action`: what was attempted, a verb and
    its object. Every exception is converted: the libraries behind fsspec raise many kinds.
    """
    try:
        yield
    except OrthonavError as error:
        if isinstance(error, StorageError | MissingExtraError):
            raise
        raise StorageError(str(error)) from error
    except Exception as error:
        raise StorageError(f"cannot {action}: {_cause(error)}: {place}") from error


def _cause(error: Exception) -> str:
    chain = list(_chain(error))
    names = {kind.__name__ for each in chain for kind in type(each).__mro__}
    text = " ".join(str(error).split())[:_MAX_TEXT] or type(error).__name__
    numbers = {each.errno for each in chain if isinstance(each, OSError)}
    if numbers & {errno.ENOSPC, errno.EDQUOT}:
        return "disk full; free some space"
    if any(map(_CREDENTIALS.search, names)):
        return f"no valid credentials ({text}); set those of the storage, see its documentation"
    if errno.EROFS in numbers:
        return "the file system is read-only"
    if "PermissionError" in names or any(_status(each) in _REFUSED for each in chain):
        return f"not permitted, or credentials refused ({text})"
    if any(isinstance(each, FileNotFoundError) for each in chain):
        return f"no such file, folder or bucket ({text})"
    if any(map(_UNREACHABLE.search, names)):
        return f"it cannot be reached ({text}); check the address and the network"
    return f"{type(error).__name__}: {text}"


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    for _ in range(10):
        if error is None:
            return
        yield error
        error = error.__cause__ or error.__context__


def _status(error: BaseException) -> int | None:
    """The HTTP status that an error of boto, Google or Azure carries."""
    response = getattr(error, "response", None)
    if isinstance(response, dict):
        status = response.get("ResponseMetadata", {}).get("HTTPStatusCode")
    else:
        status = getattr(error, "status_code", getattr(error, "code", None))
    return status if isinstance(status, int) else None
