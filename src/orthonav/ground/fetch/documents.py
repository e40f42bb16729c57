"""XML and JSON documents of services, parsed with limits."""

import json
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from orthonav.core.errors import FetchError
from orthonav.ground.fetch.client import BadReplyError, Client, HttpReply, bad_status, excerpt

MAX_DOCUMENT_BYTES = 64 * 2**20
"""The capabilities of a national service list a thousand layers in some ten megabytes."""


XmlDocument = tuple[bytes, Element]
"""An XML document without entities, as it came and as its root element."""


def get_xml(client: Client, url: str) -> XmlDocument:
    """An XML document. Raises `FetchError`."""

    def check(reply: HttpReply) -> XmlDocument:
        if reply.status != 200:
            raise bad_status(reply)
        try:
            return parse_xml(reply.body)
        except FetchError as error:
            raise BadReplyError(f"{error} ({excerpt(reply)})") from None

    return client.get(url, check, max_bytes=MAX_DOCUMENT_BYTES)


def get_json(client: Client, url: str, body: Any = None) -> dict[str, Any]:
    """A JSON object; `body` is sent with POST. Raises `FetchError`."""

    def check(reply: HttpReply) -> dict[str, Any]:
        if reply.status != 200:
            raise bad_status(reply)
        try:
            plain = json.loads(reply.body)
        except (ValueError, RecursionError):
            raise BadReplyError(f"not JSON ({excerpt(reply)})") from None
        if not isinstance(plain, dict):
            raise BadReplyError("not a JSON object", again=False)
        return plain

    headers = {"Accept": "application/geo+json, application/json"}
    return client.get(url, check, headers=headers, max_bytes=MAX_DOCUMENT_BYTES, json=body)


def parse_xml(body: bytes) -> XmlDocument:
    """A document. Raises `FetchError` where it is malformed or declares entities.

    A DOCTYPE alone is accepted, because every WMS 1.1.1 has one; what it names is never loaded.
    """
    try:
        return body, fromstring(body, forbid_dtd=False)
    except DefusedXmlException:
        raise FetchError("document declares entities, which are not read") from None
    except (ParseError, ValueError):
        raise FetchError("not an XML document") from None


@contextmanager
def capabilities(protocol: str, url: str) -> Iterator[None]:
    """Read a document with OWSLib, whose warnings are ignored.

    For odd documents it raises AttributeError and others; they become `FetchError`.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except FetchError:
        raise
    except Exception as error:
        raise FetchError(
            f"{protocol} capabilities cannot be read ({type(error).__name__}): {url}"
        ) from None
