"""XML and JSON documents of services, parsed with limits."""

import json
from typing import Any
from xml.etree.ElementTree import Element, ParseError

from orthonav.errors import FetchError
from orthonav.extras import missing_extra
from orthonav.fetch.client import BadReplyError, Client, HttpReply, excerpt
from orthonav.fetch.images import exception_text

try:
    from defusedxml import DefusedXmlException
    from defusedxml.ElementTree import fromstring
except ImportError as error:  # pragma: no cover - depends on the installation
    raise missing_extra("reading capabilities", "fetch", "defusedxml", error) from error

MAX_DOCUMENT_BYTES = 64 * 2**20
"""The capabilities of a national service list a thousand layers in some ten megabytes."""


def get_xml(client: Client, url: str) -> bytes:
    """An XML document without entities. Raises `FetchError`."""

    def check(reply: HttpReply) -> bytes:
        _require_ok(reply)
        try:
            parse_xml(reply.body)
        except FetchError as error:
            raise BadReplyError(f"{error} ({excerpt(reply)})") from None
        return reply.body

    return client.get(url, check, max_bytes=MAX_DOCUMENT_BYTES)


def get_json(client: Client, url: str, body: Any = None) -> dict[str, Any]:
    """A JSON object; `body` is sent with POST. Raises `FetchError`."""

    def check(reply: HttpReply) -> dict[str, Any]:
        _require_ok(reply)
        try:
            plain = json.loads(reply.body)
        except (ValueError, RecursionError):
            raise BadReplyError(f"not JSON ({excerpt(reply)})") from None
        if not isinstance(plain, dict):
            raise BadReplyError("not a JSON object", again=False)
        return plain

    headers = {"Accept": "application/geo+json, application/json"}
    return client.get(url, check, headers=headers, max_bytes=MAX_DOCUMENT_BYTES, json=body)


def parse_xml(body: bytes) -> Element:
    """The root of a document. Raises `FetchError` where it is malformed or declares entities.

    A DOCTYPE alone is accepted, because every WMS 1.1.1 has one; what it names is never loaded.
    """
    try:
        root: Element = fromstring(body, forbid_dtd=False)
    except DefusedXmlException:
        raise FetchError("document declares entities, which are not read") from None
    except (ParseError, ValueError):
        raise FetchError("not an XML document") from None
    return root


def _require_ok(reply: HttpReply) -> None:
    if reply.status != 200:
        words = exception_text(reply) or excerpt(reply)
        raise BadReplyError(f"HTTP {reply.status} ({words})", again=reply.status >= 500)
