"""One class per way a file can be wrong; `str(error)` is one sentence for a person, safe on a terminal.

A sentence names the file, the node or array, what was found, what was expected and what to do. `exit_code` is
what the command line ends with.
"""

import contextlib
from collections.abc import Iterable, Iterator

MAX_SENTENCE = 1000


def printable(text: str, limit: int = MAX_SENTENCE) -> str:
    """`text` with control, bidirectional and unpaired characters escaped, cut to `limit` characters.

    Names and paths come from hostile files, and an error must not move the reader's cursor.
    """
    start = text[: limit + 1]
    escaped = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in start)
    return escaped if len(escaped) <= limit else escaped[: limit - 1] + "…"


def counted(count: int, one: str, several: str) -> str:
    """A number with the words that go with it: 1 photo is, 2 photos are."""
    return f"{count:,} {one if count == 1 else several}"


def listed(names: Iterable[str], most: int = 4) -> str:
    """ "a, b and 3 more"."""
    names = list(dict.fromkeys(str(name)[:80] for name in names))
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


class FormatError(Exception):
    """A file that cannot be read, or an output that cannot be written."""

    exit_code = 3

    def __init__(self, sentence: str):
        super().__init__(printable(sentence))

    def within(self, where: str) -> "FormatError":
        """The same error, its sentence led by the file or node in which it arose."""
        return type(self)(f"{where}: {self}")


class FormatWarning(UserWarning):
    """The file was read, but something in it needs attention."""


# --- files --------------------------------------------------------------------------------------------------


class MissingFile(FormatError):
    """A file that was named does not exist."""


class NotAFile(FormatError):
    """A folder, pipe or device stands where a regular file was expected."""


class OutsideFolder(FormatError):
    """A source leads out of its scene's folder, which only `--allow-outside` permits."""


class LimitExceeded(FormatError):
    """A size or count is beyond what the format allows, so nothing was allocated for it."""


class OutputExists(FormatError):
    """The output is there already and `-w/--overwrite` was not given."""

    exit_code = 1


class ResourceError(FormatError):
    """The disk is full, the file system is read-only, or permission is missing."""

    exit_code = 5


@contextlib.contextmanager
def noted(notes: list[str], rest: str) -> Iterator[None]:
    """In this block what is wrong with a file becomes a note with the rest of its sentence, since one can do
    without the file; but for ResourceError."""
    try:
        yield
    except ResourceError:
        raise
    except FormatError as error:
        notes.append(f"{error}; {rest}")


# --- bundles ------------------------------------------------------------------------------------------------


class NotABundle(FormatError):
    """The file does not begin as an `.rfpack` does."""


class TruncatedBundle(FormatError):
    """The file ends before its end record, or goes on after it."""


class BadHeader(FormatError):
    """A ZIP or safetensors header does not match the bytes that it describes."""


class ChecksumMismatch(FormatError):
    """The bytes of a member are not the ones that were written."""


class UnknownMember(FormatError):
    """The bundle holds a member that the format does not know."""


class MissingMember(FormatError):
    """A node names a field that the bundle does not hold."""


class NewerVersion(FormatError):
    """The file needs a newer version of fusedrf."""

    exit_code = 4


class OlderVersion(FormatError):
    """The file was written by an earlier version, whose files of this kind are not read any more."""

    exit_code = 4


# --- fields -------------------------------------------------------------------------------------------------


class UnknownKind(FormatError):
    """No field kind of that name is installed."""


class BadArray(FormatError):
    """An array's name, type or shape cannot be stored, or does not fit its kind."""


class NotFinite(FormatError):
    """NaN or infinity among numbers, or a number too large for the precision it is stored in."""


# --- checkpoints of other systems ---------------------------------------------------------------------------


class BadCheckpoint(FormatError):
    """A checkpoint of another system that is damaged, or does not follow its format."""


class UnknownCheckpoint(FormatError):
    """What was given to import is no checkpoint of a system that is known."""


class NeedsCode(FormatError):
    """A checkpoint that could only be loaded by running code of its author's."""


# --- scenes -------------------------------------------------------------------------------------------------


class BadJson(FormatError):
    """Not strict JSON: syntax, encoding, duplicate keys, or values that are not JSON numbers."""


class BadSchema(FormatError):
    """JSON whose keys or types are not those of the format."""


class BadName(FormatError):
    """A node's name is empty, too long, or holds characters that do not print."""


class DuplicateName(FormatError):
    """Two nodes of one scene share a name."""


class SingularTransform(FormatError):
    """A transform cannot be inverted safely, or leaves the range of the format."""


class CyclicScene(FormatError):
    """A scene leads back to itself through its sources."""


# --- captures and pictures ----------------------------------------------------------------------------------


class NotACapture(FormatError):
    """What was given as a capture is another kind of file, or a folder without photos and poses."""


class NoPoses(FormatError):
    """Pictures, or a file, without the camera poses that say where they were taken from."""


class NoViews(FormatError):
    """A capture or a film without any view."""


class BadPose(FormatError):
    """A camera pose that is not a rigid motion."""


class PosingFailed(FormatError):
    """Structure from motion broke down."""

    exit_code = 1


class BadIntrinsics(FormatError):
    """A focal length, principal point, picture size or distortion that is missing or impossible."""


class UnsupportedCamera(FormatError):
    """A camera that is neither a pinhole nor a fisheye camera with OpenCV distortion."""


class BadModel(FormatError):
    """A file of cameras, poses or points that does not follow its format."""


class BadMask(FormatError):
    """A mask whose size differs from that of its photo."""


class MixedSizes(FormatError):
    """Two pictures that belong together differ in size."""


class BadImage(FormatError):
    """A picture that cannot be decoded, or a kind of picture that cannot be written."""


class BadMesh(FormatError):
    """A mesh that cannot be loaded, or that has no surface."""


class BadSplats(FormatError):
    """A file of Gaussian splats that does not follow its format, or that holds none."""


class MissingExtra(FormatError):
    """A library of an optional extra is not installed."""

    exit_code = 1
