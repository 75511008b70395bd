"""The address of a Ray cluster as a user gives it, checked before anything is printed of it or asked."""

import os

from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import redact_uri


def host_and_port(address: str) -> tuple[str, int]:
    """The parts of `HOST:PORT`.

    Raises:
        BuildError: if it is something else, naming where it stands; a secret in it is not repeated.
    """
    named = named_by(address, "RAY_ADDRESS")
    refuse_secrets(address, named, "auto, or HOST:PORT of the head node")
    host, _, port = address.rpartition(":")
    if "://" in address or not host or not (port.isascii() and port.isdecimal()) or int(port) > 65535:
        raise BuildError(
            f"{named} {redact_uri(address)}: give auto, or HOST:PORT of the head node (the port is 6379 by default)"
        )
    return host, int(port)


def refuse_secrets(address: str, named: str, right: str) -> None:
    """Refuses user information and queries, without repeating them.

    Args:
        address: As it was given.
        named: Where it stands.
        right: What would be right.

    Raises:
        BuildError: if it holds any.
    """
    if any(sign in address for sign in "@?#"):
        raise BuildError(
            f"{named}: an address holds no user, password or query: give {right}; a cluster's token belongs into a "
            "file that RAY_AUTH_TOKEN_PATH names"
        )


def named_by(address: str, variable: str) -> str:
    """Where an address stands: in a variable of the environment, or in the option `--address`."""
    return variable if os.environ.get(variable) == address else "--address"
