"""Documents of services over HTTP, and the keys of all requests.

Errors never quote messages of the HTTP library, because those contain whole addresses with keys.
"""

import json as json_format
import logging
import re
import time
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote
from xml.etree.ElementTree import Element, ParseError, fromstring

import requests

from orthonav import __version__
from orthonav.core.errors import FetchError
from orthonav.ground.fetch.urls import KEY, Secret, checked_url, origin_of, shown

USER_AGENT = f"orthonav/{__version__} (fetches orthophotos for one area; +orthonav fetch)"
TIMEOUTS_S = 10.0, 30.0  # to connect, and between two parts of an answer
MAX_DOCUMENT_BYTES = 64 * 2**20
"""The capabilities of a national service list a thousand layers in some ten megabytes."""
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RequestLimits:
    """How a service is asked: `attempts` for one address, with pauses that double."""

    parallel: int = 4
    attempts: int = 6
    backoff_s: float = 0.5
    backoff_max_s: float = 30.0

    def pause(self, attempt: int) -> None:
        """Wait before an attempt, counted from 0."""
        if attempt:
            time.sleep(min(self.backoff_s * 2.0 ** (attempt - 1), self.backoff_max_s))


class Web:
    """Requests documents, and inserts keys into addresses; a context manager."""

    def __init__(
        self, limits: RequestLimits | None = None, secrets: tuple[Secret, ...] = ()
    ) -> None:
        for library in ("urllib3", "rasterio"):  # what they log contains whole addresses
            logging.getLogger(library).setLevel(logging.CRITICAL)
        self.limits = limits or RequestLimits()
        self.secrets = list(secrets)
        self._session = requests.Session()
        self._session.headers["User-Agent"] = USER_AGENT
        self._session.auth = lambda request: request  # no passwords of ~/.netrc

    def __enter__(self) -> "Web":
        return self

    def __exit__(self, *exc: object) -> None:
        self._session.close()

    def with_keys(self, url: str) -> str:
        """The address as requested. Raises `FetchError` where a key would leave its origin."""
        for secret in self.secrets:
            if secret.placeholder in url and secret.origin == origin_of(url):
                value = quote(secret.value, safe="") if secret.placeholder == KEY else secret.value
                url = url.replace(secret.placeholder, value)
        if re.search(r"\{(key|token)\}", url):
            raise FetchError(f"the key is for another host: {shown(url)}")
        return url

    def redacted(self, text: str) -> str:
        """`text` with every key replaced by its placeholder."""
        for secret in self.secrets:
            for value in {secret.value, quote(secret.value, safe="")}:
                text = text.replace(value, secret.placeholder) if len(value) >= 4 else text
        return text

    def get_xml(self, url: str) -> Element:
        """An XML document, names without namespaces. Raises `FetchError`."""
        body = self.get(url)
        if b"<!ENTITY" in body or b"\0" in body:
            raise FetchError(f"document declares entities, which are not read: {shown(url)}")
        try:
            root = fromstring(body)
        except (ParseError, ValueError, LookupError):  # of an unknown encoding
            raise FetchError(f"not an XML document ({self._excerpt(body)}): {shown(url)}") from None
        if "Exception" in root.tag:
            raise FetchError(f"an error of the service ({self._excerpt(body)}): {shown(url)}")
        for element in root.iter():
            element.tag = str(element.tag).rpartition("}")[2]
            element.attrib = {key.rpartition("}")[2]: v for key, v in element.attrib.items()}
        return root

    def get_json(self, url: str, query: Any = None) -> dict[str, Any]:
        """A JSON object; `query` is sent with POST. Raises `FetchError`."""
        body = self.get(url, query)
        try:
            plain = json_format.loads(body)
        except (ValueError, RecursionError):
            raise FetchError(f"not JSON ({self._excerpt(body)}): {shown(url)}") from None
        if not isinstance(plain, dict):
            raise FetchError(f"not a JSON object: {shown(url)}")
        return plain

    def get(self, url: str, json: Any = None) -> bytes:
        """The body of an answer, at most `MAX_DOCUMENT_BYTES`; `json` is sent with POST.

        The request is repeated after a temporary status and a broken connection. Raises
        `FetchError`.
        """
        method, failure = "GET" if json is None else "POST", ""
        url_sent = self.with_keys(checked_url(url))
        for attempt in range(self.limits.attempts):
            self.limits.pause(attempt)
            try:
                with self._session.request(
                    method, url_sent, json=json, stream=True, timeout=TIMEOUTS_S
                ) as response:
                    status = response.status_code
                    if status != 200:
                        words = self._excerpt(next(response.iter_content(1200), b""))
                        failure = f"HTTP {status} ({words})"
                        if is_temporary(status):
                            continue
                        break
                    body = bytearray()
                    for part in response.iter_content(64 * 1024):
                        body += part
                        if len(body) > MAX_DOCUMENT_BYTES:
                            raise FetchError(
                                f"body is over {MAX_DOCUMENT_BYTES} bytes: {shown(url)}"
                            )
                    return bytes(body)
            except requests.RequestException as error:
                failure = f"no whole answer ({type(error).__name__})"
        raise FetchError(self.redacted(f"{failure}: {shown(url)}"))

    def _excerpt(self, body: bytes) -> str:
        text = body[:2000].decode("utf-8", errors="replace")
        if "\0" in text or 10 * text.count("\ufffd") > len(text):
            return f"{len(body)} bytes that are not text"
        words = re.sub(r"<[^>]*>", " ", text).split()
        return self.redacted("".join(c for c in " ".join(words) if c.isprintable())[:300])


def is_temporary(status: int) -> bool:
    """Whether the same request may succeed later (RFC 9110, 6585, 8470)."""
    return status >= 500 or status in (408, 425, 429)


def texts(element: Element, path: str) -> list[str]:
    """The texts of all elements at a path below `element`; empty ones are left out."""
    return [text for each in element.findall(path) if (text := (each.text or "").strip())]
