"""Addresses: only http and https, keys taken out, parameters put in."""

import pytest

from orthonav.core.errors import FetchError
from orthonav.ground.fetch import urls

INVALID = ["file:///a", "gopher://a/b", "//a/b", "a/b", "http://", "http://a:99999/", "http://[a"]
INVALID += ["https://a/\n", "https://user:pw@a/", "http://user@a/", "https://a/" + "x" * 5000]


@pytest.mark.parametrize("url", INVALID)
def test_invalid_addresses_are_rejected(url):
    with pytest.raises(FetchError):
        urls.checked_url(url)


def test_shown_addresses_hold_no_keys():
    shown = urls.shown("https://me:pw@a.example:8080/x?layer=a&subscription-key=abcd&sig=1234#part")
    assert shown == "https://a.example:8080/x?layer=a&subscription-key={key}&sig={key}"
    with pytest.raises(FetchError, match=r"https://a\.example$"):
        urls.checked_url("https://me:hunter2@a.example/x")


def test_parameters_replace_those_of_the_same_name():
    url = "https://a/wms?map=/x/y&service=WFS&token={key}"
    found = urls.with_query(url, {"SERVICE": "WMS", "BBOX": "1,2,3,4"})
    assert found == "https://a/wms?map=/x/y&token={key}&SERVICE=WMS&BBOX=1,2,3,4"


KEYED = "https://a.example/caps?token={key}"


@pytest.mark.parametrize(
    "base, reference, url",
    [
        (KEYED, "https://a.example/map?x=1", "https://a.example/map?x=1&token={key}"),
        (KEYED, "https://b.example/map", "https://b.example/map"),
        (KEYED, "https://a.example:444/map", "https://a.example:444/map"),
        ("https://a/caps", "http://a:443/map", "https://a:443/map"),
        ("https://a/caps", "http://b/map", "http://b/map"),
        ("https://a/b/caps.xml", "../tiles/{x}", "https://a/tiles/{x}"),
    ],
)
def test_a_key_and_https_stay_on_their_own_server(base, reference, url):
    assert urls.linked(base, reference) == url
