"""Documents of services: XML that can do no harm, and JSON."""

import json
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

from orthonav.errors import FetchError
from orthonav.fetch.client import BadReplyError, Client, Reply, told
from orthonav.fetch.pictures import exception_text

MAX_DOCUMENT_BYTES = 64 * 2**20
"""The capabilities of a national service list a thousand layers in some ten megabytes."""
_MAX_DEPTH = 100


def get_xml(client: Client, url: str) -> bytes:
    """An XML document without entities. Raises `FetchError`."""

    def judged(reply: Reply) -> bytes:
        _require_ok(reply)
        try:
            check_xml(reply.body)
        except FetchError as error:
            raise BadReplyError(f"{error} ({told(reply)})") from None
        return reply.body

    return client.get(url, judged, max_bytes=MAX_DOCUMENT_BYTES)


def get_json(client: Client, url: str, body: Any = None) -> Any:
    """A JSON object; with `body` that is sent. Raises `FetchError`."""

    def judged(reply: Reply) -> Any:
        _require_ok(reply)
        try:
            plain = json.loads(reply.body)
        except (ValueError, RecursionError):
            raise BadReplyError(f"not JSON ({told(reply)})") from None
        if not isinstance(plain, dict):
            raise BadReplyError("not a JSON object", again=False)
        return plain

    headers = {"Accept": "application/geo+json, application/json"}
    return client.get(url, judged, headers=headers, max_bytes=MAX_DOCUMENT_BYTES, json=body)


def check_xml(body: bytes) -> None:
    """Refuse XML that is broken, declares entities, or nests without end. Raises `FetchError`.

    A DOCTYPE alone is let through, for every WMS 1.1.1 has one; what it names is never loaded.
    """
    depth = 0

    def entity(*_: object) -> Any:
        raise FetchError("document declares entities, which are not read")

    def start(*_: object) -> None:
        nonlocal depth
        depth += 1
        if depth > _MAX_DEPTH:
            raise FetchError("document is nested too deep")

    def end(*_: object) -> None:
        nonlocal depth
        depth -= 1

    parser = expat.ParserCreate()
    parser.EntityDeclHandler = entity
    parser.UnparsedEntityDeclHandler = entity
    parser.ExternalEntityRefHandler = entity
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    try:
        parser.Parse(body, True)
    except (expat.ExpatError, ValueError):
        raise FetchError("not an XML document") from None


def parse_xml(body: bytes) -> ElementTree.Element:
    """The tree of a document. Raises `FetchError` as `check_xml` does."""
    check_xml(body)
    return ElementTree.fromstring(body)


def _require_ok(reply: Reply) -> None:
    if reply.status != 200:
        words = exception_text(reply) or told(reply)
        raise BadReplyError(f"HTTP {reply.status} ({words})", again=reply.status >= 500)
