"""Safe reading of XML of unknown origin: no DTD, hence no entities and no external files.

defusedxml and gpxpy are not used here: neither limits the number and depth of elements, and 20 MB
of empty elements would take gigabytes.
"""

from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from orthonav.core.errors import RouteError

MAX_ELEMENTS = 1_000_000
MAX_DEPTH = 100


def read_markup(data: bytes, kind: str) -> Element:
    """The root of a document, with namespaces removed from its tags.

    `kind` is the expected document type, for messages. Raises `RouteError` on invalid XML, a
    DOCTYPE, more than `MAX_ELEMENTS` elements or more than `MAX_DEPTH` levels.
    """
    if not data.strip():
        raise RouteError(f"{kind} file is empty")
    builder = _Builder(kind)
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartDoctypeDeclHandler = builder.doctype
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.text
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise RouteError(f"{kind} file is not well-formed XML ({error})") from error
    except (ValueError, LookupError) as error:  # unknown encoding
        raise RouteError(f"{kind} file cannot be read ({error})") from error
    return builder.tree.close()


def local_name(tag: str) -> str:
    """A tag without its prefix: `gx:Track` is Track."""
    return tag.rpartition(":")[2]


def text_of(element: Element, tag: str) -> str | None:
    """Text of the first child with a tag; None if there is none or it is empty."""
    return (element.findtext(tag) or "").strip() or None


class _Builder:
    """Builds a tree from parser events, within limits."""

    def __init__(self, kind: str) -> None:
        self.tree = TreeBuilder()
        self._kind = kind
        self._count = self._depth = 0

    def doctype(self, *_: object) -> None:
        raise RouteError(f"{self._kind} file has a DOCTYPE, which is not read; remove it")

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self._count += 1
        self._depth += 1
        if self._count > MAX_ELEMENTS or self._depth > MAX_DEPTH:
            raise RouteError(
                f"{self._kind} file has more than {MAX_ELEMENTS:,} elements or {MAX_DEPTH} levels"
            )
        self.tree.start(local_name(tag), attributes)

    def end(self, tag: str) -> None:
        self._depth -= 1
        self.tree.end(local_name(tag))

    def text(self, data: str) -> None:
        self.tree.data(data)
