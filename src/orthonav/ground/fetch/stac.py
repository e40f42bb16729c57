"""STAC: the files of a catalogue that show an area at a time (STAC 0.9 and 1.0).

Documents are read as plain JSON. pystac-client was tried instead (docs/decisions/dependencies.md).
"""

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

from orthonav.core.errors import FetchError
from orthonav.ground.fetch.options import (
    GSD_TOLERANCE,
    ImageryOptions,
    SourceSpec,
    choose,
    listed,
)
from orthonav.ground.fetch.urls import TOKEN, Secret, linked, origin_of, with_query
from orthonav.ground.fetch.web import Web

MAX_ITEMS = 500  # files of one fetch: an open dataset each, per thread
MAX_DOCUMENTS = 2000  # documents of one search
PAGE = 100  # items per page; APIs allow at least this many
_TIFF = re.compile(r"image/(tiff|vnd\.stac\.geotiff)|\.tiff?$", re.IGNORECASE)
_PREFERRED = ("visual", "image", "ortho", "data", "rgb")
Box = tuple[float, float, float, float]
Features = Iterator[tuple[dict[str, Any], str]]


class CatalogItem(NamedTuple):
    """One file of a catalogue: its time (ISO 8601), name and address."""

    time: str
    name: str
    url: str


def find_files(web: Web, spec: SourceSpec, box_deg: Box) -> tuple[list[str], str | None]:
    """Addresses of the files that touch a box, and their date; newest first.

    The box is west, south, east, north in degrees. Of items whose names differ by a year only the
    newest is taken. The address of `spec` is an API (its search is used), a list of items, or a
    static catalogue or collection. `time` is an ISO 8601 time or interval with a slash. Raises
    `FetchError` where there are none.
    """
    url, options = spec.url, spec.options
    items = []
    examined = 0
    for feature, where in _features(web, url, box_deg, options):
        examined += 1
        if _touches(feature, box_deg) and _in_time(_time(feature), options.time):
            items.append(_item(feature, where, options))
        if len(items) > MAX_ITEMS:
            raise FetchError(f"more than {MAX_ITEMS} files; choose a smaller area or time: {url}")
    if not items:
        when = f" at {options.time}" if options.time else ""
        raise FetchError(
            f"catalogue has no imagery of the area{when} ({examined} items examined): {url}"
        )
    newest: dict[str, CatalogItem] = {}
    for item in sorted(items, reverse=True):
        newest.setdefault(re.sub(r"(?<!\d)(19|20)\d\d(?!\d)", "", item.name), item)
    days = sorted({item.time[:10] for item in newest.values() if item.time})
    date = "/".join(dict.fromkeys([days[0], days[-1]])) if days else None
    urls = [item.url for item in newest.values()]
    return _signed(web, spec.token_url, urls) if spec.token_url else urls, date


def _signed(web: Web, token_url: str, urls: list[str]) -> list[str]:
    """Addresses with `{token}`, for which a service issued a query string. Raises `FetchError`.

    The token goes only to the origins of these addresses.
    """
    token = web.get_json(token_url).get("token")
    if not isinstance(token, str) or not token:
        raise FetchError(f"signing service returned no token: {token_url}")
    for origin in {origin_of(url) for url in urls}:
        web.secrets.append(Secret(TOKEN, origin, token.lstrip("?")))
    return [f"{url}{'&' if '?' in url else '?'}{TOKEN}" for url in urls]


def _features(web: Web, url: str, box_deg: Box, options: ImageryOptions) -> Features:
    root = web.get_json(url)
    search, listing = _related(root, "search"), _related(root, "items")
    query: dict[str, Any] = {"bbox": list(box_deg), "limit": PAGE}
    query |= {"datetime": options.time} if options.time else {}
    if search:
        query |= {"collections": [options.collection]} if options.collection else {}
        return _paged(web, linked(url, search[0]["href"]), query)
    if listing and not _related(root, "child", "item"):
        bbox = ",".join(f"{value:.7f}" for value in box_deg)
        parameters = {name: str(value) for name, value in query.items()} | {"bbox": bbox}
        return _paged(web, with_query(linked(url, listing[0]["href"]), parameters), None)
    return _walked(web, url, root)


def _paged(web: Web, url: str, body: dict[str, Any] | None) -> Features:
    """Items of a search (POST of `body`) or of one collection (GET), page by page."""
    start = url
    for _ in range(MAX_DOCUMENTS):
        page, here = web.get_json(url, body), url
        features = page.get("features")
        if not isinstance(features, list) or not all(isinstance(each, dict) for each in features):
            raise FetchError(f"answer is not a list of items: {here}")
        yield from ((feature, here) for feature in features)
        following = next(iter(_related(page, "next")), None)
        if following is None:
            return
        url = linked(here, following["href"])
        more = following.get("body")
        if str(following.get("method", "GET")).upper() == "POST":
            merged = body if following.get("merge") and body else {}
            body = {**merged, **(more if isinstance(more, dict) else {})}
        else:
            body = None
    raise FetchError(f"list of items does not end: {start}")


def _walked(web: Web, url: str, root: dict[str, Any]) -> Features:
    stack, known = [(url, root)], {url}
    for _ in range(MAX_DOCUMENTS):
        if not stack:
            return
        where, document = stack.pop()
        if document.get("type") == "Feature":
            yield document, where
            continue
        for link in _related(document, "child", "item"):
            if (address := linked(where, link["href"])) not in known:
                known.add(address)
                stack.append((address, web.get_json(address)))
    raise FetchError(
        f"catalogue has more than {MAX_DOCUMENTS} documents; give the address of a part: {url}"
    )


def _item(feature: dict[str, Any], where: str, options: ImageryOptions) -> CatalogItem:
    name, assets = str(feature.get("id", ""))[:200], feature.get("assets")
    plain = assets if isinstance(assets, dict) else {}
    known = {key: asset for key, asset in plain.items() if isinstance(asset, dict)}
    asset = known[_asset(known, options, name)]
    return CatalogItem(_time(feature), name, linked(where, str(asset.get("href", ""))))


def _asset(assets: dict[str, dict[str, Any]], options: ImageryOptions, name: str) -> str:
    """The asset requested, else a GeoTIFF by name, or the coarsest that is fine enough."""
    if options.asset is not None:
        return choose(list(assets), options.asset, f"item {name} has no asset")
    tiffs = {
        key: float(asset.get("gsd") or asset.get("eo:gsd") or 0)
        for key, asset in assets.items()
        if _TIFF.search(str(asset.get("type") or asset.get("href")).partition("?")[0])
        and not {"thumbnail", "metadata", "overview"} & set(asset.get("roles") or [])
    }
    if not tiffs:
        raise FetchError(f"item {name} has no GeoTIFF; available: {listed(list(assets))}")
    fitting = [
        key for key, gsd_m in tiffs.items() if 0 < gsd_m <= options.wanted_gsd_m * GSD_TOLERANCE
    ]
    preferred = [key for key in _PREFERRED if key in tiffs] or (list(tiffs) * (len(tiffs) == 1))
    if not preferred and not fitting:
        raise FetchError(f"choose one with --asset; item {name} has {listed(list(tiffs))}")
    return preferred[0] if preferred else max(fitting, key=lambda key: tiffs[key])


def _touches(feature: dict[str, Any], box_deg: Box) -> bool:
    try:
        box = [float(value) for value in feature["bbox"]]
        west, south, east, north = box if len(box) == 4 else (*box[:2], *box[3:5])
    except (KeyError, TypeError, ValueError):
        return True
    return west <= box_deg[2] and east >= box_deg[0] and south <= box_deg[3] and north >= box_deg[1]


def _time(feature: dict[str, Any]) -> str:
    properties = feature.get("properties")
    known = properties if isinstance(properties, dict) else {}
    return str(known.get("datetime") or known.get("start_datetime") or "")


def _in_time(time: str, wanted: str | None) -> bool:
    """Whether a time lies within the one requested (compared as text, which ISO 8601 allows)."""
    if wanted is None:
        return True
    low, slash, high = wanted.partition("/")
    if not slash:
        return time.startswith(low)
    after = low in ("", "..") or time[: len(low)] >= low
    return after and (high in ("", "..") or time[: len(high)] <= high)


def _related(document: dict[str, Any], *kinds: str) -> list[dict[str, Any]]:
    links = document.get("links")
    known = [link for link in links if isinstance(link, dict)] if isinstance(links, list) else []
    return [
        link | {"href": str(link.get("href", ""))} for link in known if link.get("rel") in kinds
    ]
