"""Addresses of services: only http and https, and never with a key where stored or shown.

An address holds `{key}` in place of a key, until it is requested from the origin of the key.
"""

import re
from dataclasses import dataclass
from urllib.parse import parse_qsl, quote, urlencode, urljoin, urlsplit, urlunsplit

from orthonav.core.errors import FetchError

KEY = "{key}"
TOKEN = "{token}"  # placeholder of a query string that a signing service issued for a file server
MAX_URL = 4096  # characters: half of what servers accept by default (8 KB of header)
_SECRET_NAME = re.compile(
    r"^(api[-_]?key|key|token|access[-_]?token|apikey|auth|authkey|password|pwd|sig|signature"
    r"|subscription-key|ocp-apim-subscription-key)$",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Secret:
    """The value of `placeholder` in addresses of `origin` (scheme, host and port).

    `repr` leaves `value` out, so that no traceback shows it.
    """

    placeholder: str
    origin: str
    value: str

    def __repr__(self) -> str:
        return f"Secret({self.placeholder} of {self.origin})"


def checked_url(url: str) -> str:
    """`url`, if it is an http or https address without a user name.

    Raises `FetchError`.
    """
    try:
        parts = urlsplit(url)
        is_http = parts.scheme.lower() in ("http", "https") and parts.port != 0
    except ValueError as error:
        raise FetchError(f"invalid address: {shown(url)}") from error
    is_plain = len(url) <= MAX_URL and re.search(r"[\x00-\x20\x7f]", url) is None
    if not (is_http and parts.hostname and is_plain):
        raise FetchError(f"only http:// and https:// addresses are fetched, got: {shown(url)}")
    if parts.username is not None or parts.password is not None:
        raise FetchError(
            "an address must not contain a user name or password; write the key as {key} and give "
            f"it with --key-env: {parts.scheme}://{parts.hostname}"
        )
    return url


def origin_of(url: str) -> str:
    """Scheme, host and port of an address: where a key may be sent."""
    parts = urlsplit(url)
    scheme = parts.scheme.lower()
    port = parts.port or (443 if scheme == "https" else 80)
    return f"{scheme}://{(parts.hostname or '').lower()}:{port}"


def holds_key(url: str) -> bool:
    """Whether a value in the query looks like a key, by the name of its parameter."""
    query = parse_qsl(urlsplit(url).query)
    return any(_SECRET_NAME.match(name) and "{" not in value for name, value in query)


def shown(url: str) -> str:
    """The address for messages and tags, without user names and values that look like keys."""
    try:
        parts = urlsplit(url)
    except ValueError:
        return url.partition("?")[0][:200]
    host = parts.netloc.rpartition("@")[2]
    query = [
        (name, KEY if _SECRET_NAME.match(name) and "{" not in value else value)
        for name, value in parse_qsl(parts.query, keep_blank_values=True)
    ]
    return urlunsplit((parts.scheme, host, parts.path, _encoded(query), ""))[:500]


def with_query(url: str, parameters: dict[str, str]) -> str:
    """The address with these query parameters, which replace those of the same name in any case."""
    parts = urlsplit(url)
    names = {name.lower() for name in parameters}
    others = [
        (name, value)
        for name, value in parse_qsl(parts.query, keep_blank_values=True)
        if name.lower() not in names
    ]
    return urlunsplit(parts._replace(query=_encoded([*others, *parameters.items()]), fragment=""))


def linked(base: str, reference: str) -> str:
    """A reference in the document at `base` as an absolute address.

    It has https and the key parameter where `base` has them and is on the same server: documents
    of services behind a proxy often refer to themselves with `http://`.
    """
    try:
        url = urljoin(base, reference.strip())
    except ValueError as error:
        raise FetchError(f"not an address ({error}): {reference!r:.200}") from error
    if base.startswith("https://") and url.startswith("http://"):
        secure = "https://" + url[len("http://") :].replace(":80/", ":443/", 1)
        if urlsplit(secure).hostname == urlsplit(base).hostname:
            url = secure
    if KEY in base and KEY not in url and origin_of(base) == origin_of(url):
        names = [name for name, value in parse_qsl(urlsplit(base).query) if value == KEY]
        url = with_query(url, dict.fromkeys(names, KEY))
    return url


def _encoded(query: list[tuple[str, str]]) -> str:
    return urlencode(query, safe="{}:/,", quote_via=quote)
