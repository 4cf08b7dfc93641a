"""Errors that are not about the content of a file; those are in `formats.errors`.

`str(error)` is the one sentence a person reads; `exit_code` is what the process returns.
"""


class FusedRFError(Exception):
    """Any failure a person can act on. `report`, if given, is still printed before the sentence."""

    exit_code = 1

    def __init__(self, sentence: str, *, report: dict | None = None):
        super().__init__(sentence)
        self.report = report


class UsageProblem(FusedRFError):
    """Options that cannot be combined."""

    exit_code = 2


class InvalidInput(FusedRFError):
    """An input that is missing, or is not what the command takes."""

    exit_code = 3


class ResourceProblem(FusedRFError):
    """Disk, memory, permission or device."""

    exit_code = 5


class NumericFailure(FusedRFError):
    """An optimisation that diverged."""

    exit_code = 6


class QualityNotReached(FusedRFError):
    """The requested quality (`--target-psnr`) was not reached."""

    exit_code = 7


class Interrupted(KeyboardInterrupt):
    """SIGINT or SIGTERM, raised in the main thread.

    A KeyboardInterrupt, so that no `except Exception` swallows it on its way. Code that left
    a checkpoint may set `sentence` to say so and raise it again.
    """

    def __init__(self, signal_number: int = 2):
        super().__init__(signal_number)
        self.exit_code = 128 + signal_number
        self.sentence: str | None = None

    def __str__(self) -> str:
        return self.sentence or "interrupted"
