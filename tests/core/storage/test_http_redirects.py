"""Networks of addresses: what redirects and lists of addresses may lead into."""

import pytest

from tableverse_factory.core.storage.http_redirects import classify_address


@pytest.mark.parametrize(
    ("address", "network"),
    [
        ("93.184.215.14", "public"),
        ("2606:4700::1", "public"),
        ("10.1.2.3", "private"),
        ("fd00::1", "private"),
        ("fec0::1", "private"),
        ("127.0.0.1", "loopback"),
        ("::1", "loopback"),
        ("169.254.169.254", "link-local"),
        ("fe80::1%eth0", "link-local"),
        ("224.0.0.1", "special"),
        ("0.0.0.0", "special"),  # noqa: S104
        ("168.63.129.16", "special"),
        ("::ffff:10.0.0.1", "private"),
        ("2002:7f00:1::", "loopback"),
        ("64:ff9b::a9fe:a9fe", "link-local"),
        ("64:ff9b::5db8:d70e", "public"),
    ],
)
def test_addresses_are_classified_by_what_they_wrap(address: str, network: str) -> None:
    assert classify_address(address) == network
