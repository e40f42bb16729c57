"""Errors raised for broken input; each says what came, what was expected, and what to do.

All derive from `OrthonavError`, which the command line turns into one line and an exit code,
and from the builtin that fits, so that callers who know nothing of orthonav can still catch them.
A view that cannot be placed is not an error: see `orthonav.core.records.NoFix`."""


class OrthonavError(Exception):
    """Root of everything orthonav raises on purpose."""


class MissingFileError(OrthonavError, FileNotFoundError):
    """A file or folder that was named does not exist or cannot be read."""


class UsageError(OrthonavError, ValueError):
    """An impossible value was asked for, or values that do not fit together."""


class ArgumentError(OrthonavError, TypeError, ValueError):
    """An argument of another type, or a number out of range, was given to a function."""


class ImageryError(OrthonavError, ValueError):
    """An orthophoto cannot be used: no georeference, no valid pixels, unreadable, wrong bands."""


class AreaError(OrthonavError, ValueError):
    """The requested area is empty, too large, outside the imagery, or smaller than one tile."""


class RouteError(OrthonavError, ValueError):
    """A route file cannot be read as a route."""


class MapFileError(OrthonavError, ValueError):
    """A map file is not a map, is truncated, or was altered."""


class MapChangedError(MapFileError):
    """An open map file was truncated or rewritten in place, or cannot be read any more."""


class MapVersionError(MapFileError):
    """A map file was written for a newer schema than this program knows."""


class FlightError(OrthonavError, ValueError):
    """A flight folder, its telemetry, its ground truth or one of its images is broken."""


class CameraError(OrthonavError, ValueError):
    """Camera parameters are impossible or do not belong to the images."""


class StoppedError(CameraError):
    """The program was stopped while it waited for the calibration of a camera."""


class CheckError(OrthonavError, ValueError):
    """A check cannot be made: the heights of its route are not those above ground, or near 0."""


class WorkerError(OrthonavError, RuntimeError):
    """A process that was to do part of the work ended on its own: killed, or out of memory."""


class VariantError(UsageError):
    """An unknown method, representation or parameter was named, or its value is impossible."""


class OutputError(OrthonavError, OSError):
    """A result could not be written (disk full, no permission); nothing was left behind."""


class FetchError(OrthonavError, OSError):
    """Imagery could not be fetched: a service refused, lacks the layer or sent no image."""


class MissingExtraError(OrthonavError, ImportError):
    """An optional dependency is needed for this and is not installed."""


class AtlasError(OrthonavError, ValueError):
    """An atlas cannot be used: catalogue and files disagree, another recipe, or a damaged sheet."""


class StorageError(OrthonavError, OSError):
    """The place where an atlas lies cannot be reached, read or written: address, credentials."""


_LFS_STARTS = (
    b"version https://git-lfs.github.com/spec/",
    b"version https://hawser.github.com/spec/",
)


def lfs_pointer(head: bytes) -> str | None:
    """What is wrong with a file that begins like this, if it is a pointer of Git LFS."""
    if not head.startswith(_LFS_STARTS):
        return None
    return "is a Git LFS pointer, not the file itself; run `git lfs pull` in its repository"


def described(error: BaseException) -> str:
    """The error in at most 120 characters; a `KeyError` and some others do not say what it is."""
    if isinstance(error, KeyError) and len(error.args) == 1:
        return f"{str(error.args[0])[:120]} is missing"
    return " ".join(str(error).split())[:120] or type(error).__name__
