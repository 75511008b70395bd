"""Requests to models: whom a client trusts."""

import ssl

import pytest

from tableverse_factory.models.remote.http import choose_authorities


@pytest.mark.parametrize("url", ["https://models.example/v1", "HTTPS://models.example/v1"])
def test_https_trusts_the_usual_authorities_however_it_is_spelled(url: str) -> None:
    assert choose_authorities(url) is True


def test_http_trusts_nobody() -> None:
    context = choose_authorities("http://127.0.0.1:8000")
    assert isinstance(context, ssl.SSLContext)
    assert context.verify_mode == ssl.CERT_REQUIRED
    assert context.cert_store_stats()["x509_ca"] == 0
