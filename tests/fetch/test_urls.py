"""Addresses: only http and https, keys taken out, parameters put in."""

import pytest

from orthonav.core.errors import FetchError
from orthonav.ground.fetch import urls


@pytest.mark.parametrize(
    "url",
    [
        "file:///a",
        "gopher://a/b",
        "//a/b",
        "a/b",
        "http://",
        "http://a:99999/",
        "http://a b/",
        "https://a/\n",
        "https://user:pw@a/",
        "http://user@a/",
        "https://a/" + "x" * 5000,
        "http://[a",
    ],
)
def test_invalid_addresses_are_rejected(url):
    with pytest.raises(FetchError):
        urls.checked_url(url)


def test_errors_show_no_password():
    with pytest.raises(FetchError) as raised:
        urls.checked_url("https://me:hunter2@a.example/x")
    assert "hunter2" not in str(raised.value)


@pytest.mark.parametrize(
    "url, plain, key",
    [
        ("https://a/x?token=abcd", "https://a/x?token={key}", "abcd"),
        ("https://a/x?Layer=1&ApiKey=abcd&z=2", "https://a/x?Layer=1&ApiKey={key}&z=2", "abcd"),
        ("https://a/x?token={key}", "https://a/x?token={key}", None),
        ("https://a/{z}/{x}/{y}?key=abcd", "https://a/{z}/{x}/{y}?key={key}", "abcd"),
        ("https://a/x?layer=key", "https://a/x?layer=key", None),
        ("https://a/x?token=", "https://a/x?token=", None),
    ],
)
def test_keys_in_an_address_are_extracted(url, plain, key):
    assert urls.without_literal_keys(url) == (plain, key)


def test_shown_addresses_hold_no_keys():
    shown = urls.shown("https://me:pw@a.example:8080/x?layer=a&subscription-key=abcd&sig=1234#part")
    assert shown == "https://a.example:8080/x?layer=a&subscription-key={key}&sig={key}"


def test_parameters_replace_those_of_the_same_name():
    url = "https://a/wms?map=/x/y&service=WFS&token={key}"
    found = urls.with_query(url, {"SERVICE": "WMS", "BBOX": "1,2,3,4"})
    assert found == "https://a/wms?map=/x/y&token={key}&SERVICE=WMS&BBOX=1,2,3,4"


def test_a_key_goes_along_on_its_own_server_only():
    base = "https://a.example/caps?token={key}"
    assert urls.linked(base, "https://a.example/map?x=1") == (
        "https://a.example/map?x=1&token={key}"
    )
    for other in ("https://b.example/map", "https://a.example:444/map"):
        assert urls.linked(base, other) == other


def test_references_stay_on_https_of_the_same_server():
    assert urls.linked("https://a/caps", "http://a:443/map") == "https://a:443/map"
    assert urls.linked("https://a/caps", "http://b/map") == "http://b/map"
    assert urls.linked("https://a/b/caps.xml", "../tiles/{x}") == "https://a/tiles/{x}"
    with pytest.raises(FetchError, match="not an address"):
        urls.linked("https://a/caps", "http://[::1/map")
