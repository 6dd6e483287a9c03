"""One small tree of exceptions. Every message is one line: what came, what was needed, what to do."""


class FringescopeError(Exception):
    """Base of everything that this package raises on purpose."""


class UsageError(FringescopeError):
    """The call itself is wrong: an option, a name or a combination that cannot mean anything (exit status 2)."""


class FormatError(FringescopeError):
    """A file is not what its name or its `format` key promises, is truncated, or has a higher version."""


class CaptureError(FringescopeError):
    """The frames of a capture do not fit its plan: missing, of another size, of another bit depth, too few steps."""


class RigError(FringescopeError):
    """A rig that cannot be used: lacks a camera, has a singular K, a pose that is no rotation, NaN."""


class DecodeError(FringescopeError):
    """The sets of a view cannot be decoded to an absolute phase."""


class CalibrationError(FringescopeError):
    """Board pictures that do not make a rig: no board, too few or too similar poses, another board than described."""


class GuidanceError(FringescopeError):
    """A guideline that cannot be shown as it was asked for: what is wrong with it."""


class RegistrationError(FringescopeError):
    """Two surfaces that cannot be laid on each other: other specimens, bent, moved too far, other instruments."""


class EmptyResultError(FringescopeError):
    """Nothing was left to return, for a reason that the message states."""


class OutputError(FringescopeError):
    """A result cannot be written: the folder exists, is not writable, or the disk is full."""


class ResourceError(FringescopeError):
    """The machine has too little memory for a job, which is refused before it begins; the message has the figures."""


class DeviceError(FringescopeError):
    """Base of what devices raise."""


class DeviceLostError(DeviceError):
    """The device no longer answers."""


class DeviceTimeoutError(DeviceError):
    """The device did not answer, or a frame did not arrive, in the time it had."""


class RejectedError(DeviceError):
    """The device, or its driver, refuses a command or a setting; the message says which and why."""


class IncompleteShotError(DeviceError):
    """A shot ended with frames missing, doubled or out of order; the message names them."""
