"""What file systems raise, said in words: unreachable, refused, full, not there, not installed."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager

from orthonav.errors import MissingExtraError, OrthonavError, StorageError

PACKAGES = {
    "s3": "s3fs",
    "s3a": "s3fs",
    "gs": "gcsfs",
    "gcs": "gcsfs",
    "abfs": "adlfs",
    "abfss": "adlfs",
    "az": "adlfs",
    "adl": "adlfs",
    "oci": "ocifs",
    "oss": "ossfs",
    "sftp": "paramiko",
    "ssh": "paramiko",
    "smb": "smbprotocol",
    "webdav": "webdav4",
}
"""What to install for a protocol of fsspec."""
_CREDENTIALS = {
    "ClientAuthenticationError",
    "CredentialRetrievalError",
    "CredentialUnavailableError",
    "DefaultCredentialsError",
    "NoAuthTokenError",
    "NoCredentialsError",
    "PartialCredentialsError",
    "ProfileNotFound",
    "RefreshError",
    "TokenRetrievalError",
    "UnauthorizedSSOTokenError",
}
_UNREACHABLE = {
    "ClientConnectorError",
    "ClientConnectionError",
    "ConnectTimeoutError",
    "ConnectionClosedError",
    "EndpointConnectionError",
    "FSTimeoutError",
    "HTTPClientError",
    "ProxyConnectionError",
    "ReadTimeoutError",
    "SSLError",
    "ServerTimeoutError",
    "ServiceRequestError",
    "ServiceResponseError",
    "gaierror",
}
_REFUSED_ANSWERS = {401, 403}
_MAX_SAID = 300


@contextmanager
def told(place: str, doing: str) -> Iterator[None]:
    """Errors inside become `StorageError` that names `place` (shown to people) and what was done.

    The libraries behind raise what they like, so everything is taken that is not ours already.
    """
    try:
        yield
    except OrthonavError as error:
        if isinstance(error, StorageError | MissingExtraError):
            raise
        raise StorageError(str(error)) from error
    except Exception as error:
        raise StorageError(f"cannot {doing}: {_words(error)}: {place}") from error


def _words(error: Exception) -> str:
    chain = list(_chain(error))
    names = {kind.__name__ for each in chain for kind in type(each).__mro__}
    said = " ".join(str(error).split())[:_MAX_SAID] or type(error).__name__
    numbers = {each.errno for each in chain if isinstance(each, OSError)}
    if numbers & {errno.ENOSPC, errno.EDQUOT}:
        return "disk full; free some of it"
    if names & _CREDENTIALS:
        return f"no credentials that are accepted ({said}); give those of the storage, see its docs"
    if errno.EROFS in numbers:
        return "it can only be read there"
    if "PermissionError" in names or any(_answer(each) in _REFUSED_ANSWERS for each in chain):
        return f"not permitted, or credentials refused ({said})"
    if any(isinstance(each, FileNotFoundError) for each in chain):
        return f"there is no such file, folder or bucket ({said})"
    if names & _UNREACHABLE or any(
        isinstance(each, ConnectionError | TimeoutError) for each in chain
    ):
        return f"it cannot be reached ({said}); is the address right, is there a network?"
    return f"{type(error).__name__}: {said}"


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    for _ in range(10):
        if error is None:
            return
        yield error
        error = error.__cause__ or error.__context__


def _answer(error: BaseException) -> int | None:
    """The HTTP status that an error of boto, Google or Azure carries."""
    response = getattr(error, "response", None)
    if isinstance(response, dict):
        status = response.get("ResponseMetadata", {}).get("HTTPStatusCode")
    else:
        status = getattr(error, "status_code", getattr(error, "code", None))
    return status if isinstance(status, int) else None
