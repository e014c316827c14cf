"""Errors a user can fix: one line that says what, where, what was found and what to do.

`eqrt.cli` prints them without a traceback. Programming errors stay `ValueError`/`TypeError`.
"""


class EqrtError(Exception):
    """Base of every error the user can fix; the command ends with `exit_code`."""

    exit_code = 1


class UsageError(EqrtError):
    """The command line asks for something that does not exist, or an extra is not installed."""

    exit_code = 2


class ConfigError(UsageError):
    """A configuration file cannot be used."""


class ContractError(EqrtError):
    """A model file does not keep the contract this version speaks."""


class TileError(EqrtError):
    """A map or tile file cannot be used."""


class ProfileError(EqrtError):
    """A sensor profile, or the DBC it names, cannot be used."""


class BusError(EqrtError):
    """A CAN channel cannot be opened or written."""


class AbsentBusError(BusError):
    """A CAN channel is not there, or down; it may still come."""


class AddressError(EqrtError):
    """A network address cannot be used now: taken, not up yet, or not to be found."""


class LogError(EqrtError):
    """A recorded log cannot be read."""


class RecordingError(EqrtError):
    """A recording cannot be written."""


def in_one_line(error: BaseException) -> str:
    """What an error says; libraries use several lines, quote what they read, or say nothing."""
    return " ".join(str(error).split()) or type(error).__name__
