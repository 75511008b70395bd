"""Checks of the address of a Ray cluster, before any part of it is printed or used."""

import os

from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import redact_uri


def parse_host_port(address: str) -> tuple[str, int]:
    """Parse `HOST:PORT`."""
    source = name_address_source(address, "RAY_ADDRESS")
    reject_secrets(address, source, "auto, or HOST:PORT of the head node")
    host, _, port = address.rpartition(":")
    if "://" in address or not host or not (port.isascii() and port.isdecimal()) or int(port) > 65535:
        raise BuildError(
            f"{source} {redact_uri(address)}: give auto, or HOST:PORT of the head node (the port is 6379 by default)"
        )
    return host.removeprefix("[").removesuffix("]"), int(port)  # brackets are those of IPv6


def reject_secrets(address: str, source: str, expected: str) -> None:
    """Reject user information and queries, without repeating them; `source` names the option or variable."""
    if any(sign in address for sign in "@?#"):
        raise BuildError(
            f"{source}: an address holds no user, password or query: give {expected}; a cluster's token belongs into a "
            "file that RAY_AUTH_TOKEN_PATH names"
        )


def name_address_source(address: str, variable: str) -> str:
    """Name the source of an address: the environment variable, or the option `--address`."""
    return variable if os.environ.get(variable) == address else "--address"
