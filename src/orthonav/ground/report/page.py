"""Self-contained HTML pages from Jinja2 templates: nothing is loaded from outside.

A page extends `base.html` and uses `macros.html`, both in `orthonav.ground.report/templates`.
Everything that a template is given is escaped.
"""

import base64
import hashlib
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

from orthonav.core.extras import missing_extra

_MODULE_SYNTAX = re.compile(r"^(?:export |import .*$)", re.MULTILINE)


def render(
    package: str,
    template: str,
    values: Mapping[str, Any],
    *,
    style: str = "",
    scripts: Sequence[str] = (),
) -> str:
    """The page of `template`, in the folder `templates` of `package`.

    `values` must hold `title` and `kind` (of page). `style` is added to the style of reports and
    `scripts` run at the end of the page; a Content-Security-Policy allows these and no others.
    Raises `MissingExtraError` without Jinja2.
    """
    try:
        from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
    except ImportError as error:
        raise missing_extra("writing a page", "report", "jinja2", error) from error
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader("orthonav.ground.report")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    style = static_text("report.css") + style
    own = {"style": style, "scripts": scripts, "policy": _policy(style, scripts)}
    return environment.get_template(template).render({**values, **own})


def static_text(name: str, package: str = "orthonav.ground.report") -> str:
    """A style or script in the folder `static` of a package."""
    return files(package).joinpath("static", name).read_text(encoding="utf-8")


def data_url(data: bytes, media_type: str) -> str:
    """`data` as an address that needs no file."""
    return f"data:{media_type};base64,{base64.b64encode(data).decode('ascii')}"


def _policy(style: str, scripts: Sequence[str]) -> str:
    """Only these scripts and this style are used, and nothing is requested."""
    allowed = " ".join(map(_source, scripts)) or "'none'"
    return (
        f"default-src 'none'; img-src data:; style-src {_source(style)}; script-src {allowed}; "
        "base-uri 'none'; form-action 'none'"
    )


def _source(text: str) -> str:
    digest = hashlib.sha256(text.encode("utf-8", "replace")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def joined_scripts(shared: Sequence[str], package: str, own: Sequence[str]) -> str:
    """ES modules of `orthonav.ground.report` and scripts of `package` as one script for a page.

    A page that is opened from a disk cannot import modules, so `export` and `import` are removed.
    """
    texts = [static_text(name) for name in shared] + [static_text(name, package) for name in own]
    plain = [_MODULE_SYNTAX.sub("", text) for text in texts]
    return f'(() => {{\n"use strict";\n{"".join(plain)}}})();'
